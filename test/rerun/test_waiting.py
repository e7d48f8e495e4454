# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What waits, and what asks others: services, parameters, rates, sleeps, threads, programs."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
import math
import queue
import subprocess
import sys
import threading
import time

from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Time
from mddag_executor.rerun import rerun
import pytest
import rclpy
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header, String
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

from .helpers import Filter, GRAPH, MS, run_filter, START, write_bag


def server(answers_after_ms=0):
    """Return a node with a service, which takes its time."""
    node = rclpy.create_node('server')

    def answer(request, response):
        node.get_clock().sleep_for(Duration(nanoseconds=answers_after_ms * MS))
        response.message = 'hello'
        return response

    node.create_service(Trigger, '/greet', answer)
    return node


def test_a_service_answers_in_virtual_time(bag, graph):
    """A synchronous call lends its worker."""
    def take(node, number):
        client = node.client
        if number == 3:
            assert client.wait_for_service(timeout_sec=1.0)
            future = client.call_async(Trigger.Request())
            future.add_done_callback(lambda done: node.note(done.result().message))
        elif number == 5:
            node.note(client.call(Trigger.Request()).message)

    def fill(node):
        node.client = node.create_client(Trigger, '/greet')

    seen, result = run_filter(bag, graph, take, lambda: server(20), workers=1, fill=fill)
    # The asynchronous request leaves with the end of the callback, after 10 ms.
    assert seen == [(330.0, 'hello'), (520.0, 'hello')]
    assert not result.warnings


def test_a_call_that_is_not_answered_in_time_returns_nothing(bag, graph):
    """What comes later is ignored."""
    def take(node, number):
        if number == 3:
            node.note(node.client.call(Trigger.Request(), timeout_sec=0.05))

    def fill(node):
        node.client = node.create_client(Trigger, '/greet')

    seen, result = run_filter(bag, graph, take, lambda: server(200), workers=2, fill=fill)
    assert seen == [(350.0, None)] and not result.warnings


def test_a_request_leaves_though_its_client_is_destroyed(bag, graph):
    served = []

    def make_server():
        node = rclpy.create_node('server')
        node.create_service(
            Trigger, '/greet', lambda request, response: (served.append(node), response)[1])
        return node

    def take(node, number):
        if number == 3:
            client = node.create_client(Trigger, '/greet')
            client.call_async(Trigger.Request())
            node.destroy_client(client)

    _, result = run_filter(bag, graph, take, make_server)
    assert len(served) == 1 and not result.warnings


@pytest.mark.parametrize('declared', [True, False])
def test_a_request_of_a_callback_with_a_deadline_is_as_urgent(bag, graph, declared):
    """It goes before tasks that wait already."""
    order = []

    def serve():
        def answer(request, response):
            order.append('served')
            return response
        node = rclpy.create_node('server')
        node.create_service(Trigger, '/greet', answer)
        return node

    def ask(node):
        for _ in range(3):
            node.executor.create_task(order.append, 'task')
        node.client.call_async(Trigger.Request())

    def take(node, number):
        if number == 3:
            if declared:
                ask(node)
            else:
                node.executor.create_task(ask, node)

    def fill(node):
        node.client = node.create_client(Trigger, '/greet')

    run_filter(bag, graph, take, serve, workers=1, fill=fill)
    assert order == (['served', *['task'] * 3] if declared else [*['task'] * 3, 'served'])


def test_services_of_later_programs_are_waited_for_without_delay(bag, graph):
    seen = []

    def main():
        rclpy.init()
        node = rclpy.create_node('client')
        assert node.create_client(Trigger, '/greet').wait_for_service()
        assert ActionClient(node, Fibonacci, 'fibonacci').wait_for_server()
        node.create_subscription(
            Header, '/points', lambda message: seen.append(int(message.frame_id)), 10)
        rclpy.spin(node)

    run_filter(bag, graph, lambda node, number: None, main, server, fibonacci)
    assert seen == [*range(20)]


def test_a_response_ends_a_step(bag, graph):
    said = []

    def main():
        rclpy.init()
        node = rclpy.create_node('client')
        client = node.create_client(Trigger, '/greet')
        client.wait_for_service()
        future = client.call_async(Trigger.Request())
        while not future.done():
            rclpy.spin_once(node)
        said.append((future.result().message, node.get_clock().now().nanoseconds - START))

    run_filter(bag, graph, lambda node, number: None, main, server)
    (message, after), = said
    assert message == 'hello' and after < 100 * MS, after


def test_ros_arguments(bag, graph):
    seen = []

    def main():
        rclpy.init()
        node = rclpy.create_node('filtre')
        node.declare_parameter('gain', 0)
        seen.append((node.get_name(), node.get_parameter('gain').value))
        node.create_subscription(Header, '/cloud', lambda message: seen.append(message), 10)
        rclpy.spin(node)

    rerun(bag, graph, [main], ros_args=[
        '-r', '__node:=filter', '-r', '/cloud:=/points', '-p', 'gain:=3'])
    assert seen[0] == ('filter', 3)
    assert len(seen) == 21


def test_a_process_without_standard_error_may_rerun(bag, graph, monkeypatch):
    monkeypatch.setattr(sys, 'stderr', None)
    assert run_filter(bag, graph)[1].callbacks == 20


def test_timeouts_of_python_and_rclpy_take_virtual_time(bag, graph):
    def take(node, number):
        if number == 2:
            node.create_rate(100.0).sleep()
            node.note('rate')
            node.get_clock().sleep_for(Duration(seconds=0.5))
            node.note('clock')
            with suppress(queue.Empty):
                queue.Queue().get(timeout=0.05)
            node.note('queue')
            threading.Semaphore(0).acquire(timeout=0.05)
            node.note('semaphore')
            AsyncParameterClient(node, 'none').wait_for_services(0.5)
            node.note('services')
        elif number == 15:
            node.get_clock().sleep_for(Duration(seconds=0.004))
            node.create_publisher(String, '/done', 10).publish(String())

    seen, result = run_filter(bag, graph, take)
    # It ends after its execution time, as it has waited for less; what it sends leaves then.
    assert [each.time - START for each in result.outputs if each.topic == '/done'] == [1510 * MS]
    # seconds since the epoch are floats with a resolution of 0.2 us
    assert [(round(time, 2), what) for time, what in seen] == [
        (210.0, 'rate'), (710.0, 'clock'), (760.0, 'queue'), (810.0, 'semaphore'),
        (1310.0, 'services')]


def test_threads_of_nodes_are_in_virtual_time_too(bag, graph):
    def fill(node):
        numbers = queue.Queue[int]()
        node.numbers = numbers
        publisher = node.create_publisher(String, '/doubled', 10)

        def work():
            while True:
                number = numbers.get()
                node.get_clock().sleep_for(Duration(seconds=0.005))
                publisher.publish(String(data=str(2 * number)))
                node.note(2 * number)
                if number == 4:
                    node.note(pool.submit(lambda: 'pooled').result())
                    return

        pool = ThreadPoolExecutor(2)
        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        with pytest.raises(RuntimeError):
            thread.start()

    def take(node, number):
        node.numbers.put(number)

    seen, result = run_filter(bag, graph, take, fill=fill)
    assert seen == [(100.0 * i + 5, 2 * i) for i in range(5)] + [(405.0, 'pooled')]
    assert result.counts['/doubled'] == 5
    assert not result.warnings


def test_a_pool_of_threads_can_be_shut_down_after_the_run(bag, graph):
    # Python does so when it ends
    pools = []

    def fill(node):
        pools.append(ThreadPoolExecutor(1))

    def take(node, number):
        node.note(pools[0].submit(lambda: number).result())

    seen, _result = run_filter(bag, graph, take, fill=fill)
    assert [number for _time, number in seen] == list(range(20))
    ends = threading.Thread(target=pools[0].shutdown, daemon=True)
    ends.start()
    ends.join(30)
    assert not ends.is_alive()


def fibonacci(**more):
    """Return a node with an action that feeds back each 10 ms, and may be cancelled."""
    node = rclpy.create_node('fibonacci')

    def execute(goal):
        sequence = [0, 1]
        for _ in range(goal.request.order):
            node.get_clock().sleep_for(Duration(nanoseconds=10 * MS))
            if goal.is_cancel_requested:
                goal.canceled()
                return Fibonacci.Result()
            sequence.append(sequence[-1] + sequence[-2])
            goal.publish_feedback(Fibonacci.Feedback(sequence=sequence))
        goal.succeed()
        return Fibonacci.Result(sequence=sequence)

    node.server = ActionServer(
        node, Fibonacci, 'fibonacci', execute, callback_group=ReentrantCallbackGroup(),
        cancel_callback=lambda goal: CancelResponse.ACCEPT, **more)
    return node


def test_an_action(bag, graph):
    async def take(node, number):
        if number == 3:
            assert node.client.wait_for_server(1.0)
            goal = await node.client.send_goal_async(
                Fibonacci.Goal(order=3),
                lambda message: node.note(list(message.feedback.sequence)))
            node.note(goal.accepted)
            answer = await goal.get_result_async()
            node.note((answer.status, list(answer.result.sequence)))

    def fill(node):
        node.client = ActionClient(node, Fibonacci, 'fibonacci')

    seen, result = run_filter(bag, graph, take, fibonacci, fill=fill)
    assert seen == [
        (310.0, True), (320.0, [0, 1, 1]), (330.0, [0, 1, 1, 2]), (340.0, [0, 1, 1, 2, 3]),
        (340.0, (GoalStatus.STATUS_SUCCEEDED, [0, 1, 1, 2, 3]))]
    assert not result.warnings


def test_results_of_actions_expire(bag, graph):
    """Also if the only worker is busy when those of two goals do, soon after 1000 ms."""
    graph.write_text(GRAPH.replace('10ms', '60ms'))

    async def take(node, number):
        if number == 3:
            sent = [node.client.send_goal_async(Fibonacci.Goal(order=3)) for _ in range(2)]
            node.goals = [await future for future in sent]
        if number in (3, 9, 12):
            for goal in node.goals:
                node.note((await goal.get_result_async()).status)

    def fill(node):
        node.client = ActionClient(node, Fibonacci, 'fibonacci')

    seen, _ = run_filter(
        bag, graph, take, lambda: fibonacci(result_timeout=0.62), fill=fill, workers=1)
    assert [status for _, status in seen] == (
        [GoalStatus.STATUS_SUCCEEDED] * 4 + [GoalStatus.STATUS_UNKNOWN] * 2)


def test_a_program_with_a_loop_of_its_own(bag, graph):
    seen = []

    def main():
        rclpy.init()
        node = Filter(lambda node, number: node.note(number) if number % 5 == 0 else None)
        thread = threading.Thread(target=rclpy.spin, args=(node,), daemon=True)
        thread.start()
        rate = node.create_rate(2)
        try:
            while rclpy.ok():
                rate.sleep()
                node.note('loop')
        except ExternalShutdownException:
            pass
        finally:
            seen.extend(node.seen)

    rerun(bag, graph, [main])
    assert seen[:8] == [
        (0.0, 0), (500.0, 'loop'), (500.0, 5), (1000.0, 'loop'), (1000.0, 10), (1500.0, 'loop'),
        (1500.0, 15)]


@pytest.mark.parametrize('use', [
    lambda node: node.get_logger().info(node.publisher.topic_name),
    lambda node: node.create_client(Trigger, '/greet').wait_for_service()])
def test_a_program_ends_while_its_callback_waits(bag, graph, use):
    def main():
        rclpy.init()
        node = rclpy.create_node('short')
        node.publisher = node.create_publisher(String, '/other', 10)

        def take(message):
            node.get_clock().sleep_for(Duration(seconds=0.3))
            use(node)

        node.create_subscription(Header, '/points', take, 10)
        end = node.get_clock().now() + Duration(seconds=0.35)
        while node.get_clock().now() < end:
            rclpy.spin_once(node, timeout_sec=0.05)
        node.destroy_node()
        rclpy.shutdown()

    seen, result = run_filter(bag, graph, lambda node, number: node.note(number), main)
    assert len(seen) == 20
    assert 'after the end of its node it raised InvalidHandle' in result.warnings[-1]


def test_who_waits_by_looking_at_the_time_all_the_time(bag, graph):
    def take(node, number):
        if number == 2:
            with pytest.raises(ValueError):
                time.sleep(math.nan)
            begin = time.monotonic()
            while time.monotonic() < begin + 0.02:
                pass
            node.note('time')
            begin = node.get_clock().now()
            while node.get_clock().now() - begin < Duration(seconds=0.01):
                threading.Event().wait(0)
            node.note('clock')

    seen, _ = run_filter(bag, graph, take, all_clocks=True)
    assert seen == [(220.0, 'time'), (230.0, 'clock')]


def test_warnings(bag, graph):
    """Of what is not the same each time, what waits at the end, and what is raised after it."""
    def take(node, number):
        if number == 1:
            node.get_node_names()
        elif number == 2:
            time.time()
            time.sleep(0.0)
        elif number == 3:
            node.create_client(Trigger, '/none').wait_for_service()
        elif number == 4:
            ActionClient(node, Fibonacci, '/none').wait_for_server()
        elif number == 5:
            node.create_client(Trigger, '/none').call_async(Trigger.Request())
        elif number == 19:
            node.get_clock().sleep_for(Duration(seconds=1))
            raise ValueError('woken too early')

    _, result = run_filter(bag, graph, take, workers=3)
    names, reads, sleeps, asked, service, action, raised = result.warnings
    assert names.startswith('/filter: get_node_names asks the middleware')
    assert [warning.partition(': ')[2] for warning in (reads, sleeps)] == [
        'time.time() is not the same in each run: give --all-clocks',
        'time.sleep() takes real time: give --all-clocks']
    assert reads.startswith(f'{__file__}:') and sleeps.startswith(f'{__file__}:')
    assert asked == '/none: it is called, and no node of the run offers this service'
    assert service == '/filter:take: it still waits (for service /none)'
    assert action == '/filter:take: it still waits (for action /none)'
    assert raised.startswith(
        '/filter:take: after the end of the run it raised ValueError: woken too early, ')


def test_simulated_time_is_that_of_the_recording(tmp_path, graph):
    """The clock of the simulator went half as fast as real time."""
    bag = write_bag(tmp_path / 'in.mcap', [
        *((i * 100, '/points', Header(frame_id=str(i))) for i in range(10)),
        *((i * 20, '/clock', Clock(clock=Time(sec=5, nanosec=i * 10 * MS))) for i in range(48))])
    seen = []

    def make():
        def take(node, number):
            seen.append(node.get_clock().now().nanoseconds / MS)
            if number == 2:
                node.get_clock().sleep_for(Duration(seconds=0.1))
                seen.append(-node.get_clock().now().nanoseconds / MS)

        return Filter(take, parameter_overrides=[Parameter('use_sim_time', value=True)])

    rerun(bag, graph, [make])
    # Until the first message of the clock there is no time.
    assert seen[1:6] == [5050, 5100, 5150, -5200, 5200]


def test_who_is_there_is_known_at_once(bag, graph):
    """Also a guard condition that is triggered where it is made."""
    def fill(node):
        node.create_publisher(String, '/names', 10)
        node.create_guard_condition(lambda: node.note('guard')).trigger()
        node.note(node.count_publishers('/points'))

    def take(node, number):
        if number == 1:
            node.note((node.count_publishers('names'), node.count_subscribers('/names')))

    def other():
        node = rclpy.create_node('other')
        node.create_subscription(String, '/names', lambda message: None, 10)
        return node

    seen, _ = run_filter(bag, graph, take, other, fill=fill)
    # the rerun subscribes as well
    assert seen == [(0.0, 1), (0.0, 'guard'), (100.0, (1, 2))]


STALLS = """\
from contextlib import suppress
import socket
import sys
import threading

from mddag_executor.rerun import rerun, RerunError, run_threads
import rclpy


def reads():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
        device.bind(('127.0.0.1', 0))
        device.settimeout(0.01)
        while True:
            with suppress(TimeoutError):
                device.recv(1)  # reads is named


def computes():
    any(number for number in iter(int, 1))  # computes is named


def make():
    node = rclpy.create_node('filter')
    threading.Thread(target=function).start()
    return node


function = globals()[sys.argv[3]]  # a program has arguments of its own
run_threads._COMPUTES = 2
rclpy.init()
rclpy.create_node('first').destroy_node()  # Kilted imports a lot for it, which would count
rclpy.shutdown()
try:
    rerun(*sys.argv[1:3], [make], patience_s=0.5)
except RerunError as error:
    print(error)
"""


@pytest.mark.parametrize(('function', 'words'), [
    ('reads', ['blocking']),
    # on a busy machine it gets so little CPU time that it seems to wait
    ('computes', ['computing', 'blocking'])])
def test_a_thread_that_keeps_virtual_time_from_passing_is_named(
        tmp_path, bag, graph, function, words):
    """In a process of its own: the thread never ends."""
    (tmp_path / 'driver.py').write_text(STALLS)
    done = subprocess.run(
        [sys.executable, 'driver.py', bag, graph, function], cwd=tmp_path, capture_output=True,
        text=True, timeout=60)
    line = STALLS.partition(f'# {function} is')[0].count('\n') + 1
    where = f' at {tmp_path}/driver.py:{line} for'
    assert any(f'it has been {word}{where}' in done.stdout for word in words), done.stderr
    assert done.stdout.startswith('thread Thread-')
    assert done.stdout.count('\n') == 1
