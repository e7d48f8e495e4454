# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Traces of simulated runs: the replayer finds in them what the simulator found."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
import tempfile
from typing import Any

from hypothesis import example, given
from hypothesis import strategies as st
from mddag_executor.replay import replay, reschedule
from mddag_executor.replay.run_writer import write_trace
from mddag_executor.simulate import (
    draw_execution_times,
    END,
    periodic_load,
    PREEMPT,
    Settings,
    simulate,
    SimulatedRun,
    START,
)
from mddag_executor.trace import read_events
from msg_graph import load, loads
import pytest

from ..core.task_sets import Case, cases, declaration, examples

AUTOWARE = Path(__file__).resolve().parents[2] / 'config' / 'autoware.yaml'
US = 1_000
# The first one is late, which aborts the job, so the other comes too late.
TWO_SINKS_AT_ONCE = Case(loads("""\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: s, timer: 3us, dag: d, on_late: abort, publishes: [/t]}
      - {name: a, subscription: /t, deadline: 1us}
      - {name: b, subscription: /t, deadline: 1us}
"""), ((1, 1, 1),), 2, 'rad', False, 0, 0)


@pytest.fixture(scope='module')
def trace() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder, 'run.mcap')


def record(case: Case, horizon: int, trace: Path, **how: Any) -> SimulatedRun:
    run = case.run(horizon, **how)
    trace.unlink(missing_ok=True)
    write_trace(trace, case.task_set, case.load(how.get('last_release') or horizon), run)
    return run


@examples(150)
@example(case=TWO_SINKS_AT_ONCE, horizon=5, stop=False)
@given(case=cases(overheads=True), horizon=st.integers(5, 50), stop=st.booleans())
def test_the_replayer_counts_the_same(
    trace: Path, case: Case, horizon: int, stop: bool
) -> None:
    """Also with aborts, expiries, preemptions and groups; nothing contradicts anything."""
    run = record(case, horizon, trace)
    replayed = replay(trace)
    assert replayed.warnings == []
    result = replayed.result()
    for name, dag in run.result()['dags'].items():
        assert result['dags'][name]['jobs'] == dag['jobs']
        assert result['dags'][name]['ends'] == dag['ends']
        for sink, values in dag['sinks'].items():
            values.pop('demoted', None)  # a recording does not say
            found = result['dags'][name]['sinks'][sink]
            assert {key: found[key] for key in values} == values
    assert result['deadline_missed'] == run.tally.missed
    assert result['policy'] == case.policy
    assert result['preemptive'] == case.preemptive
    assert result['workers'] == case.workers
    if stop:
        stopped = record(case, horizon, trace, judge='completions', stop=True)
        assert replay(trace).result()['duration_ns'] <= stopped.ended_ns


@examples(100)
@given(case=cases(), last_release=st.integers(5, 25))
def test_rescheduled_alike_it_runs_alike(trace: Path, case: Case, last_release: int) -> None:
    """Of runs that end with everything done: elsewhere not all execution times are known."""
    horizon = last_release * (1 + sum(map(sum, case.ticks)))
    run = record(case, horizon, trace, last_release=last_release)
    if Counter(entry[1] for entry in run.log)[END] < sum(
            len(case.task_set.dags[dag].vertices) for dag in case.load(last_release).dags):
        return  # something was aborted or has expired
    rescheduled = reschedule(trace, preemptive=case.preemptive)
    result = rescheduled.result()
    for name, dag in run.result()['dags'].items():
        for sink, values in dag['sinks'].items():
            found = result['dags'][name]['sinks'][sink]
            assert {key: found[key] for key in values} == values


def test_the_events_of_a_run(tmp_path: Path) -> None:
    """A preempted job that joins two topics, worked out by hand."""
    task_set = declaration([
        {'node': '/n', 'name': 's', 'timer': '10us', 'publishes': ['/x', '/y'], 'dag': 'd'},
        {'node': '/n', 'name': 'j', 'sync': ['/x', '/y'], 'deadline': '8us'},
        {'node': '/n', 'name': 'h', 'timer': '4us', 'deadline': '2us', 'dag': 'h'}])
    load_of_run = periodic_load(task_set, [[1 * US, 4 * US], [1 * US]], 8 * US)
    run = simulate(task_set, load_of_run, Settings(
        policy='rm', workers=1, duration_ns=8 * US, preemptive=True), log=True)
    path = tmp_path / 'run.mcap'
    write_trace(path, task_set, load_of_run, run)
    events = [{key: value for key, value in event.items() if key != '_vpid'}
              for event in read_events(path)]
    assert events[0]['_name'] == 'mddag:task_set'
    assert events[0]['yaml'] == task_set.text
    assert [event['symbol'] for event in events[1:4]] == ['/n:s', '/n:j', '/n:h']
    short = [(event['_timestamp'] // US, event['_name'].split(':')[1],
              event.get('dag', event.get('callback')), event.get('vertex'), event.get('job'))
             for event in events[4:]]
    assert short == [
        (0, 'job_release', 0, None, 0), (0, 'job_release', 1, None, 0),
        (0, 'dispatch', 1, 0, 0), (0, 'callback_start', 3, None, None),
        (1, 'callback_end', 3, None, None), (1, 'complete', 1, 0, 0),
        (1, 'dispatch', 0, 0, 0), (1, 'callback_start', 1, None, None),
        (2, 'callback_end', 1, None, None), (2, 'complete', 0, 0, 0),
        (2, 'dispatch', 0, 1, 0), (2, 'callback_start', 2, None, None),
        (4, 'callback_end', 2, None, None),
        (4, 'job_release', 1, None, 1),
        (4, 'dispatch', 1, 0, 1), (4, 'callback_start', 3, None, None),
        (5, 'callback_end', 3, None, None), (5, 'complete', 1, 0, 1),
        (5, 'dispatch', 0, 1, 0), (5, 'callback_start', 2, None, None),
        (7, 'callback_end', 2, None, None), (7, 'complete', 0, 1, 0), (7, 'complete', 0, 1, 0),
        (8, 'shutdown', None, None, None)]
    dispatches = [event for event in events if event['_name'] == 'mddag:dispatch']
    assert [(d['ready'], d['reference_deadline'], d['worker']) for d in dispatches] == [
        (0, 2 * US, 0), (0, 8 * US, 0), (2 * US, 8 * US, 0), (4 * US, 6 * US, 0),
        (2 * US, 8 * US, 0)]
    completes = [event for event in events if event['_name'] == 'mddag:complete']
    assert [(c['leg'], c['last_leg'], c['completed']) for c in completes] == [
        (0, True, 1 * US), (0, True, 2 * US), (0, True, 5 * US), (0, False, 7 * US),
        (1, True, 7 * US)]


@pytest.mark.parametrize('preemptive', [False, True])
def test_autoware(tmp_path: Path, preemptive: bool) -> None:
    task_set = load(AUTOWARE)
    times = draw_execution_times(task_set, 4)
    load_of_run = periodic_load(task_set, times, 1_000_000_000)
    run = simulate(task_set, load_of_run, Settings(
        policy='wc' if not preemptive else 'rm', duration_ns=1_000_000_000,
        preemptive=preemptive), log=True)
    path = tmp_path / 'autoware.mcap'
    write_trace(path, task_set, load_of_run, run)
    kinds = Counter(event['_name'] for event in read_events(path))
    log = Counter(entry[1] for entry in run.log)
    assert kinds['mddag:dispatch'] == kinds['ros2:callback_start'] == log[START]
    assert kinds['ros2:callback_end'] == log[END] + log[PREEMPT]
    assert kinds['mddag:job_release'] == sum(run.tally.jobs)
    replayed = replay(path)
    assert replayed.warnings == []
    for name, dag in run.result()['dags'].items():
        for sink, values in dag['sinks'].items():
            found = replayed.result()['dags'][name]['sinks'][sink]
            assert {key: found[key] for key in values} == values


@pytest.mark.parametrize(('holds', 'cpus'), [('true', None), ('true', 2), ('false', 1)])
def test_what_shared_cpus_or_the_interpreter_does_so_again(
    trace: Path, holds: str, cpus: int | None
) -> None:
    """The long one is overtaken; what it waited for the other one is taken back."""
    task_set = loads(f"""\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {{name: a, timer: 40ms, deadline: 40ms, dag: a, execution_time: 22ms,
          holds_interpreter: {holds}}}
      - {{name: b, timer: 10ms, deadline: 10ms, dag: b, execution_time: 3ms,
          holds_interpreter: {holds}}}
""", 'g.yaml')
    horizon = 160_000_000
    load_ = periodic_load(task_set, draw_execution_times(task_set, 0), horizon)
    run = simulate(task_set, load_, Settings(workers=2, duration_ns=horizon, cpus=cpus), log=True)
    trace.unlink(missing_ok=True)
    write_trace(trace, task_set, load_, run)
    result = reschedule(trace).result()
    assert result['dags'] == run.result()['dags']
    assert result.get('cpus') == cpus
    response = result['dags']['a']['sinks']['/n:a']['response_ns']['median']
    assert response > 22_000_000     # it was not alone
