# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Unmodified programs of many kinds; none knows of this executor."""

import asyncio
import multiprocessing
import os
import signal
import sys
import threading
import time

import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import (
    ExternalShutdownException,
    MultiThreadedExecutor,
    SingleThreadedExecutor,
)
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger


class Listener(Node):
    """Says when it has heard five messages."""

    def __init__(self, name='listener'):
        super().__init__(name)
        self.create_subscription(String, 'chatter', self.heard, 10)
        self.n = 0

    def heard(self, message):
        self.n += 1
        if self.n == 5:
            print(f'{self.get_name()} heard five')

    def serve(self, **more):
        """Return a client of a service of the node itself."""
        def answer(request, response):
            response.message = 'forty-two'
            return response

        self.create_service(Trigger, '~/own', answer, **more)
        return self.create_client(Trigger, '~/own', **more)


def spin_to_the_end(node):
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


def main():
    rclpy.init()
    node = Listener()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        print(f'listener interrupted, ok: {rclpy.ok()}')
    node.destroy_node()
    rclpy.try_shutdown()


def two():
    node = Node('adds_another')

    def add():
        timer.cancel()
        node.another = Listener('another')
        node.executor.add_node(node.another)

    timer = node.create_timer(0.05, add)
    return [Listener('first'), node]


def spins_in_thread():
    rclpy.init()
    executor = SingleThreadedExecutor()
    node = Listener('in_thread')
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    while node.n < 5:
        time.sleep(0.01)
    threading.Timer(0.1, rclpy.shutdown).start()
    thread.join()
    print(f'thread joined, ok: {rclpy.ok()}')


def spins_once_for_ever():
    rclpy.init()
    node = Listener('for_ever')
    try:
        while rclpy.ok():
            rclpy.spin_once(node)
    except KeyboardInterrupt:
        print('interrupted in a step')


def steps():
    rclpy.init()
    node = Listener('steps')
    node.create_timer(0.02, lambda: None)
    for _ in range(30):
        rclpy.spin_once(node, timeout_sec=600.0)
    print('30 steps')
    spin_to_the_end(node)


def calls_a_service():
    rclpy.init()
    node = Listener('caller')
    client = node.serve()
    assert client.wait_for_service(60.0)
    future = client.call_async(Trigger.Request())
    rclpy.spin_until_future_complete(node, future, timeout_sec=5.0)
    print(f'answer: {future.result().message}')


def after(seconds, number):
    """Send a signal to this process after a while."""
    threading.Timer(seconds, os.kill, (os.getpid(), number)).start()


def handles_signals():
    def timed_out(number, frame):
        raise TimeoutError(f'signal {number:d}')

    rclpy.init()
    node = Listener('handler')
    node.create_timer(0.02, lambda: None)  # with rclpy's executor a handler waits for a callback
    before = signal.signal(signal.SIGUSR1, timed_out)
    after(0.2, signal.SIGUSR1)
    try:
        while True:
            time.sleep(0.01)
    except TimeoutError as error:
        print(f'while it worked: {error}')
    after(0.2, signal.SIGUSR1)
    try:
        rclpy.spin(node)
    except TimeoutError as error:
        print(f'while it spun: {error}')
    print(f'one handler: {signal.signal(signal.SIGUSR1, before) is timed_out}')
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        future = rclpy.Future()
        signal.signal(number, lambda *_, future=future: future.set_result(1))
        after(0.1, number)
        rclpy.spin_until_future_complete(node, future)
        print(f'its own handler of {number.name}, ok: {rclpy.ok()}')
    return 3


def stops_the_robot():
    """Send a last message, as drivers do: rclpy leaves Ctrl-C to Python."""
    rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    node = Node('driver')
    publisher = node.create_publisher(String, 'command', 10)
    node.create_timer(0.02, lambda: None)
    after(0.3, signal.SIGINT)
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        publisher.publish(String(data='stop'))
        print(f'stopped the robot, ok: {rclpy.ok()}')
    finally:
        node.destroy_node()
        rclpy.shutdown()


def is_interrupted_before_it_begins():
    after(0.2, signal.SIGINT)
    time.sleep(60.0)


def is_interrupted():
    rclpy.init()
    node = Node('interrupted')
    after(0.3, signal.SIGINT)
    try:
        rclpy.spin(node)
        print('spin returned')
    except KeyboardInterrupt:
        while rclpy.ok():  # rclpy's thread ends it at about the same time
            time.sleep(0.01)
        print('interrupted')
        raise


def works_with_asyncio():
    async def run():
        stop = asyncio.Event()
        asyncio.get_running_loop().add_signal_handler(signal.SIGINT, stop.set)
        rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
        node = Node('server')
        node.create_timer(0.02, lambda: None)
        after(0.2, signal.SIGINT)
        while not stop.is_set():
            rclpy.spin_once(node, timeout_sec=0.01)
            await asyncio.sleep(0.01)
        print(f'served, ok: {rclpy.ok()}')
        asyncio.get_running_loop().remove_signal_handler(signal.SIGINT)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        return node

    async def work():
        after(0.2, signal.SIGINT)
        try:
            await asyncio.sleep(60.0)
        except asyncio.CancelledError:
            print('cancelled')
            raise

    node = asyncio.run(run())
    try:
        asyncio.run(work())
    except KeyboardInterrupt:
        print('interrupted')
    after(0.2, signal.SIGINT)
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        print('interrupted again')
    sys.exit('no more work')


def fails_at_the_end():
    rclpy.init()
    rclpy.spin_once(Node('failing'), timeout_sec=0.1)
    rclpy.shutdown()
    raise ValueError('not calibrated')


def exits_early():
    sys.exit(5)


def handles_its_exceptions():
    rclpy.init()
    node = Listener('careful')
    n = iter(range(1000))

    def tick():
        if next(n) % 2:
            raise ValueError('odd')

    timer = node.create_timer(0.02, tick)
    executor = SingleThreadedExecutor()
    for name, spin in (('rclpy', lambda: rclpy.spin(node)), ('executor', executor.spin)):
        if name == 'executor':
            executor.add_node(node)
        for _ in range(3):
            try:
                spin()
            except ValueError as error:
                print(f'{name} raised {error}')
    timer.cancel()
    print('has handled its exceptions')
    spin_to_the_end(node)


def spins_in_callbacks():
    rclpy.init()
    node = Listener('nested')
    group = ReentrantCallbackGroup()
    client = node.serve(callback_group=group)
    ways = {
        'of the node': lambda future: node.executor.spin_until_future_complete(future),
        'of rclpy': lambda future: rclpy.spin_until_future_complete(node, future),
        'step by step': lambda future: step_until(future, node.executor.spin_once),
        'step by step of rclpy': lambda future: step_until(future, lambda: rclpy.spin_once(node)),
    }

    def step_until(future, step):
        while not future.done():
            step()

    def tick():
        timer.cancel()
        for way, spin in ways.items():
            future = client.call_async(Trigger.Request())
            spin(future)
            print(f'{way} {future.result().message}')

    timer = node.create_timer(0.1, tick, callback_group=group)
    spin_to_the_end(node)


class PassesOn:
    """What ros2cli makes: no node, passes on to one, and refuses after the shutdown."""

    def __init__(self):
        self.node = Node('behind')

    def __getattr__(self, name):
        if not rclpy.ok():
            raise RuntimeError('shut down')
        return getattr(self.node, name)


def passes_on():
    rclpy.init()
    proxy, future = PassesOn(), rclpy.Future()
    proxy.create_timer(0.1, lambda: future.done() or future.set_result(1))
    rclpy.spin_once(proxy.node, timeout_sec=0.05)
    rclpy.spin_until_future_complete(proxy, future)
    proxy.node.destroy_node()
    rclpy.try_shutdown()
    print('passed on')


def returns_status():
    rclpy.init()
    rclpy.spin_once(Node('returning'), timeout_sec=0.1)
    rclpy.shutdown()
    return 4


def returns_reason():
    returns_status()
    return 'not calibrated'


def begins_again():
    for _ in range(2):
        rclpy.init()
        node = Node('again')
        node.create_timer(0.05, rclpy.shutdown)
        try:
            rclpy.spin(node)
        except ExternalShutdownException:
            pass
        print(f'again: ok is {rclpy.ok()}')
        rclpy.try_shutdown()


def has_another_context():
    context = rclpy.context.Context()
    rclpy.init(context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(Node('elsewhere', context=context))
    executor.spin_once(timeout_sec=0.1)
    executor.shutdown()
    rclpy.shutdown(context=context)


def has_a_loop():
    asyncio.get_event_loop().run_until_complete(asyncio.sleep(0.01))
    never_spins()


class Library:
    """Has one node for all programs of a process, as some libraries do."""

    node = None
    long_program_has_begun = threading.Event()
    short_program_has_ended = threading.Event()

    @classmethod
    def subscribe(cls, topic, heard):
        if cls.node is None:
            cls.node = Node('library')
            executor = MultiThreadedExecutor(2)
            executor.add_node(cls.node)
            threading.Thread(target=executor.spin, daemon=True).start()
        cls.node.create_subscription(String, topic, heard, 10)
        return cls.node.create_publisher(String, topic, 10)


def uses_a_library_briefly():
    rclpy.init()
    Library.subscribe('short', lambda message: None)
    Library.long_program_has_begun.wait(30.0)
    rclpy.shutdown()
    Library.short_program_has_ended.set()


def uses_a_library():
    rclpy.init()
    heard = threading.Event()
    publisher = Library.subscribe('long', lambda message: heard.set())
    Library.long_program_has_begun.set()
    Library.short_program_has_ended.wait(30.0)
    for _ in range(300):
        publisher.publish(String())
        if heard.wait(0.1):
            break
    print(f'heard after the end of the other program: {heard.is_set()}')
    rclpy.shutdown()


# --- how a run ends ------------------------------------------------------------------------------


def after_a_while(callback, seconds=0.2):
    """Spin a node that calls something again and again."""
    rclpy.init()
    node = Node('ending')
    node.create_timer(seconds, callback)
    spin_to_the_end(node)


def finishes_its_callbacks():
    rclpy.init()
    node = Node('finishing')
    group = ReentrantCallbackGroup()
    rate = node.create_rate(20.0)

    def loop():
        timer.cancel()
        print('loop begins')
        while rclpy.ok():
            rate.sleep()
        time.sleep(1.0)  # brakes
        node.create_publisher(String, 'stopped', 10).publish(String(data='all'))
        print('stops the motors')

    timer = node.create_timer(0.01, loop, callback_group=group)
    executor = MultiThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    except KeyboardInterrupt:
        pass


def shuts_down_in_one_of_two_callbacks():
    rclpy.init()
    node = Node('closing')
    group = ReentrantCallbackGroup()
    ended = threading.Event()

    def loop():
        timer.cancel()
        while rclpy.ok():
            time.sleep(0.01)
        ended.set()

    def stop():
        stopper.cancel()
        rclpy.shutdown()
        print(f'closing: ok is {rclpy.ok()}, the loop has ended: {ended.wait(20.0)}')

    timer = node.create_timer(0.01, loop, callback_group=group)
    stopper = node.create_timer(0.3, stop, callback_group=group)
    executor = MultiThreadedExecutor()
    executor.add_node(node)
    executor.spin()


def shuts_down_in_a_callback():
    after_a_while(lambda: rclpy.shutdown(), 1.5)
    print('shut down')


def never_spins():
    rclpy.init()
    node = Node('teleop')
    node.create_publisher(String, 'typed', 10).publish(String(data='w'))
    node.destroy_node()
    rclpy.shutdown()
    print('typed w')


def hears_nothing():
    rclpy.init()
    node = Node('deaf')
    node.create_subscription(String, 'nobody_says_this', lambda message: None, 10)
    rclpy.spin_once(node, timeout_sec=0.2)
    rclpy.shutdown()


def destroys_a_node():
    rclpy.init()
    executor, ran = SingleThreadedExecutor(), []
    lasting, brief = Node('lasting'), Node('brief')
    lasting.create_timer(0.01, lambda: ran.append(1))
    for node in (lasting, brief):
        executor.add_node(node)
    executor.spin_once()
    brief.destroy_node()    # the executor still has it
    for _ in range(3):
        executor.spin_once()
    print('ran', len(ran) >= 3)
    rclpy.shutdown()


def forks_a_node():
    rclpy.init()
    process = multiprocessing.get_context('fork').Process(target=rclpy.init)
    process.start()
    process.join()
    print('ended with', process.exitcode)
    rclpy.shutdown()


def starts_slowly():
    rclpy.init()
    while rclpy.ok():
        time.sleep(0.01)
    Node('late')  # the context is shut down


def fails_after_a_loop():
    rclpy.init()
    while rclpy.ok():
        time.sleep(0.01)
    raise OSError


def leaves_a_thread():
    threading.Thread(target=time.sleep, args=(60,), name='stubborn', daemon=False).start()
    print('not JSON')
    after_a_while(lambda: None)


def never_ends():
    after_a_while(lambda: None)
    time.sleep(60)


def blocks_in_a_callback():
    def block():
        print('blocked')
        time.sleep(60)

    after_a_while(block)


def raises_in_a_callback():
    after_a_while(lambda: 1 / 0, 0.5)  # when the next program has begun


class Refuses(Node):
    """Raises when another node is removed after the end."""

    @property
    def timers(self):
        if not rclpy.ok():
            raise OSError('the device is gone')
        return super().timers


def refuses():
    rclpy.init()
    executor = SingleThreadedExecutor()
    for name in ('one', 'other'):
        executor.add_node(Refuses(name))
    executor.spin_once(timeout_sec=0.1)
    rclpy.shutdown()


def waits_for_a_task():
    rclpy.init()
    executor = SingleThreadedExecutor()
    executor.add_node(Node('waiting'))
    executor.spin_until_future_complete(executor.create_task(lambda: 1 / 0))


# --- what cannot start ---------------------------------------------------------------------------


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
