# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Entries that stand for several events are read as if these had been recorded one by one."""

from __future__ import annotations

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.trace import TraceWriter
from mddag_executor.trace.groups import events_of, EXECUTION, PUBLICATION
from mddag_executor.trace.trace_file import TraceFile
import pytest

from .helpers import read, START, VPID

TIME = st.integers(0, 10 ** 9)      # so near to one another that all are possible
ADDRESS = st.integers(0, 2 ** 64 - 1)
SMALL = st.integers(-1, 2 ** 31 - 1)
JOB = st.integers(-1, 2 ** 63 - 1)
EXECUTIONS = st.tuples(
    st.just(EXECUTION), TIME, SMALL, ADDRESS, SMALL, SMALL, JOB, SMALL, TIME, TIME, TIME, TIME,
    st.booleans(), SMALL, TIME, st.booleans())
PUBLICATIONS = st.tuples(st.just(PUBLICATION), TIME, SMALL, ADDRESS, ADDRESS)
SINGLE = st.tuples(st.just('callback_end'), TIME, SMALL, ADDRESS)


def one_by_one(entry):
    name, time, vtid, *rest = entry
    if name == PUBLICATION:
        publisher, message = rest
        return [('rclcpp_publish', time, vtid, publisher, message, 0),
                ('rcl_publish', time, vtid, publisher, message)]
    if name != EXECUTION:
        return [entry]
    (callback, dag, vertex, job, worker, ready, deadline, end, completed, whole, leg,
     *computed) = rest
    return [('dispatch', time, vtid, callback, dag, vertex, job, worker, ready, deadline),
            ('callback_start', time, vtid, callback, False),
            ('callback_end', end, vtid, callback),
            ('complete', completed, vtid, callback, dag, vertex, job, whole, end, leg,
             *computed)]


@given(st.lists(EXECUTIONS | PUBLICATIONS | SINGLE, max_size=30), st.integers(1, 40))
def test_a_file_is_the_same_either_way(tmp_path_factory, entries, flush_at):
    folder = tmp_path_factory.mktemp('either')
    singles = [single for entry in entries for single in one_by_one(entry)]
    for name, given_ in (('grouped', entries), ('single', singles)):
        with TraceFile(folder / name) as file:
            for number, entry in enumerate(given_):
                file.extend([entry], VPID)
                if number % flush_at == 0 and name == 'grouped':
                    file.flush()
            assert file.rejected == 0 and file.given == len(singles)
    assert read(folder / 'grouped') == read(folder / 'single')
    assert sum(map(events_of, entries)) == len(singles)


def test_chunks_stay_within_their_limit(tmp_path: Path) -> None:
    path = tmp_path / 'a.mcap'
    with TraceFile(path) as file:
        file.extend(
            [(EXECUTION, START + n, 1, n, 0, 0, n, 0, START, START, START + n, START + n, True, 0,
              500, False)
             for n in range(5000)], VPID)
    events, warnings = read(path)
    assert len(events) == 20000 and not warnings


@pytest.mark.parametrize('bad', [
    (EXECUTION, START, 1), (PUBLICATION, START, 1, 'text', 2), (PUBLICATION,),
    (EXECUTION, START, 1, -1, 0, 0, 0, 0, 0, 0, 0, 0, True, 0, 0, False)])
def test_a_bad_entry_costs_its_events_only(tmp_path: Path, bad) -> None:
    path = tmp_path / 'a.mcap'
    with TraceWriter(path, flush_interval_s=0.01) as writer:
        writer.record('callback_end', START, 1, 7)
        writer.record(*bad)
        writer.record(PUBLICATION, START, 1, 2, 3)
    events, _ = read(path)
    assert writer.dropped == events_of(bad)
    assert [e[0] for e in events if e[0].startswith('ros2:')] == [
        'ros2:callback_end', 'ros2:rclcpp_publish', 'ros2:rcl_publish']
