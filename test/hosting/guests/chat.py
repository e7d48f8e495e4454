# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Unmodified programs of many kinds; none knows of this executor."""

import rclpy
from rclpy.node import Node
from std_msgs.msg import String


class Listener(Node):

    def __init__(self):
        super().__init__('listener')
        self.create_subscription(String, 'chatter', self.heard, 10)
        self.n = 0

    def heard(self, message):
        self.n += 1


def main():
    rclpy.init()
    node = Listener()
    rclpy.spin(node)
    node.destroy_node()
    rclpy.shutdown()
    print('listener ended after its spin')


def two():
    return [Listener(), Node('idle')]


def own_executor():
    from rclpy.executors import MultiThreadedExecutor
    rclpy.init()
    node = Listener()
    executor = MultiThreadedExecutor(num_threads=4)
    executor.add_node(node)
    try:
        executor.spin()
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown()
    print('own executor ended')


def events_executor():
    from rclpy.experimental.events_executor import EventsExecutor
    with rclpy.init() or __import__('contextlib').nullcontext():
        executor = EventsExecutor()
        executor.add_node(Listener())
        executor.spin()


def spins_in_thread():
    import threading
    rclpy.init()
    executor = rclpy.executors.SingleThreadedExecutor()
    node = Listener()
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    while rclpy.ok() and node.n < 5:
        __import__('time').sleep(0.01)
    print('heard five')
    rclpy.shutdown()
    thread.join()
    print('thread joined')


def spins_once():
    rclpy.init()
    node = Listener()
    while rclpy.ok() and node.n < 5:
        rclpy.spin_once(node, timeout_sec=0.1)
    print('heard', 'enough' if node.n >= 5 else 'too little')
    node.destroy_node()
    rclpy.shutdown()


def spins_once_for_ever():
    rclpy.init()
    node = Listener()
    while rclpy.ok():
        rclpy.spin_once(node)
    print('no longer ok')


def calls_a_service():
    from std_srvs.srv import Trigger
    rclpy.init()
    node = Listener()
    node.create_service(Trigger, 'own', answer)
    client = node.create_client(Trigger, 'own')
    assert client.wait_for_service(5.0)
    future = client.call_async(Trigger.Request())
    rclpy.spin_until_future_complete(node, future, timeout_sec=5.0)
    print('answer:', future.result().message)


def answer(request, response):
    response.message = 'forty-two'
    return response


def shuts_down_in_a_callback():
    rclpy.init()
    node = Listener()
    node.create_timer(0.3, lambda: rclpy.shutdown())
    rclpy.spin(node)
    print('shut down')


def catches_signals():
    import os
    import signal
    rclpy.init()
    signal.signal(signal.SIGTERM, lambda *_: None)
    signal.signal(signal.SIGHUP, lambda *_: print('read the settings again'))
    os.kill(os.getpid(), signal.SIGHUP)
    rclpy.spin(Listener())


def handles_a_signal():
    import os
    import signal
    import threading
    import time

    def timed_out(number, frame):
        raise TimeoutError(f'signal {number}')

    rclpy.init()
    node = Listener()
    before = signal.getsignal(signal.SIGUSR1)
    signal.signal(signal.SIGUSR1, timed_out)
    try:
        os.kill(os.getpid(), signal.SIGUSR1)
        while True:
            time.sleep(0.01)
    except TimeoutError as error:
        print('while it worked:', error)
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGUSR1)).start()
    try:
        rclpy.spin(node)
    except TimeoutError as error:
        print('while it spun:', error)
    print('one handler:', signal.signal(signal.SIGUSR1, before) is timed_out)
    rclpy.spin(node)


def handles_its_exceptions():
    rclpy.init()
    node = Listener()
    n = iter(range(1000))

    def tick():
        if next(n) % 2:
            raise ValueError('odd')

    timer = node.create_timer(0.02, tick)
    executor = rclpy.executors.SingleThreadedExecutor()
    executor.add_node(node)
    for spin in (lambda: rclpy.spin(node), executor.spin):
        executor.add_node(node) if spin == executor.spin else None
        for _ in range(3):
            try:
                spin()
            except ValueError as error:
                print(spin.__name__, 'raised', error)
    timer.cancel()
    rclpy.spin(node)


def spins_in_callbacks():
    from rclpy.callback_groups import ReentrantCallbackGroup
    from std_srvs.srv import Trigger
    rclpy.init()
    node = Listener()
    group = ReentrantCallbackGroup()
    node.create_service(Trigger, 'own', answer, callback_group=group)
    client = node.create_client(Trigger, 'own', callback_group=group)
    ways = {
        'of the node': lambda future: node.executor.spin_until_future_complete(future),
        'of rclpy': lambda future: rclpy.spin_until_future_complete(node, future),
        'step by step': lambda future: step_until(future, node.executor.spin_once),
        'step by step of rclpy': lambda future: step_until(future, lambda: rclpy.spin_once(node)),
    }

    def tick():
        timer.cancel()
        for way, spin in ways.items():
            future = client.call_async(Trigger.Request())
            spin(future)
            print(way, future.result().message)

    timer = node.create_timer(0.1, tick, callback_group=group)
    rclpy.spin(node)


def step_until(future, step):
    while not future.done():
        step()


def steps():
    rclpy.init()
    node = Listener()
    node.create_timer(0.02, lambda: None)
    for _ in range(30):
        rclpy.spin_once(node, timeout_sec=600.0)
    print('30 steps')
    rclpy.spin(node)


def never_spins():
    rclpy.init()
    node = Node('teleop')
    node.create_publisher(String, 'typed', 10).publish(String(data='w'))
    node.destroy_node()
    rclpy.shutdown()
    print('typed w')


def ends_in_a_thread():
    import threading
    rclpy.init()
    node = Listener()
    threading.Timer(0.3, rclpy.shutdown).start()
    rclpy.spin(node)
    print('over' if not rclpy.ok() else 'it goes on')


def leaves_a_thread():
    import threading
    import time
    threading.Thread(target=time.sleep, args=(60,), name='stubborn', daemon=False).start()
    main()


def never_ends():
    main()
    __import__('time').sleep(60)


def prints():
    print('not JSON')
    main()


def blocks_in_a_callback():
    rclpy.init()
    node = Listener()
    node.create_timer(0.2, lambda: __import__('time').sleep(60))
    rclpy.spin(node)


def exits():
    raise SystemExit(3)


def raises_in_a_callback():
    rclpy.init()
    node = Listener()
    node.create_timer(0.2, lambda: 1 / 0)
    rclpy.spin(node)


def no_longer_spins():
    import time
    rclpy.init()
    node = Listener()
    node.create_timer(0.01, lambda: 1 / 0)
    try:
        rclpy.spin(node)
    except ZeroDivisionError:
        time.sleep(60)


def own_context():
    context = rclpy.context.Context()
    rclpy.init(context=context)
    rclpy.spin(Node('alone', context=context))


def other_domain():
    rclpy.init(domain_id=7)


def needs_two(one, two):
    pass


def returns_text():
    return 'text'


def returns_nothing():
    pass


class NoNode:
    pass


NUMBER = 3
