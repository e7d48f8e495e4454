# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A host opens and closes the callbacks of a program, and limits how many run at a time."""

import contextlib
from functools import partial
import threading
import time

from mddag_executor import open_recording
from mddag_executor.executor import lending
from msg_graph import loads
import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import Header

from .conftest import matched, Spinning, wait_for
from .declared import graph
from .inside import pool_of

FAR_S = 15.0


@pytest.mark.parametrize('limit', [1, 2])
def test_so_many_run_at_a_time(make_executor, limit):
    """And how long the others waited for them is reported once."""
    executor, lock, inside, most = make_executor(num_workers=4), threading.Lock(), [], []
    go_on = threading.Event()

    def work():
        with lock:
            inside.append(1)
            most.append(len(inside))
        go_on.wait(FAR_S)
        with lock:
            inside.pop()

    def begin():
        tasks = [executor.create_task_in(group.number, work) for _ in range(4)]
        assert wait_for(executor.create_task(lambda: None).done)    # of no group
        return tasks

    group = executor.new_outer_group()
    with Spinning(executor):
        tasks = begin()
        assert not most             # it is closed
        assert group.open(limit)
        assert wait_for(lambda: len(inside) == limit)
        tasks += begin()
        go_on.set()
        assert wait_for(lambda: all(task.done() for task in tasks))
        assert max(most) == limit
        assert group.take_wait_ns() > 0 == group.take_wait_ns()


def test_a_step_runs_one(make_executor):
    executor, ran = make_executor(num_workers=2), []
    group = executor.new_outer_group()
    with Spinning(executor):
        for number in range(3):
            executor.create_task_in(group.number, ran.append, number)
        for count in (1, 2):
            assert group.open(1, once=True)
            assert wait_for(lambda n=count: len(ran) == n)
            for _ in range(5):
                assert wait_for(executor.create_task(lambda: None).done)
            assert ran == [*range(count)]
    executor.shutdown()


@pytest.mark.parametrize('is_declared', [False, True])
@pytest.mark.parametrize('of_program', [False, True])
def test_the_times_between_spins_are_recorded(
        make_executor, make_node, tmp_path, of_program, is_declared):
    """Nothing starts then, whatever waits, and a program that turns too seldom should know it."""
    path, node, ran = tmp_path / 'run.mcap', make_node(), []
    node.create_timer(0.01, lambda: ran.append(1))
    text = graph(node='name: timer, timer: 10ms, deadline: 10ms')
    executor = make_executor(
        loads(text) if is_declared else None, num_workers=2, nodes=[node], trace=path)
    if of_program:
        group = executor.new_outer_group(True)
        executor.put(node, group)

    def turn():
        before = len(ran)
        if not of_program:
            executor.spin_once()
        else:
            group.open(1, once=True)
            assert wait_for(lambda: len(ran) > before)
        time.sleep(0.03)

    with contextlib.ExitStack() as stack:
        if of_program:
            stack.enter_context(Spinning(executor))
        for _ in range(4):
            turn()
    executor.shutdown()
    gaps = open_recording(path).spin_gaps
    gaps = gaps[gaps['program'] == (0 if of_program else -1)]
    assert len(gaps) >= 3 and (gaps['end'][:3] - gaps['start'][:3] >= 30_000_000).all()
    assert (gaps['start'][1:] >= gaps['end'][:-1]).all()


def test_a_program_that_spins_after_the_end_of_the_run_loses_no_event(make_executor, tmp_path):
    """The trace is complete then, so nothing is lost that it could have."""
    executor = make_executor(trace=tmp_path / 'run.mcap')
    group = executor.new_outer_group(True)
    group.open(1)
    executor.spin_once(0)
    executor.shutdown()
    group.open(0)
    time.sleep(0.01)
    group.open(1)
    assert executor.statistics()['trace']['lost'] == 0


def test_what_waits_moves_with_its_node(make_executor, make_node):
    """As if it had come to the group that its node belongs to now."""
    node, got = make_node(), []
    node.create_subscription(
        Header, '/a', lambda message: got.append(message.frame_id), 10,
        callback_group=ReentrantCallbackGroup())
    publisher = node.create_publisher(Header, '/a', 10)
    executor = make_executor(num_workers=1, nodes=[node])
    shut, opened = executor.new_outer_group(), executor.new_outer_group()
    executor.put(node, shut)
    with Spinning(executor):
        matched(publisher)
        for number in range(3):
            publisher.publish(Header(frame_id=str(number)))
        assert wait_for(lambda: executor.statistics()['queue'] == 3)
        opened.open(1)
        assert wait_for(executor.create_task(lambda: None).done)
        assert not got
        executor.put(node, opened)
        assert wait_for(lambda: len(got) == 3)
    assert got == ['0', '1', '2']


def test_what_is_dropped_while_it_waits_has_waited(make_executor, make_node):
    """Else an overloaded program seems to have waited only for what ran in the end."""
    node = make_node()
    node.create_subscription(
        Header, '/a', lambda message: None, 1, callback_group=ReentrantCallbackGroup())
    publisher = node.create_publisher(Header, '/a', 10)
    executor, go_on = make_executor(num_workers=2, nodes=[node]), threading.Event()
    group = executor.new_outer_group(is_single=True)
    executor.put(node, group)
    group.open(1)
    with Spinning(executor):
        matched(publisher)
        task = executor.create_task_in(group.number, go_on.wait, FAR_S)

        def has_waited():   # nothing of the group ends meanwhile
            publisher.publish(Header())
            return group.take_wait_ns() > 0

        assert wait_for(has_waited)
        assert executor.statistics()['dropped']
        go_on.set()
        assert wait_for(task.done)


def test_a_callback_that_has_waited_does_not_overlap_with_one_of_its_program(
        make_executor, monkeypatch):
    """It goes on when that one ends, though both workers are idle or wait."""
    monkeypatch.setattr(lending, 'ALONE_NS', 10 ** 15)
    monkeypatch.setattr(lending, 'REJOIN_NS', 1_000_000)
    executor, ran = make_executor(num_workers=2), []
    answer, end = threading.Event(), threading.Event()

    def asks():
        ran.append('asks')
        with executor.lend():
            answer.wait(FAR_S)
        ran.append('goes on')

    def other():
        ran.append('other')
        end.wait(FAR_S)
        ran.append('ends')

    group = executor.new_outer_group(is_single=True)
    group.open(1)
    checks = []
    all_wait = pool_of(executor).lending._all_wait
    monkeypatch.setattr(
        pool_of(executor).lending, '_all_wait', lambda known: checks.append(1) or all_wait(known))
    with Spinning(executor):
        tasks = [executor.create_task_in(group.number, asks)]
        assert wait_for(lambda: ran == ['asks'])
        tasks.append(executor.create_task_in(group.number, other))
        assert wait_for(lambda: ran == ['asks', 'other'])
        answer.set()
        assert wait_for(lambda: len(checks) > 40)
        end.set()
        assert wait_for(lambda: all(task.done() for task in tasks))
    assert ran == ['asks', 'other', 'ends', 'goes on']


def test_those_that_have_waited_go_on_one_after_the_other_when_the_spin_ends(
        make_executor, monkeypatch):
    """Neither overlaps with the one that runs then, nor with the other."""
    monkeypatch.setattr(lending, 'REJOIN_NS', 3600 * 10 ** 9)
    executor, ran, answer, end = make_executor(num_workers=2), [], threading.Event(), []
    pool = pool_of(executor)

    def asks(number):
        ran.append(f'{number} asks')
        with executor.lend():
            answer.wait(FAR_S)
        ran.append(f'{number} goes on')
        time.sleep(0.05)
        ran.append(f'{number} ends')

    def other():
        ran.append('other')
        end.append(wait_for(lambda: not pool.running))
        time.sleep(0.05)
        ran.append('ends')

    group = executor.new_outer_group(is_single=True)
    group.open(1)
    with Spinning(executor):
        for number, what in enumerate((partial(asks, 1), partial(asks, 2), other), 1):
            executor.create_task_in(group.number, what)
            assert wait_for(lambda number=number: len(ran) == number)
        answer.set()
        assert wait_for(lambda: len(pool.lending.rejoining) == 2)
    assert end == [True]
    assert ran[2:4] == ['other', 'ends'] and sorted(ran[4:]) == [
        '1 ends', '1 goes on', '2 ends', '2 goes on']
    assert [each[0] for each in ran[4:]] in (['1', '1', '2', '2'], ['2', '2', '1', '1'])


def test_a_program_waits_for_its_own_callbacks_only(make_executor):
    executor, go_on, counts = make_executor(num_workers=2), threading.Event(), []
    group = executor.new_outer_group()
    group.open(1)
    with Spinning(executor):
        for create in (executor.create_task, partial(executor.create_task_in, group.number)):
            begun = threading.Event()
            create(lambda begun=begun: (begun.set(), go_on.wait(FAR_S)))
            assert begun.wait(FAR_S)
            counts.append(group.n_running())
        go_on.set()
    assert counts == [0, 1]


def test_a_callback_does_not_wait_for_ever_for_one_of_its_program_that_waits_for_it(
        make_executor, monkeypatch):
    """After some seconds they overlap."""
    monkeypatch.setattr(lending, 'ALONE_NS', 50_000_000)
    monkeypatch.setattr(lending, 'REJOIN_NS', 1_000_000)
    executor, ran = make_executor(num_workers=2), []
    answer, has_gone_on = threading.Event(), threading.Event()

    def asks():
        ran.append('asks')
        with executor.lend():
            answer.wait(FAR_S)
        has_gone_on.set()

    def other():
        ran.append('other')
        answer.set()
        assert has_gone_on.wait(4 * FAR_S)

    group = executor.new_outer_group(is_single=True)
    group.open(1)
    with Spinning(executor):
        tasks = []
        for number, what in enumerate((asks, other), 1):
            tasks.append(executor.create_task_in(group.number, what))
            assert wait_for(lambda number=number: len(ran) == number)
        assert wait_for(has_gone_on.is_set)
        assert wait_for(lambda: all(task.done() for task in tasks))
