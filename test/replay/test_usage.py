# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How busy the pool was over time, and waits for callback groups."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.replay.follower import Piece
from mddag_executor.replay.groups import RecordedGroups
from mddag_executor.replay.usage import PoolUse
from mddag_executor.replay.waits import GroupWaits

STEP = PoolUse.FIRST_STEP_NS
SPANS = st.lists(st.tuples(st.integers(0, 10 ** 13), st.integers(0, 10 ** 11)), max_size=30)


@given(SPANS)
def test_no_time_is_lost_and_steps_are_few(spans: list[tuple[int, int]]) -> None:
    pool = PoolUse()
    for start, took in spans:
        pool.add(start, start + took)
    result = pool.result()
    assert sum(result['busy_ns']) == sum(took for _, took in spans)
    assert len(result['busy_ns']) <= PoolUse.MOST_STEPS
    busy = [(start, start + took) for start, took in spans if took]
    if busy:
        assert result['start_ns'] <= min(busy)[0] < result['start_ns'] + result['step_ns']
        assert result['step_ns'] % STEP == 0


def test_steps() -> None:
    pool = PoolUse()
    pool.add(10 * STEP + 7, 12 * STEP + 3)
    pool.add(10 * STEP, 10 * STEP + 5)      # beside it
    assert pool.result() == {
        'step_ns': STEP, 'start_ns': 10 * STEP, 'busy_ns': [STEP - 7 + 5, STEP, 3]}


def piece(callback: int, ready: int, start: int, end: int) -> Piece:
    return Piece(callback, 0, 0, 0, 0, ready, start, end, True)


def test_waits_for_the_group() -> None:
    groups = RecordedGroups()
    handlers = groups.handlers()
    handlers['ros2_caret:add_callback_group'](('', 0, 0, 0, 1, 50, 'mutually_exclusive'))
    handlers['ros2_caret:add_callback_group'](('', 0, 0, 0, 1, 60, 'reentrant'))
    for entity, group in ((1, 50), (2, 50), (3, 60)):
        handlers['ros2_caret:callback_group_add_timer'](('', 0, 0, 0, group, entity))
    waits = GroupWaits(groups)
    found = []
    for each in (piece(1, 0, 2, 10), piece(2, 4, 12, 20), piece(3, 5, 20, 30),
                 piece(1, 8, 25, 30), piece(9, 0, 40, 41)):
        waits.ran(each)
        found.append(waits.last)
    # the second from 4 to 10; the last of the group from 8 to 10 and from 12 to 20
    assert found == [0, 6, 0, 10, 0]
