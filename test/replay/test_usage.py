# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How busy the pool was over time, and waits for callback groups."""

from __future__ import annotations

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.recording.entities import Entities
from mddag_executor.recording.head import Head
from mddag_executor.recording.tables import EXECUTIONS, Recording, rows
from mddag_executor.replay import replay
from mddag_executor.replay.usage import group_waits, PoolUse
from mddag_executor.trace import TraceFile
import numpy as np

from .helpers import add_execution, MS, small, START_TIME

STEP = PoolUse.FIRST_STEP_NS
SPANS = st.lists(st.tuples(st.integers(0, 10 ** 13), st.integers(0, 10 ** 11)), max_size=30)


@given(SPANS)
def test_no_time_is_lost_and_steps_are_few(spans: list[tuple[int, int]]) -> None:
    starts = np.array([start for start, _ in spans], dtype=np.int64)
    took = np.array([each for _, each in spans], dtype=np.int64)
    result = PoolUse(starts, starts + took).result()
    assert sum(result['busy_ns']) == int(took.sum())
    assert len(result['busy_ns']) <= PoolUse.MOST_STEPS
    busy = [(start, start + took) for start, took in spans if took]
    if busy:
        assert result['start_ns'] <= min(busy)[0] < result['start_ns'] + result['step_ns']
        assert result['step_ns'] % STEP == 0


def test_steps() -> None:
    # the second beside the first
    pool = PoolUse(np.array([10 * STEP + 7, 10 * STEP]), np.array([12 * STEP + 3, 10 * STEP + 5]))
    assert pool.result() == {
        'step_ns': STEP, 'start_ns': 10 * STEP, 'busy_ns': [STEP - 7 + 5, STEP, 3]}


def test_waits_for_the_group() -> None:
    groups = Entities(by_address=True)
    groups.take(('ros2_caret:add_callback_group', 0, 0, 0, 1, 50, 'mutually_exclusive'))
    groups.take(('ros2_caret:add_callback_group', 0, 0, 0, 1, 60, 'reentrant'))
    for entity, group in ((1, 50), (2, 50), (3, 60)):
        groups.take(('ros2:rcl_timer_init', 0, 0, 0, entity, 5))
        groups.take(('ros2:rclcpp_timer_callback_added', 0, 0, 0, entity, entity))
        groups.take(('ros2_caret:callback_group_add_timer', 0, 0, 0, group, entity))
    pieces = [(1, 0, 2, 10), (2, 4, 12, 20), (3, 5, 20, 30), (1, 8, 25, 30), (9, 0, 40, 41)]
    callback, ready, start, end = (list(column) for column in zip(*pieces))
    task_set = small()
    recording = Recording(
        'by hand', Head(0, '', '', 'rad', 1, 0, 0, False), task_set, task_set, groups,
        executions=rows(EXECUTIONS, len(pieces), callback=callback, vertex=-1, ready=ready,
                        began=start, start=start, end=end))
    # the second from 4 to 10; the last of the group from 8 to 10 and from 12 to 20
    assert group_waits(recording).tolist() == [0, 6, 0, 10, 0]


def test_what_computed_and_held_the_interpreter(tmp_path: Path) -> None:
    """Executions whose CPU time is not recorded are left out."""
    path, text = tmp_path / 'a.mcap', 'mddag: 1\nnodes: [{node: /n, callbacks: [{name: a, ' \
        'timer: 100ms, deadline: 50ms}]}]'
    took = [(4, 3, True), (2, 0, False), (9, None, False)]
    with TraceFile(path) as file:
        file.add('task_set', START_TIME, 1, 1, text, 'g.yaml', 'rad', 1, 100 * MS, 64, False)
        for job, (busy, cpu, held) in enumerate(took):
            start = START_TIME + job * 100 * MS
            end = start + busy * MS
            file.add('job_release', start, 1, 1, 0, job, start)
            add_execution(file, start, end, 0, 0, job,
                          computed=() if cpu is None else (cpu * MS, held))
    use = replay(path).result()['callbacks']['/n:a']
    assert (use['executions'], use['measured'], use['measured_busy_ns']) == (3, 2, 6 * MS)
    assert (use['cpu_ns'], use['held_interpreter']) == (3 * MS, 1)
