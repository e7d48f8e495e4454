# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Callback groups that are given to an executor by themselves (rclpy#850)."""

from __future__ import annotations

import threading
import time
from typing import Any

from builtin_interfaces.msg import Time
import pytest
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Header
from std_srvs.srv import Empty

from .conftest import Spinning, wait_for


def threads_of(seen: list[str], text: str) -> bool:
    return bool(seen) and all(text in name for name in seen)


class Shared:
    """A node with a group that is run with the node and one that is added by itself."""

    def __init__(self, make_node: Any) -> None:
        self.node = make_node('shared')
        self.own = MutuallyExclusiveCallbackGroup()
        self.extra = MutuallyExclusiveCallbackGroup()
        self.runs: dict[str, list[int]] = {'own': [], 'extra': [], 'message': [], 'request': []}
        self.publisher = self.node.create_publisher(Header, '/shared', 50)
        self.timers = [
            self.node.create_timer(0.01, self.noting('own'), self.own),
            self.node.create_timer(0.01, self.noting('extra'), self.extra)]
        self.node.create_subscription(
            Header, '/shared', self.noting('message'), 50, callback_group=self.extra)
        self.node.create_service(
            Empty, '/ask', self.noting('request'), callback_group=self.extra)

    def noting(self, name: str) -> Any:
        def note(*args: Any) -> Any:
            self.runs[name].append(threading.get_native_id())
            return args[-1] if args else None
        return note

    def clear(self) -> None:
        for runs in self.runs.values():
            runs.clear()


def threads(executor: Any) -> set[int]:
    """Return the threads in which an executor runs callbacks."""
    return {seat.vtid for seat in executor._pool._seats + executor._pool._intakes}


def test_two_executors_share_a_nodes_groups(make_executor, make_node):
    shared = Shared(make_node)
    first, second = make_executor(num_workers=2), make_executor(num_workers=2)
    first.add_node(shared.node)
    second.add_callback_group(shared.extra, shared.node)
    client = make_node('client').create_client(Empty, '/ask')
    with Spinning(first), Spinning(second):
        assert wait_for(lambda: shared.publisher.get_subscription_count() == 1)
        assert client.wait_for_service(5.0)
        for _ in range(20):
            shared.publisher.publish(Header())
        for _ in range(5):
            client.call_async(Empty.Request())
        assert wait_for(lambda: len(shared.runs['message']) >= 20
                        and len(shared.runs['request']) >= 5 and len(shared.runs['own']) >= 20
                        and len(shared.runs['extra']) >= 20)
        # as long as both spin: then the first gets the group back
        runs = {name: set(each) for name, each in shared.runs.items()}
        of_first, of_second = threads(first), threads(second)
    assert runs['own'] <= of_first
    for name in ('extra', 'message', 'request'):
        assert runs[name] <= of_second
    assert len(shared.runs['message']) == 20 and len(shared.runs['request']) == 5


def test_what_is_created_in_the_group_later_runs_there_too(make_executor, make_node):
    shared = Shared(make_node)
    first, second = make_executor(num_workers=1), make_executor(num_workers=1)
    first.add_node(shared.node)
    second.add_callback_group(shared.extra, shared.node)
    with Spinning(first), Spinning(second):
        assert wait_for(lambda: shared.runs['extra'])
        shared.runs['later'] = []
        late = shared.node.create_timer(0.01, shared.noting('later'), shared.extra)
        shared.runs['else'] = []
        shared.node.create_timer(0.01, shared.noting('else'), shared.own)
        assert wait_for(lambda: len(shared.runs['later']) > 3 and len(shared.runs['else']) > 3)
        assert set(shared.runs['later']) <= threads(second)
        assert set(shared.runs['else']) <= threads(first)
        shared.node.destroy_timer(late)
        time.sleep(0.05)
        count = len(shared.runs['later'])
        time.sleep(0.05)
        assert len(shared.runs['later']) == count


def test_a_group_without_its_node_runs_alone(make_executor, make_node):
    shared = Shared(make_node)
    executor = make_executor()
    executor.add_callback_group(shared.extra, shared.node)
    assert executor.get_nodes() == []
    with Spinning(executor):
        assert wait_for(lambda: shared.runs['extra'])
        shared.runs['later'] = []
        shared.node.create_timer(0.01, shared.noting('later'), shared.extra)
        assert wait_for(lambda: shared.runs['later'])
    assert shared.runs['own'] == []


def test_a_group_changes_hands_while_both_spin_and_nothing_runs_twice(make_executor, make_node):
    shared = Shared(make_node)
    first, second = make_executor(num_workers=1), make_executor(num_workers=1)
    first.add_node(shared.node)
    stop = threading.Event()
    sent = [0]

    def elsewhere(executor: Any) -> int:
        return sum(each not in threads(executor) for each in shared.runs['message'])

    def publish() -> None:
        while not stop.wait(0.002):
            shared.publisher.publish(Header())
            sent[0] += 1

    with Spinning(first), Spinning(second):
        assert wait_for(lambda: shared.publisher.get_subscription_count() == 1
                        and shared.runs['extra'])
        thread = threading.Thread(target=publish)
        thread.start()
        try:
            for _ in range(8):
                second.add_callback_group(shared.extra, shared.node)
                shared.clear()
                assert wait_for(lambda: len(shared.runs['message']) > 3
                                and len(shared.runs['extra']) > 1 and shared.runs['own'])
                assert elsewhere(second) <= 1  # what ran there when it changed hands
                second.remove_callback_group(shared.extra)
                shared.clear()
                assert wait_for(lambda: len(shared.runs['message']) > 3
                                and len(shared.runs['extra']) > 1)
                assert elsewhere(first) <= 1  # what ran there when it changed hands
        finally:
            stop.set()
            thread.join()


def test_no_message_is_lost_or_doubled_by_a_change_of_hands(make_executor, make_node):
    node = make_node('shared')
    group = ReentrantCallbackGroup()
    got: list[int] = []
    node.create_subscription(
        Header, '/shared', lambda m: got.append(m.stamp.sec), 1000, callback_group=group)
    publisher = node.create_publisher(Header, '/shared', 1000)
    first, second = make_executor(), make_executor()
    first.add_node(node)
    with Spinning(first), Spinning(second):
        assert wait_for(lambda: publisher.get_subscription_count() == 1)
        for i in range(300):
            message = Header()
            message.stamp.sec = i
            publisher.publish(message)
            if i == 100:
                second.add_callback_group(group, node)
            if i == 200:
                second.remove_callback_group(group)
            time.sleep(0.0005)
        assert wait_for(lambda: len(got) + sum(
            sum(e.statistics()['dropped'].values()) for e in (first, second)) >= 300)
    assert len(set(got)) == len(got)


def test_a_node_changes_hands_while_both_spin(make_executor, make_node):
    """Its QoS events have one place in a wait set, which two threads would dispute."""
    nodes = [make_node(f'node_{number}') for number in range(3)]
    got: list[int] = []
    for node in nodes:
        node.create_subscription(Header, '/shared', lambda m: got.append(m.stamp.sec), 1000)
    publisher = nodes[0].create_publisher(Header, '/shared', 1000)
    executors = [make_executor(), make_executor()]
    with Spinning(executors[0]) as first, Spinning(executors[1]) as second:
        assert wait_for(lambda: all(executor.is_spinning for executor in executors))
        for move in range(200):
            for number, node in enumerate(nodes):
                one, other = executors[::1 if (move + number) % 2 else -1]
                one.remove_node(node)
                other.add_node(node)
            publisher.publish(Header())
            time.sleep(0.001 * (move % 5))
        assert wait_for(lambda: publisher.get_subscription_count() == len(nodes))
        got.clear()
        publisher.publish(Header(stamp=Time(sec=7)))
        assert wait_for(lambda: got.count(7) == len(nodes))
    assert first.error is second.error is None


def test_a_group_is_one_executors_at_most(make_executor, make_node):
    shared = Shared(make_node)
    first, second = make_executor(), make_executor()
    first.add_callback_group(shared.extra, shared.node)
    with pytest.raises(RuntimeError, match='added to an executor already'):
        second.add_callback_group(shared.extra, shared.node)
    with pytest.raises(RuntimeError, match='added to an executor already'):
        first.add_callback_group(shared.extra, shared.node)
    with pytest.raises(RuntimeError, match='not added to this executor'):
        second.remove_callback_group(shared.extra)
    first.remove_callback_group(shared.extra)
    with pytest.raises(RuntimeError, match='not added to this executor'):
        first.remove_callback_group(shared.extra)
    second.add_callback_group(shared.extra, shared.node)


def test_the_lists_of_groups(make_executor, make_node):
    shared = Shared(make_node)
    first, second = make_executor(), make_executor()
    assert first.get_all_callback_groups() == []
    first.add_node(shared.node)
    default = shared.node.default_callback_group
    assert set(first.get_all_callback_groups()) >= {shared.own, shared.extra, default}
    second.add_callback_group(shared.extra, shared.node)
    assert second.get_all_callback_groups() == second.get_manually_added_callback_groups() \
        == [shared.extra]
    assert second.get_automatically_added_callback_groups_from_nodes() == []
    assert shared.extra not in first.get_all_callback_groups()
    assert first.get_manually_added_callback_groups() == []
    assert shared.own in first.get_automatically_added_callback_groups_from_nodes()


def test_rclpys_own_executor_must_not_have_the_node(make_executor, make_node, ros_context):
    shared = Shared(make_node)
    other = SingleThreadedExecutor(context=ros_context)
    other.add_node(shared.node)
    executor = make_executor()
    with pytest.raises(RuntimeError, match='SingleThreadedExecutor'):
        executor.add_callback_group(shared.extra, shared.node)
    other.remove_node(shared.node)
    other.shutdown()


def test_a_shutdown_gives_the_groups_back(make_executor, make_node):
    shared = Shared(make_node)
    first, second = make_executor(num_workers=1), make_executor(num_workers=1)
    first.add_node(shared.node)
    second.add_callback_group(shared.extra, shared.node)
    with Spinning(first):
        with Spinning(second):
            assert wait_for(lambda: shared.runs['extra'])
            assert set(shared.runs['extra']) <= threads(second)
        shared.clear()
        assert wait_for(lambda: shared.runs['extra'])
        assert set(shared.runs['extra']) <= threads(first)


def test_a_node_that_is_destroyed_takes_its_group_along(make_executor, make_node):
    shared = Shared(make_node)
    first, second = make_executor(), make_executor()
    first.add_node(shared.node)
    second.add_callback_group(shared.extra, shared.node)
    with Spinning(first), Spinning(second):
        assert wait_for(lambda: shared.runs['extra'] and shared.runs['own'])
        shared.node.destroy_node()
        time.sleep(0.05)
        shared.clear()
        time.sleep(0.1)
        assert shared.runs['extra'] == shared.runs['own'] == []


def test_mutual_exclusion_holds_in_a_group_that_was_added_by_itself(make_executor, make_node):
    node = make_node('shared')
    group = MutuallyExclusiveCallbackGroup()
    running, most, count = [0], [0], [0]

    def body() -> None:
        running[0] += 1
        most[0] = max(most[0], running[0])
        time.sleep(0.002)
        running[0] -= 1
        count[0] += 1

    for _ in range(4):
        node.create_timer(0.005, body, group)
    executor = make_executor(num_workers=4)
    executor.add_callback_group(group, node)
    with Spinning(executor):
        assert wait_for(lambda: count[0] > 40)
    assert most[0] == 1


def test_spin_once_runs_a_group_too(make_executor, make_node):
    shared = Shared(make_node)
    executor = make_executor()
    executor.add_callback_group(shared.extra, shared.node)
    for _ in range(5):
        executor.spin_once(1.0)
    assert shared.runs['extra'] and not shared.runs['own']
