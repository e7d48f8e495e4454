# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Job sets for schedule-abstraction analysis, and what comes back."""

from __future__ import annotations

from pathlib import Path
import random
import sys

from mddag_executor.analysis import analyse, AnalysisError, HOLDS, NOTHING, sag, tasks_of
from mddag_executor.analysis.verdicts import with_sag
from mddag_executor.simulate import periodic_load, Settings, simulate
from msg_graph import loads
import pytest

from .test_against_simulation import budgets_of, HORIZON, random_graph

STAND_IN = Path(__file__).with_name('stand_in_nptest.py')
GRAPH = """\
mddag: 1
nodes:
  - node: /a
    callbacks:
      - {name: t, timer: 10ms, publishes: [/x], execution_time: {quantiles_us: [100, 2000]}}
      - {name: s, subscription: /x, deadline: 8ms, execution_time: 1ms}
  - node: /b
    callbacks:
      - {name: t, timer: 15ms, deadline: 15ms, execution_time: 3ms}
"""


@pytest.fixture
def nptest(tmp_path: Path) -> str:
    """Make a program of the stand-in."""
    path = tmp_path / 'nptest'
    path.write_text(f'#!/bin/sh\nexec {sys.executable} {STAND_IN} "$@"\n')
    path.chmod(0o755)
    return str(path)


def write(folder: Path, jobs: sag.JobSet) -> None:
    (folder / sag.JOBS).write_text(jobs.jobs)
    (folder / sag.EDGES).write_text(jobs.edges)


def test_tables() -> None:
    jobs = sag.job_set(tasks_of(loads(GRAPH)))
    assert jobs.jobs.splitlines() == [
        'Task ID,Job ID,Arrival min,Arrival max,Cost min,Cost max,Deadline,Priority',
        '1,0,0,0,100000,2000000,8000000,8000000', '3,0,0,0,1000000,1000000,8000000,8000000',
        '1,1,10000000,10000000,100000,2000000,18000000,18000000',
        '3,1,10000000,10000000,1000000,1000000,18000000,18000000',
        '1,2,20000000,20000000,100000,2000000,28000000,28000000',
        '3,2,20000000,20000000,1000000,1000000,28000000,28000000',
        '2,0,0,0,3000000,3000000,15000000,15000000',
        '2,1,15000000,15000000,3000000,3000000,30000000,30000000']
    assert jobs.edges.splitlines()[1:] == ['1,0,3,0', '1,1,3,1', '1,2,3,2']
    assert jobs.tasks.splitlines()[1:] == ['1,"/a","/a:t"', '2,"/b","/b:t"', '3,"/a","/a:s"']
    assert (jobs.size, jobs.horizon, jobs.for_ever) == (8, 30_000_000, True)
    assert not sag.job_set(tasks_of(loads(GRAPH)), 20_000_000).for_ever
    assert not sag.job_set(tasks_of(loads(GRAPH.replace('8ms', '11ms')))).for_ever


def test_too_many_jobs() -> None:
    text = GRAPH.replace('15ms', '9.999989ms')
    with pytest.raises(AnalysisError, match='give a shorter --horizon'):
        sag.job_set(tasks_of(loads(text)))
    assert sag.job_set(tasks_of(loads(text)), 50_000_000).size == 16


def test_answers(tmp_path: Path, nptest: str) -> None:
    task_set = loads(GRAPH)
    tasks, analysis = tasks_of(task_set), analyse(task_set, 1)
    jobs = sag.job_set(tasks)
    write(tmp_path, jobs)
    answer = sag.ask(nptest, tmp_path, 1, 10)
    assert answer == sag.Answer(True, 8, 9, False)
    verdict = with_sag(analysis, tasks, jobs, answer).verdicts[-1]
    assert (verdict.verdict, verdict.figure) == (HOLDS, '8 jobs, 9 states')
    late = with_sag(analysis, tasks, jobs, sag.ask(nptest, tmp_path, 1, 1)).verdicts[-1]
    assert (late.verdict, late.reason) == (NOTHING, 'it ran out of time')
    short = with_sag(analysis, tasks, sag.job_set(tasks, 10_000_000), answer).verdicts[-1]
    assert short.verdict == NOTHING
    assert short.reason.startswith('proven only for the releases before 10ms')
    grouped = tasks_of(loads(GRAPH.replace('name: s,', 'name: s, group: g,')))
    assert with_sag(analysis, grouped, jobs, answer).verdicts[-1].verdict == NOTHING


@pytest.mark.parametrize('script', ['echo hello', 'exit 3', 'echo a, 2, 3, 4, 5, 6, 7, 8, 0, 1',
                                    'echo a, 1, 3, 4, 5, 6, 7, 8, 0, 1; exit 1'])
def test_answers_that_make_no_sense(tmp_path: Path, script: str) -> None:
    program = tmp_path / 'nptest'
    program.write_text(f'#!/bin/sh\n{script}\n')
    program.chmod(0o755)
    with pytest.raises(AnalysisError, match='its answer makes no sense'):
        sag.ask(str(program), tmp_path, 1, 10)
    with pytest.raises(AnalysisError, match='it cannot be run'):
        sag.ask(str(tmp_path / 'none'), tmp_path, 1, 10)


def test_the_tables_say_what_the_core_does(tmp_path: Path, nptest: str) -> None:
    """Constant costs: the job set, run by its own rules, misses when the simulator does."""
    from .stand_in_nptest import misses, rows
    seen = set()
    for seed in range(40):
        workers = 1 + seed % 3
        task_set = loads(random_graph(seed, seed % 2 == 0, 3, 0.33 * workers * (
            0.5 + random.Random(seed).random())))
        jobs = sag.job_set(tasks_of(task_set), HORIZON)
        write(tmp_path, jobs)
        late = misses(rows(str(tmp_path / sag.JOBS), 8), rows(str(tmp_path / sag.EDGES), 4),
                      workers)
        load = periodic_load(task_set, budgets_of(task_set), HORIZON)
        run = simulate(task_set, load, Settings(
            policy='rad', workers=workers, duration_ns=3 * HORIZON, preemptive=False))
        assert late == bool(run.result()['deadline_missed']), seed
        seen.add(late)
    assert seen == {False, True}
