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
    Settings,
    simulate,
    SimulatedRun,
)
from msg_graph import loads
import pytest

from ..core.task_sets import Case, cases, examples

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


@examples(60)
@example(case=TWO_SINKS_AT_ONCE, horizon=5, stop=False)
@given(case=cases(overheads=True, newest=True), horizon=st.integers(5, 50), stop=st.booleans())
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
            found = result['dags'][name]['sinks'][sink]
            assert values.pop('demoted', 0) == found.get('demoted', 0)
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
