# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What is estimated from a recording: dispatch times, waiting for groups, use of the pool."""

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor import replay
from mddag_executor.analysis.usage import group_waits, in_groups, PoolUse
from mddag_executor.recording.columns import rows
from mddag_executor.recording.head import Head
from mddag_executor.recording.recording import Recording
from mddag_executor.recording.run import Run
from mddag_executor.recording.tables import Columns, EXECUTIONS
from mddag_executor.sources.entities import Entities
from mddag_executor.whatif.dispatches import dispatch_times
import numpy as np
import pytest

from ..sources.helpers import MS, small, Written


def late(n_workers, *executions, holding=()):
    """Return how late executions began: of each worker, group, when ready, start and end."""
    worker, group, ready, start, end = (
        np.array([-1 if each is None else each for each in column], dtype=np.int64)
        for column in zip(*executions))
    order = np.argsort(end, kind='stable')
    found = np.empty(len(worker), dtype=np.int64)
    found[order] = dispatch_times(
        *(column[order] for column in (worker, group, ready, start, end)),
        [(n_workers, np.arange(len(worker)))], np.isin(order, holding))
    return found.tolist()


COMPUTE = [
    # one overtakes, one only waits: both could begin; the machine is why they did not
    (3, None, 4 * MS, 5 * MS + 7, 6 * MS), (0, None, 0, 30, 10 * MS),
    (1, None, 0, 10 * MS + 50, 20 * MS), (4, None, 12 * MS, 13 * MS + 9, 22 * MS),
    (2, None, 15 * MS, 20 * MS + 60, 30 * MS)]


@pytest.mark.parametrize(('workers', 'executions', 'expected'), [
    # an idle worker could have started it at once
    (2, [(0, None, 100, 130, 500)], [30]),
    # all are busy: it waits for its worker
    (1, [(0, None, 0, 0, 400), (0, None, 100, 430, 500)], [0, 30]),
    # its worker is busy, another one is idle
    (2, [(0, None, 0, 0, 400), (0, None, 350, 430, 500)], [0, 80]),
    # the idle worker is that of an execution which was ready before
    (2, [(0, None, 0, 0, 400), (1, None, 90, 150, 420), (0, None, 100, 430, 500)], [0, 60, 30]),
    # it waits for its group
    (7, [(0, 5, 0, 0, 400), (1, 5, 100, 410, 500)], [0, 10]),
    # meanwhile others occupy the workers
    (2, [(0, 5, 0, 0, 400), (0, None, 390, 400, 500), (0, 5, 100, 510, 600),
         (1, None, 0, 0, 600)], [0, 0, 10, 0]),
    # an unknown worker is not waited for
    (1, [(-1, None, 0, 0, 400), (-1, None, 100, 430, 500)], [0, 330]),
    # what computes is waited for: three, one after the other, by a fourth that overtakes
    (5, COMPUTE, [MS + 7, 30, 50, MS + 9, 60]),
])
def test_by_hand(workers, executions, expected):
    holding = (0, 1, 2, 4) if executions is COMPUTE else ()
    assert late(workers, *executions, holding=holding) == expected


@given(st.lists(st.tuples(st.integers(0, 50), st.integers(1, 40)), min_size=1, max_size=20))
def test_a_schedule_without_overhead_has_none(jobs):
    free = [0, 0, 0]
    executions = []
    for ready, takes in sorted(jobs):  # first come, first served
        worker = free.index(min(free))
        start = max(ready, free[worker])
        free[worker] = start + takes
        executions.append((worker, None, ready, start, free[worker]))
    assert late(3, *executions) == [0] * len(jobs)


@given(st.lists(st.tuples(st.integers(0, 10 ** 13), st.integers(0, 10 ** 11)), max_size=30))
def test_no_time_is_lost_and_steps_are_few(spans):
    starts = np.array([start for start, _ in spans], dtype=np.int64)
    took = np.array([each for _, each in spans], dtype=np.int64)
    result = PoolUse([(starts, starts + took)]).result()
    assert sum(result['busy_ns']) == int(took.sum())
    assert len(result['busy_ns']) <= PoolUse.MOST_STEPS
    busy = [(start, start + took) for start, took in spans if took]
    if busy:
        assert result['start_ns'] <= min(busy)[0] < result['start_ns'] + result['step_ns']
        assert result['step_ns'] % PoolUse.FIRST_STEP_NS == 0


def test_waits_for_the_group():
    groups = Entities(by_address=True)
    groups.take(('ros2_caret:add_callback_group', 0, 0, 0, 1, 50, 'mutually_exclusive'))
    groups.take(('ros2_caret:add_callback_group', 0, 0, 0, 1, 60, 'reentrant'))
    for entity, group in ((1, 50), (2, 50), (3, 60)):
        groups.take(('ros2:rcl_timer_init', 0, 0, 0, entity, 5))
        groups.take(('ros2:rclcpp_timer_callback_added', 0, 0, 0, entity, entity))
        groups.take(('ros2_caret:callback_group_add_timer', 0, 0, 0, group, entity))
    # callback, ready, start, end, piece; the last one runs until the end of the recording
    pieces = [(1, 0, 2, 10, 0), (2, 4, 12, 20, 0), (3, 5, 20, 30, 0), (1, 8, 25, 30, 0),
              (9, 0, 40, 41, 0), (1, 29, 42, 44, 1), (2, 43, 45, -1, 0)]
    callback, ready, start, end, piece = (list(column) for column in zip(*pieces))
    task_set = small()
    run = Run('by hand', Head(0, '', '', 'rad', 1, 0, 0, False), task_set, task_set, end=60)
    recording = Recording(run, Columns(executions=rows(
        EXECUTIONS, len(pieces), callback=callback, vertex=-1, ready=ready, began=start,
        start=start, end=end, piece=piece)), groups.names)
    # the second from 4 to 10; the third of the group from 8 to 10 and from 12 to 20
    assert group_waits(recording).tolist() == [0, 6, 0, 10, 0, 0, 1]
    (_, members, starts, ends), = in_groups(recording)
    assert members.tolist() == [0, 1, 3, 5, 6]
    assert (starts.tolist(), ends.tolist()) == ([2, 12, 25, 42, 45], [10, 20, 30, 44, 60])


def test_what_computed_and_held_the_interpreter(tmp_path):
    """Executions whose CPU time is not recorded are left out."""
    trace = Written(tmp_path / 'a.mcap', 'mddag: 1\nnodes: [{node: /n, callbacks: [{name: a, '
                    'timer: 100ms, deadline: 50ms}]}]')
    for job, (busy, computed) in enumerate(((4, (3 * MS, True)), (2, (0, False)), (9, ()))):
        trace.release(0, job, job * 100)
        trace.run(0, 0, job, job * 100, job * 100 + busy, computed=computed)
    use = replay(trace.end(300)).result()['callbacks']['/n:a']
    assert (use['executions'], use['measured'], use['measured_busy_ns']) == (3, 2, 6 * MS)
    assert (use['cpu_ns'], use['held_interpreter']) == (3 * MS, 1)
