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
    assert result['dags'] == brute.result()
    assert result['first_miss'] == brute.first_miss()
    assert result['deadline_missed'] == bool(brute.misses)
    assert run.ended_ns == brute.now * TICK
    return brute


@pytest.mark.parametrize('policy', POLICIES)
@examples(150)
@given(st.data(), st.integers(5, 50))
def test_plain(policy: str, data: st.DataObject, horizon: int) -> None:
    """Without groups, bounds and overheads, as in the paper."""
    compare(data.draw(cases((policy,), groups=False, bounds=False)), horizon)


@pytest.mark.parametrize('policy', POLICIES)
@examples(150)
@given(st.data(), st.integers(5, 50))
def test_groups(policy: str, data: st.DataObject, horizon: int) -> None:
    compare(data.draw(cases((policy,), bounds=False)), horizon)


@examples(300)
@given(cases(groups=False), st.integers(5, 50))
def test_abort_and_bounded_jobs(case: Case, horizon: int) -> None:
    compare(case, horizon)


@examples(300)
@given(cases(overheads=True), st.integers(5, 50), st.sampled_from(['horizon', 'completions']),
       st.booleans())
def test_everything_at_once(case: Case, horizon: int, judge: str, stop: bool) -> None:
    compare(case, horizon, judge, stop)


@examples(150)
@given(cases(), st.integers(5, 30))
def test_until_all_is_done(case: Case, last_release: int) -> None:
    """Releases end and the run goes on until nothing is left: every job ends, and only once."""
    work = sum(map(sum, case.ticks))
    brute = compare(case, last_release * (1 + work), last_release=last_release)
    assert all(job.outcome for job in brute.jobs)
    assert not brute.waiting
