# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Timelines: what is shown of a schedule is what its trace says; memory stays bounded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mddag_executor.core.state import SINK_IN_TIME, SINK_LATE, SINK_MISSED
from mddag_executor.replay import replay, reschedule
from mddag_executor.replay.bags_reschedule import reschedule_bag
from mddag_executor.replay.computed import ComputedRun
from mddag_executor.replay.happenings import Batch, Observer, Piece, RAN, RELEASED
from mddag_executor.replay.run_writer import write_trace
from mddag_executor.report import html
from mddag_executor.report.timeline import (
    END,
    JOB,
    MOST_UNDECLARED,
    OTHERS,
    ROW,
    START,
    Timeline,
)
from mddag_executor.simulate import periodic_load, Settings, simulate
import msg_graph
import numpy as np
import pytest

from ..replay.test_ordinary_bags import BY_HEADER, write_bag
from ..report import runs


def piece(vertex: int, job: int, start: int, end: int, worker: int = 0, callback: int = 1
          ) -> Piece:
    return Piece(callback, min(vertex, 0), vertex, job, worker, start, start, end, True)


@pytest.mark.parametrize(('policy', 'preemptive', 'utilisation', 'seed'), [
    ('rad', False, 0.95, 0), ('rad', True, 1.2, 1), ('fifo', False, 1.3, 2), ('rm', True, 0.9, 3)])
def test_a_schedule_is_told_as_its_trace_says(
    policy: str, preemptive: bool, utilisation: float, seed: int, tmp_path: Path
) -> None:
    task_set = runs.autoware()
    load, run = runs.simulated(
        task_set, policy=policy, preemptive=preemptive, utilisation=utilisation, seed=seed)
    seen = html.of_run(task_set, load, run)
    write_trace(tmp_path / 'run.mcap', task_set, load, run)
    watch = html.Watch()
    read = html.of_outcome(replay(tmp_path / 'run.mcap', more=watch.of), watch)
    assert seen.tally.result() == read.tally.result() == run.tally.result()
    assert seen.timeline.n_executions == len(seen.timeline.columns().executions[0]) > 100
    for ours, theirs in zip(seen.timeline.columns(), read.timeline.columns()):
        assert np.array_equal(ours, theirs)
    assert seen.timeline.busy_over_time.result() == read.timeline.busy_over_time.result()
    assert seen.usage.callbacks() == read.usage.callbacks()
    for sink in seen.tables.sinks:
        assert seen.chains.result(task_set, sink) == read.chains.result(task_set, sink)


class Spy(Observer):
    """Notes all that it gets, but for recorded misses, which only a recording has."""

    def __init__(self) -> None:
        self.seen: list[tuple[Any, ...]] = []

    def released(self, *what: Any) -> None:
        self.seen.append(('released', *what))

    def started(self, *what: Any) -> None:
        self.seen.append(('started', *what))

    def ran(self, *what: Any) -> None:
        self.seen.append(('ran', *what))

    def completed(self, *what: Any) -> None:
        self.seen.append(('completed', *what[:10]))     # executions have other numbers

    def ended(self, *what: Any) -> None:
        self.seen.append(('ended', *what))

    def finished(self, now: int, batch: Batch) -> None:
        self.seen.append(('finished', now))


@pytest.mark.parametrize(('settings', 'utilisation'), [
    ({'policy': 'rad'}, 0.95), ({'policy': 'rad', 'preemptive': True}, 1.2),
    ({'policy': 'fifo'}, 1.4), ({'policy': 'rad', 'stop_at_first_miss': True}, 1.5)])
def test_observers_are_told_the_same_in_the_same_order(
    settings: dict[str, Any], utilisation: float, tmp_path: Path
) -> None:
    task_set = runs.autoware()
    load, run = runs.simulated(task_set, utilisation=utilisation, **settings)
    write_trace(tmp_path / 'run.mcap', task_set, load, run)
    seen, read = Spy(), Spy()
    ComputedRun(
        task_set, load, run.log, run.decisions, 300 * runs.MS, run.ended_ns).play([seen])
    replay(tmp_path / 'run.mcap', more=lambda _: [read])
    assert len(seen.seen) > 100 and {what[0] for what in seen.seen} >= {
        'released', 'started', 'ran', 'completed', 'finished'}
    assert seen.seen == read.seen


def test_an_end_at_the_instant_of_a_release_comes_first(tmp_path: Path) -> None:
    task_set = msg_graph.loads(runs.GRAPH, 'g.yaml')
    load = periodic_load(task_set, [[5 * runs.MS, 5 * runs.MS]], 50 * runs.MS)
    run = simulate(task_set, load, Settings(workers=1, duration_ns=50 * runs.MS), log=True)
    write_trace(tmp_path / 'run.mcap', task_set, load, run)
    seen, read = Spy(), Spy()
    ComputedRun(
        task_set, load, run.log, run.decisions, 50 * runs.MS, run.ended_ns).play([seen])
    replay(tmp_path / 'run.mcap', more=lambda _: [read])
    at_ten = [what[0] for what in seen.seen if 10 * runs.MS in what and 'started' != what[0]]
    assert at_ten[:3] == ['ran', 'completed', 'released']
    assert seen.seen == read.seen


def test_jobs_that_are_given_up_and_jobs_by_another_number(tmp_path: Path) -> None:
    task_set = msg_graph.loads(
        runs.GRAPH.replace('deadline: 8ms', 'deadline: 8ms, execution_time: 30ms')
        .replace('timer: 10ms', 'timer: 10ms, execution_time: 1ms, max_active_jobs: 2'), 'g.yaml')
    load = periodic_load(task_set, [[runs.MS, 30 * runs.MS]], 100 * runs.MS)
    run = simulate(task_set, load, Settings(workers=1, duration_ns=100 * runs.MS), log=True)
    write_trace(tmp_path / 'run.mcap', task_set, load, run)
    seen, read = Spy(), Spy()
    schedule = ComputedRun(
        task_set, load, run.log, run.decisions, 100 * runs.MS, run.ended_ns,
        numbers=[[10 * job for job in range(10)]])
    schedule.play([seen])
    replay(tmp_path / 'run.mcap', more=lambda _: [read])
    place = {'released': 2, 'started': 3, 'ran': 4, 'completed': 3, 'ended': 2}
    expected = []
    for what in read.seen:
        at = place.get(what[0])
        expected.append(what if at is None else (*what[:at], 10 * what[at], *what[at + 1:]))
    assert seen.seen == expected
    assert any(what[0] == 'ended' for what in seen.seen)


@pytest.mark.parametrize('workers', [2, 7])
def test_a_rescheduled_run_has_the_verdicts_of_its_report(workers: int) -> None:
    outcome = reschedule(runs.CONFIG.parent / 'bags' / 'demo_short.mcap', workers=workers)
    data = html.of_outcome(outcome, None)
    assert data.tally.result()['dags'] == outcome.tally.result()['dags']
    executions = data.timeline.columns().executions
    busy = [int((executions[END] - executions[START])[executions[2] == w].sum())
            for w in range(workers)]
    for ours, theirs in zip(busy, outcome.busy):
        assert 0 <= theirs - ours < 200 * runs.MS   # what still ran at the end is no execution yet


def test_a_bag_has_the_verdicts_of_its_report(tmp_path: Path) -> None:
    task_set = msg_graph.loads(BY_HEADER.replace('20ms', '13ms'), 'g.yaml')
    outcome = reschedule_bag(write_bag(tmp_path / 'bag'), task_set)
    data = html.of_outcome(outcome, None)
    assert data.tally.result()['dags'] == outcome.tally.result()['dags']
    assert data.timeline.n_missed == 9 and ('assumed', outcome.notes[0]) in data.facts
    # (the tenth has no verdict: the bag ends with its release)
    # a release lies before the message that brings it
    lag = data.chains.sinks[1].worst
    assert lag is not None and lag.breakdown.release_lag_ns == 5 * runs.MS


def test_what_is_aborted_and_stopped_is_told() -> None:
    task_set = runs.autoware()
    load, run = runs.simulated(task_set, utilisation=1.5, stop_at_first_miss=True)
    assert run.ended_ns < 300 * runs.MS
    data = html.of_run(task_set, load, run)
    assert data.timeline.n_missed >= 1
    assert data.timeline.columns().executions[END].max() <= run.ended_ns


def test_detail_is_bounded_and_keeps_the_misses() -> None:
    timeline = Timeline(most=100, block=10)
    for i in range(1000):
        batch = Batch([RELEASED, RAN], {RELEASED: [(0, i, 100 * i, 100 * i)],
                                        RAN: [piece(0, i, 100 * i, 100 * i + 50)]})
        late = i in (333, 777)
        batch.decisions.append((SINK_LATE if late else SINK_IN_TIME, 0, 0, i, 100 * i + 60,
                                100 * i + (70 if late else 50)))
        batch.decided_at.append(1)
        timeline.take(batch)
    columns = timeline.columns()
    assert timeline.n_executions == 1000 and timeline.n_missed == 2
    assert timeline.kept == len(columns.executions[0]) <= 100
    assert {333, 777} <= set(columns.executions[JOB].tolist())
    assert {333, 777} <= set(columns.verdicts[1].tolist())
    jobs = columns.executions[JOB]
    assert jobs[0] == 0 and jobs[-1] >= 960
    assert int(np.diff(jobs).max()) <= 330      # what is kept is spread over the run
    for left, right in timeline.gaps():
        inside = (columns.executions[START] > left) & (columns.executions[END] < right)
        assert not inside.any() and left < right
    assert len(timeline.gaps()) >= 3
    assert sum(timeline.busy_over_time.result()['busy_ns']) == 1000 * 50
    assert sum(timeline.missed_over_time.result()['busy_ns']) == 2


def test_undeclared_callbacks_have_names_and_a_bound() -> None:
    known: Any = {7: 'spin_some'}.get
    timeline = Timeline(names=known)
    for callback in (7, 8, *range(1000, 1000 + MOST_UNDECLARED + 5)):
        timeline.take(Batch([RAN], {RAN: [piece(-1, 4, 0, 1, callback=callback)]}))
    names = timeline.undeclared_names()
    assert names[:2] == ['spin_some', None]
    assert len(names) == MOST_UNDECLARED + 1 and names[-1] == OTHERS
    rows = timeline.columns().executions
    assert int(rows[ROW].min()) == -len(names) and set(rows[JOB].tolist()) == {-1}


def test_never_completed_counts_at_its_deadline() -> None:
    timeline = Timeline()
    batch = Batch([RAN], {RAN: [piece(0, 0, 0, 10)]})
    batch.decisions.append((SINK_MISSED, 0, 0, 0, 10 ** 9, -1))
    batch.decided_at.append(0)
    timeline.take(batch)
    assert timeline.n_missed == 1
    assert timeline.columns().verdicts.T.tolist() == [[0, 0, 10 ** 9, -1, 1]]
