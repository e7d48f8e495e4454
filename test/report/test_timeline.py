# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Timelines: what is shown of a schedule is what its trace says, and no more than asked for."""

from mddag_executor import open_recording, replay, reschedule
from mddag_executor.report import html
from mddag_executor.report.timeline import Timeline
from mddag_executor.simulate import periodic_workload, Settings, simulate
from mddag_executor.whatif.bags_reschedule import reschedule_bag
from mddag_executor.whatif.computed import ComputedRun
from mddag_executor.whatif.run_writer import write_trace
import msg_graph
import numpy as np
import pytest

from ..report import runs
from ..sources.bags import BY_HEADER, write_bag


def same_tables(ours, theirs, times=1):
    """Compare recordings, the jobs of the first of which have other numbers."""
    for name in ('releases', 'executions', 'job_ends'):
        both = [getattr(each, name).records() for each in (ours, theirs)]
        both[1]['job'] *= times
        for table in both:
            if name != 'job_ends':
                table['order'] = 0      # other places in the same order
            if name == 'executions':
                table.sort(order=['end', 'start', 'vertex', 'job'])
                table['holds_gil'] = table['cpu'] = 0
            if name == 'job_ends':
                table['order'] = table['vertex'] = 0
        assert both[0].tolist() == both[1].tolist(), name


@pytest.mark.parametrize(('settings', 'utilisation'), [
    ({'policy': 'rad'}, 0.95), ({'policy': 'rad', 'preemptive': True}, 1.2),
    ({'policy': 'fifo', 'seed': 2}, 1.4), ({'policy': 'rm', 'preemptive': True, 'seed': 3}, 0.9),
    ({'policy': 'rad', 'stop_at_first_miss': True}, 1.5)])
def test_a_schedule_is_told_as_its_trace_says(settings, utilisation, tmp_path):
    task_set = runs.autoware()
    load, run = runs.simulated(task_set, utilisation=utilisation, **settings)
    write_trace(tmp_path / 'run.mcap', task_set, load, run)
    same_tables(ComputedRun(
        task_set, load, run.log, run.decisions, run.ended_ns).recording(),
        open_recording(tmp_path / 'run.mcap'))
    seen, read = html.of_run(task_set, load, run), html.of_outcome(replay(tmp_path / 'run.mcap'))
    assert seen.replay.tally.result() == read.replay.tally.result() == run.tally.result()
    assert seen.timeline.n_executions == len(seen.timeline.rows) > 50
    columns = ['vertex', 'job', 'worker', 'ready', 'start', 'end']
    ours, theirs = (sorted(
        each.replay.recording.executions[each.timeline.rows][columns].tolist())
        for each in (seen, read))
    assert ours == theirs
    columns = ['sink', 'job', 'deadline', 'completed', 'kind']
    ours, theirs = (sorted(each.timeline.verdicts[columns].tolist()) for each in (seen, read))
    assert ours == theirs
    assert seen.timeline.busy_over_time.result() == read.timeline.busy_over_time.result()
    assert seen.replay.usage.callbacks() == read.replay.usage.callbacks()
    assert seen.replay.chains.breakdown() == read.replay.chains.breakdown()


def test_jobs_that_are_given_up_and_jobs_by_another_number(tmp_path):
    task_set = msg_graph.loads(
        runs.GRAPH.replace('deadline: 8ms', 'deadline: 8ms, execution_time: 30ms')
        .replace('timer: 10ms', 'timer: 10ms, execution_time: 1ms, max_active_jobs: 2'), 'g.yaml')
    load = periodic_workload(task_set, [[runs.MS, 30 * runs.MS]], 100 * runs.MS)
    run = simulate(task_set, load, Settings(pools=(1,), duration_ns=100 * runs.MS), log=True)
    write_trace(tmp_path / 'run.mcap', task_set, load, run)
    seen = ComputedRun(
        task_set, load, run.log, run.decisions, run.ended_ns,
        numbers=[10 * np.arange(10)]).recording()
    assert len(seen.job_ends) > 1
    same_tables(seen, open_recording(tmp_path / 'run.mcap'), 10)


@pytest.mark.parametrize('workers', [2, 7])
def test_a_rescheduled_run_has_the_verdicts_of_its_report(workers):
    outcome = reschedule(runs.CONFIG.parent / 'bags' / 'demo_short.mcap', workers=workers)
    data = html.of_outcome(outcome)
    assert data.replay.tally.result()['dags'] == outcome.tally.result()['dags']
    executions = data.replay.recording.executions[data.timeline.rows]
    busy = [int((executions['end'] - executions['start'])[executions['worker'] == w].sum())
            for w in range(workers)]
    for ours, theirs in zip(busy, outcome.busy):
        # a callback that still ran at the end does not count yet
        assert 0 <= theirs - ours < 200 * runs.MS


def test_a_bag_has_the_verdicts_of_its_report(tmp_path):
    task_set = msg_graph.loads(BY_HEADER.replace('20ms', '13ms'), 'g.yaml')
    outcome = reschedule_bag(write_bag(tmp_path / 'bag'), task_set)
    data = html.of_outcome(outcome)
    assert data.replay.tally.result()['dags'] == outcome.tally.result()['dags']
    assert data.timeline.n_missed == 9 and ('assumed', outcome.notes[0]) in data.facts
    # (the tenth has no verdict: the bag ends with its release)
    # a release lies before the message that brings it
    assert data.replay.chains.breakdown()[1]['worst']['release_lag_ns'] == 5 * runs.MS


def test_detail_is_bounded_and_keeps_the_misses(tmp_path):
    outcome = replay(runs.by_hand(
        tmp_path / 'run.mcap', took=[6 if job in (333, 777) else 2 for job in range(1000)]))
    timeline = Timeline(outcome.recording, outcome.judged, most=200, block=10)
    assert timeline.n_executions == 2001 and timeline.n_missed == 2
    executions = outcome.recording.executions[timeline.rows]
    assert len(executions) <= 200
    jobs = executions['job'][executions['vertex'] >= 0]
    for job in (333, 777):
        assert (jobs == job).sum() == 2 and job in timeline.verdicts['job']
    assert jobs[0] == 0 and jobs[-1] >= 960
    assert int(np.diff(jobs).max()) <= 330      # what is shown is spread over the run
    for left, right in timeline.gaps:
        inside = (executions['start'] > left) & (executions['end'] < right)
        assert not inside.any() and left < right
    assert len(timeline.gaps) >= 3
    assert sum(timeline.busy_over_time.result()['busy_ns']) == (998 * 5 + 2 * 9) * runs.MS
    assert sum(timeline.missed_over_time.result()['busy_ns']) == 2
