# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The core in the simulator's loop against the brute-force simulator, on random task sets."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core import POLICIES
import pytest

from .brute_force import BruteForce
from .task_sets import Case, cases, examples, TICK


def compare(case: Case, horizon: int, judge: str = 'horizon', stop: bool = False,
            last_release: int | None = None) -> BruteForce:
    """Run a case both ways; every event and every verdict must be the same."""
    run = case.run(horizon, judge, stop, last_release)
    brute = BruteForce(
        case.task_set, case.ticks, tick=TICK, horizon=horizon, workers=case.workers,
        policy=case.policy, preemptive=case.preemptive, judge=judge, stop_at_first_miss=stop,
        dispatch_overhead=case.dispatch_overhead, switch_overhead=case.switch_overhead,
        last_release=last_release)
    assert case.events(run) == brute.events
    result = run.result()
    for dag in result['dags'].values():
        for sink in dag['sinks'].values():
            sink.pop('demoted', None)  # counted when it is noticed
    assert result['dags'] == brute.result()
    assert result['first_miss'] == brute.first_miss()
    assert result['deadline_missed'] == bool(brute.misses)
    assert run.ended_ns == brute.now * TICK
    return brute


@pytest.mark.parametrize('policy', POLICIES)
@examples(100)
@given(st.data(), st.integers(5, 50), st.sampled_from(['horizon', 'completions']), st.booleans())
def test_everything_at_once(
    policy: str, data: st.DataObject, horizon: int, judge: str, stop: bool
) -> None:
    """Groups, bounds, aborts and overheads, or none of them, as in the paper."""
    with_groups, with_bounds, overheads = (data.draw(st.booleans()) for _ in range(3))
    compare(data.draw(cases((policy,), groups=with_groups, bounds=with_bounds,
                            newest=with_bounds, overheads=overheads)), horizon, judge, stop)


@examples(150)
@given(cases(newest=True), st.integers(5, 30))
def test_until_all_is_done(case: Case, last_release: int) -> None:
    """Releases end and the run goes on until nothing is left: every job ends, and only once."""
    work = sum(map(sum, case.ticks))
    brute = compare(case, last_release * (1 + work), last_release=last_release)
    assert all(job.outcome for job in brute.jobs)
    assert not brute.waiting
