# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The tests must fail for an executor that is broken: it is broken once in each way that matters.

Each mutation (see ``mddag_mutations``) gets a run of its own, in a child process, of a few quick
tests of this project.  One of them has to fail.  That a run hangs until its time is over is no way
to find a mistake: it does not count, and is told apart.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import contextlib
from dataclasses import dataclass, field
import json
import os
from pathlib import Path
import signal
import subprocess
import sys

import pytest

from .mddag_mutations import MEANING

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(500)]

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]
TESTS = HERE.parent.relative_to(ROOT)

HUNG_S = 50
"""After so many seconds a test of a child hangs."""
RUN_S = 170
"""A run that takes longer is ended."""
IN_PARALLEL = 3
"""So many runs at a time: their tests mostly wait."""
AT_ONCE_S = 4.0
"""A test that has failed sooner has not waited for one of its own time-outs, which are 5 s."""


@dataclass(frozen=True)
class Case:
    """
    A mutation and tests of ``test/executor`` that must notice it.

    :ivar every: each of them must notice it, else one of them.
    :ivar at_once: and by an assertion, before any time-out of the test's own.
    """

    mutation: str
    tests: list[str] = field(hash=False)
    every: bool = False
    at_once: bool = False


def of(file: str, *names: str) -> list[str]:
    """Return the ids of a file's tests."""
    return [f'{file}::{name}' for name in names]


CASES = [
    # those that take longest first
    Case('every_twentieth_lost', of(
        'test_each_runs.py', 'test_each_time_that_a_timer_is_due_counts', *(
            f'test_each_of_many_runs_once[of_{kind}]' for kind in (
                'tasks', 'subscriptions', 'services', 'guards', 'waitables'))), every=True),
    Case('create_task_does_not_wake_spin_once', of(
        'test_spin.py', 'test_what_is_new_wakes_a_spin_once_that_waits[task]')),
    Case('shutdown_leaves_wait_set', of(
        'test_spin.py', 'test_no_thread_goes_on_though_the_context_does[shutdown]')),
    Case('shutdown_leaves_workers', of(
        'test_spin.py', 'test_no_thread_goes_on_though_the_context_does[shutdown]')),
    Case('unknown_waits_not_resumed', of(
        'test_spin.py',
        'test_a_coroutine_that_awaits_something_unknown_is_asked_again[False]',
        'test_a_coroutine_that_awaits_something_unknown_is_asked_again[True]'),
        every=True),
    Case('groups_ignored', of('test_executor.py', 'test_mutually_exclusive_group_is_kept')),
    Case('rad_is_fifo', of(
        'test_deadlines.py',
        'test_ready_callbacks_run_in_the_policys_order[rad-abc]')),
    Case('depth_not_kept', of(
        'test_executor.py', 'test_queue_depth_is_kept_and_drops_are_counted')),
    Case('every_twentieth_response_lost', of(
        'test_each_runs.py', 'test_each_of_many_runs_once[of_services]')),
    Case('coroutines_not_resumed', [
        *of('test_each_runs.py', 'test_each_of_many_runs_once[of_coroutines]'),
        *of('test_like_rclpy.py',
            'test_a_coroutine_goes_on_in_the_step_after_its_future_is_done')], every=True),
    Case('tasks_go_on_by_themselves', of(
        'test_newer_rclpy.py',
        'test_a_task_awaits_one_future_after_another[await-own]')),
    Case('exceptions_swallowed', of(
        'test_spin.py', *(
            f'test_an_exception_comes_out_of_spin[{kind}]' for kind in (
                'timer', 'subscription', 'service', 'guard', 'waitable', 'task',
                'coroutine'))), every=True, at_once=True),
    Case('exceptions_of_takes_swallowed', of(
        'test_spin.py', 'test_what_fails_when_it_is_taken_comes_out_of_spin'), at_once=True),
    Case('create_task_does_not_wake_workers', of(
        'test_executor.py', 'test_create_task_wakes_an_idle_executor')),
    Case('rest_not_collected', of(
        'test_bounds.py', 'test_few_requests_wait_in_python_and_none_is_lost')),
    Case('held_subscriptions_not_released', of(
        'test_delivery.py',
        'test_messages_of_this_process_and_of_another_one_come_all_and_in_order')),
    Case('resets_of_timers_not_noticed', of(
        'test_timers.py', 'test_a_timer_that_was_cancelled_runs_when_it_is_reset[spin]')),
    Case('one_worker_at_a_time', of(
        'test_executor.py', 'test_reentrant_group_fills_all_workers')),
    Case('muted_for_ever', of(
        'test_gil.py',
        'test_what_cannot_start_is_left_in_the_middleware[elsewhere]')),
    Case('nothing_muted', of(
        'test_gil.py', 'test_what_cannot_start_is_left_in_the_middleware[elsewhere]')),
    Case('urgent_ones_muted', of(
        'test_gil.py',
        'test_it_does_so_at_once[elsewhere]')),
    Case('add_node_does_not_wake', of(
        'test_executor.py', 'test_add_node_wakes_an_idle_executor')),
    Case('release_is_when_noticed', of(
        'test_deadlines.py',
        'test_each_callback_runs_for_the_job_that_its_message_belongs_to')),
    Case('messages_go_to_the_oldest_job', of(
        'test_deadlines.py', 'test_jobs_that_overlap_and_overtake_are_told_apart')),
    Case('messages_go_to_the_job_before', of(
        'test_deadlines.py',
        'test_each_callback_runs_for_the_job_that_its_message_belongs_to')),
    Case('late_sinks_counted_in_time', of(
        'test_deadlines.py', 'test_unequal_deadlines_are_judged_apart_and_misses_are_told')),
    Case('late_jobs_counted_in_time', of(
        'test_deadlines.py', 'test_unequal_deadlines_are_judged_apart_and_misses_are_told')),
]


@dataclass
class Result:
    """What came of each test of a child: its outcome, and after how many seconds."""

    tests: dict[str, tuple[str, float]]
    output: str

    def of(self, *outcomes: str) -> set[str]:
        return {test for test, (outcome, _) in self.tests.items() if outcome in outcomes}


def run(folder: Path, mutation: str, tests: list[str], *options: str) -> Result:
    """Run tests with a broken executor ('': as it is), in a process of their own."""
    report = folder / f'{mutation}.jsonl'
    environment = {
        key: value for key, value in os.environ.items() if not key.startswith('PYTEST_')}
    environment.update(
        PYTEST_DISABLE_PLUGIN_AUTOLOAD='1', OPENBLAS_NUM_THREADS='1', TMPDIR=str(folder),
        PYTHONPATH=str(HERE), MDDAG_MUTATION=mutation, MDDAG_MUTATION_REPORT=str(report))
    child = subprocess.Popen(
        [sys.executable, '-m', 'pytest', '-q', '-p', 'pytest_timeout', '-p', 'mddag_mutations',
         '-p', 'no:cacheprovider', f'--timeout={HUNG_S}', *options,
         *(str(TESTS / test) for test in tests)],
        cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        start_new_session=True)
    output = ''
    try:
        output, _ = child.communicate(timeout=RUN_S)
    except subprocess.TimeoutExpired:
        pass  # what hung is in the report
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)  # and what it may have left
    return result(report, output)


def result(report: Path, output: str) -> Result:
    found: dict[str, tuple[str, float]] = {}
    for line in report.read_text().splitlines() if report.exists() else ():
        what = json.loads(line)
        test = Path(what['test']).relative_to(TESTS).as_posix()
        if what['outcome'] == 'begun':
            found[test] = 'hung', 0.0
        elif found[test][0] in ('hung', 'passed'):  # of a test's failures the first one tells
            found[test] = what['outcome'], what['seconds']
    return Result(found, output[-6000:])


@pytest.fixture(scope='module')
def results(request, tmp_path_factory):
    """Give the results of all cases that were asked for."""
    cases = [item.callspec.params['case'] for item in request.session.items
             if item.path == Path(__file__) and hasattr(item, 'callspec')]
    folder = tmp_path_factory.mktemp('mutations')
    with ThreadPoolExecutor(IN_PARALLEL) as pool:
        found = pool.map(lambda case: run(
            folder, case.mutation, case.tests, *([] if case.every else ['-x'])), cases)
        return dict(zip((case.mutation for case in cases), found))


def test_all_of_them_pass_while_nothing_is_broken(tmp_path):
    tests = list(dict.fromkeys(test for case in CASES for test in case.tests))
    result = run(tmp_path, '', tests)
    assert result.of('passed') == set(result.tests) == set(tests), result.output


@pytest.mark.parametrize('case', CASES, ids=lambda case: case.mutation)
def test_a_broken_executor_is_noticed(case, results):
    result = results[case.mutation]
    noticed = result.of('assertion') if case.at_once else result.of('assertion', 'error')
    hung = result.of('hung')
    what = f'{MEANING[case.mutation]} This was noticed'
    assert noticed or not hung, f'{what} by a time-out only: {hung}\n{result.output}'
    assert noticed, f'{what} by no test\n{result.output}'
    if case.every:
        assert noticed == set(case.tests), f'{what} by some tests only\n{result.output}'
    if case.at_once:
        slow = {test for test in noticed if result.tests[test][1] > AT_ONCE_S}
        assert not slow, f'{what} after waiting in vain only: {slow}'
