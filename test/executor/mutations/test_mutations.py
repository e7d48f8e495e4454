# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The tests must fail for an executor that is broken: it is broken once in each way that matters.

Each mutation gets a run of its own, in a child process, of a few quick tests of this project.  One
of them has to fail.  A run that hangs until its time is over has not found the mistake: it does
not count, and is reported as such.

In a child this file is a plugin of pytest: MDDAG_MUTATION has the changes as JSON, which are made
when a file is imported.
"""

from concurrent.futures import ThreadPoolExecutor
import contextlib
from dataclasses import dataclass, field
from importlib.machinery import SourceFileLoader
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
from xml.etree import ElementTree

import pytest

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]
TESTS = HERE.parents[1].relative_to(ROOT)

HUNG_S = 50
"""After this many seconds a test of a child hangs."""
RUN_S = 170
"""A run that takes longer is ended."""
RUN_OF_ALL_S = 450
"""The same for all tests together."""
IN_PARALLEL = 3
"""This many runs at a time: their tests mostly wait."""
AT_ONCE_S = 4.0
"""A test that has failed sooner has not waited for one of its own time-outs, which are 5 s."""


def changed(path, changes):
    """Return a file's text with some texts replaced, each of which it must contain."""
    text = path.read_text(encoding='utf-8')
    for old, new in changes:
        assert old in text, f'{path} has no longer: {old}'
        text = text.replace(old, new)
    return text


def get_code(self, name, get=SourceFileLoader.get_code):
    file = '/'.join(name.split('.')[1:]) + '.py'
    changes = [(old, new) for each, old, new in CHANGES if each == file]
    if not name.startswith('mddag_executor.') or not changes:
        return get(self, name)
    return compile(changed(Path(self.path), changes), self.path, 'exec')


if CHANGES := json.loads(os.environ.get('MDDAG_MUTATION', '[]')):
    SourceFileLoader.get_code = get_code
    # on a busy machine tests wait four times as long, here in vain: longer than HUNG_S
    os.getloadavg = lambda: (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Case:
    """
    A mutation and tests that must notice it.

    :ivar changes: file in ``mddag_executor``, old and new text of each.
    :ivar every: each of them must notice it, else one of them.
    :ivar at_once: and before any time-out of the test's own.
    """

    mutation: str
    changes: list[tuple[str, str, str]] = field(hash=False)
    tests: list[str] = field(hash=False)
    every: bool = False
    at_once: bool = False


def of(file, *names):
    """Return the ids of tests of a file, which is in ``test/executor`` if it has no folder."""
    return [f'{file if "/" in file else f"executor/{file}"}::{name}' for name in names]


UNNOTICED = """\
with self._pool.lock:
                self._engine.posted(work, self._pool.tick())"""
"""A task is ready, and no thread is woken."""

CASES = [
    # those that take longest first
    Case('every_twentieth_lost', [(
        'executor/work.py', 'def run(self, must_check: bool = True) -> Any:', """\
def run(self, must_check: bool = True) -> Any:
        if self.coroutine is None and self.entity.ran % 20 == 19:
            return None""")], of(
        'test_executor.py', 'test_each_time_that_a_timer_is_due_counts', *(
            f'test_each_of_many_runs_once[spin-of_{kind}]' for kind in (
                'tasks', 'subscriptions', 'services', 'guards', 'waitables'))), every=True),
    Case('create_task_does_not_wake_spin_once', [
        ('executor/executor.py', 'self._pool.report(self._engine.posted, work)', UNNOTICED),
        ('executor/executor.py', """\
may not check
            self._at_once.ring()""", 'may not check\n            pass')], of(
        'test_executor.py', 'test_tasks_nodes_and_entities_wake_an_idle_executor[spin_once]')),
    Case('shutdown_leaves_wait_set', [(
        'executor/waitables.py', '"""End the thread."""', 'return')], of(
        'test_spin.py', 'test_no_thread_goes_on_though_the_context_does')),
    Case('shutdown_leaves_workers', [(
        'executor/workers.py', 'self._closed = True', 'return True')], of(
        'test_spin.py', 'test_no_thread_goes_on_though_the_context_does')),
    Case('unknown_waits_not_resumed', [
        ('executor/workers.py', 'self._of_next_turn.append(work)', 'pass'),
        ('executor/workers.py',
         'self.call_at(monotonic_ns() + rest, resume)', 'pass')], of(
        'test_tasks.py',
        'test_a_coroutine_that_awaits_something_unknown_is_asked_again[installed-False]',
        'test_a_coroutine_that_awaits_something_unknown_is_asked_again[installed-True]'),
        every=True),
    Case('groups_ignored', [(
        'executor/groups.py', 'self._number(rclpy_object if decides else group)', '-1'), (
        'executor/groups.py', 'entity.exclusive = group', 'pass')], of(
        'test_executor.py', 'test_mutually_exclusive_group_is_kept')),
    Case('what_waits_for_a_group_urges_nobody', [(
        'core/rules.py', '        urge(s, owner, entry[0])', '        pass')], of(
        'test_engine.py', 'test_what_waits_for_a_callback_group_urges_its_owner[False]')),
    Case('rad_is_fifo', [(
        'core/policies.py', "Policy('rad', key_rad,", "Policy('rad', key_fifo,")], of(
        'test_deadlines.py', 'test_ready_callbacks_run_in_the_policys_order[rad-abc]')),
    Case('depth_not_kept', [(
        'executor/sources.py', 'self.depth = qos.depth', 'self.depth = 0')], of(
        'test_executor.py',
        'test_messages_that_a_group_keeps_waiting_are_as_many_as_the_qos_says')),
    Case('every_twentieth_response_lost', [(
        'executor/compat.py', 'future.set_result(response)', """\
client.completed = getattr(client, 'completed', 0) + 1
    if client.completed % 20:
        future.set_result(response)""")], of(
        'test_executor.py', 'test_each_of_many_runs_once[spin-of_services]')),
    Case('coroutines_not_resumed', [(
        'executor/engine.py', 'self._end_bypass().resume(', 'print(')], [
        *of('test_executor.py', 'test_each_of_many_runs_once[spin-of_coroutines]'),
        *of('test_tasks.py',
            'test_a_coroutine_goes_on_in_the_step_after_its_future_is_done[installed]')],
        every=True),
    Case('what_was_lent_is_not_returned', [(
        'executor/lending.py', 'if lends and me.thread is not None:', 'if False:')], of(
        'test_gil.py', 'test_others_wait_for_a_callback_that_goes_on',
        'test_a_callback_that_has_lent_its_worker_goes_on_in_order[1]',
        'test_a_callback_that_has_lent_its_worker_goes_on_in_order[7]'), every=True),
    Case('groups_of_other_executors_ignored', [(
        'executor/groups.py', 'entity.exclusive = group', 'pass')], of(
        'test_executor.py',
        'test_a_mutually_exclusive_group_is_kept_though_its_node_moves[own]',
        'test_a_mutually_exclusive_group_is_kept_though_its_node_moves[rclpy]',
        'test_a_mutually_exclusive_group_is_kept_though_two_executors_run_it'), every=True),
    Case('tasks_hold_nothing', [(
        'executor/tasks.py', 'found = self._entities[key] = self._new(outer, *name)',
        'found = self._entities[key] = self._new(outer, *name)\n'
        '            found.habit.is_declared = True')], of(
        'test_gil.py', 'test_a_task_holds_the_gil_if_its_function_does[False]',
        'test_a_task_holds_the_gil_if_its_function_does[True]'), every=True),
    Case('those_that_go_on_wait_for_ever', [(
        'executor/lending.py', 'elif work in self.rejoining and seen == (before[0], True):',
        'elif False:')], of(
        'test_gil.py', 'test_workers_that_wait_for_a_callback_do_not_keep_it_waiting[shows]')),
    Case('what_bypasses_the_core_stays_unknown', [(
        'executor/engine.py', 'self._start_next(running.worker, since)', 'pass')],
        of('test_engine.py', 'test_what_bypasses_the_core_runs_as_the_core_would_run_it')),
    Case('core_bypassed_while_it_has_others', [(
        'executor/engine.py', 'self._may_bypass and self._is_core_empty()', 'self._may_bypass')],
        of('test_engine.py', 'test_what_bypasses_the_core_runs_as_the_core_would_run_it')),
    Case('core_bypassed_while_places_are_lent', [(
        'executor/engine.py', 'max(state.outer_running, default=0) > 0', 'False')], of(
        'test_engine.py', 'test_no_message_bypasses_a_program_whose_callbacks_all_wait_for_'
        'responses[0-expected0]')),
    Case('exceptions_swallowed', [(
        'executor/executor.py', 'self._errors.append(error)', 'pass')], of(
        'test_spin.py', *(
            f'test_an_exception_comes_out_of_spin[{kind}]' for kind in (
                'timer', 'subscription', 'service', 'guard', 'waitable', 'task',
                'coroutine'))), every=True, at_once=True),
    Case('exceptions_of_takes_swallowed', [
        (f'executor/{file}.py', text, 'pass') for file, text in (
            ('sources', 'self.rooms.pool.fail(error)'), ('waitables', 'self._pool.fail(error)'))],
        of('test_spin.py', 'test_an_exception_comes_out_of_spin[take]'), at_once=True),
    Case('requests_inherit_nothing', [(
        'executor/engine.py', 'self._end_bypass().inherit(work.x, *work.heritage)', 'pass')], of(
        'test_requests.py', 'test_a_service_goes_before_what_is_less_urgent_than_its_client[spin]',
        'test_an_action_is_as_urgent_as_its_client')),
    Case('urgent_requests_wait_for_the_next_look', [(
        'executor/sent_requests.py', 'receive()', 'pass')], of(
        'test_requests.py', 'test_a_service_that_asks_another_one_passes_it_on',
        'test_the_callback_of_a_response_is_as_urgent',
        'test_an_action_is_as_urgent_as_its_client')),
    Case('create_task_does_not_wake_workers', [(
        'executor/executor.py', 'self._pool.report(self._engine.posted, work)', UNNOTICED)], of(
        'test_executor.py', 'test_tasks_nodes_and_entities_wake_an_idle_executor[spin]')),
    Case('rest_not_collected', [(
        'executor/sources.py', 'self.collect_more = partial(self.collect, MANY)', 'pass')], of(
        'test_bounds.py', 'test_few_wait_in_python_and_none_is_lost[requests]')),
    Case('subscriptions_that_publishing_threads_took_from_stay_silent', [
        ('executor/loop.py', 'self._set_mask(sources, _EDGE)', 'pass')], of(
        'test_delivery.py', 'test_a_publication_that_fails_leaves_no_subscription_deaf')),
    Case('resets_of_timers_not_noticed', [(
        'executor/timers.py', '"""Ask rcl when it is due, as it was reset."""', 'return')], of(
        'test_timers.py', 'test_a_timer_that_was_cancelled_runs_when_it_is_reset[spin]')),
    Case('parked_threads_are_not_called', [(
        'executor/workers.py', 'elif self._n_parked and not self._has_called:', 'elif False:')],
        of('test_bounds.py', 'test_blocked_calls_take_a_bounded_number_of_threads')),
    Case('threads_wait_for_events_while_a_callback_computes', [(
        'executor/workers.py', 'not self._holders or self._eager', 'True')], of(
        'test_gil.py', 'test_no_thread_waits_for_events_while_a_callback_computes[elsewhere]')),
    Case('overtaken_callbacks_do_not_pause', [(
        'executor/pausing.py', 'pause.pause_here()', 'pass')], of(
        'test_gil.py', 'test_a_callback_pauses_while_a_more_urgent_one_computes[here]')),
    Case('paused_callbacks_wait_for_ever', [(
        'executor/pausing.py', 'pauses.check(check)', 'pass')], of(
        'test_gil.py', 'test_a_callback_that_owns_a_lock_does_not_pause_for_ever[here-user]')),
    Case('threads_that_wait_for_the_gil_count_as_waiting', [(
        'executor/gil_check.py', 'abs(address - gil) >= GIL_BYTES', 'True')], of(
        'test_gil_check.py',
        'test_a_thread_that_waits_for_the_gil_is_never_taken_for_one_that_waits[0]',
        'test_a_callback_that_computes_keeps_the_gil[0]'), every=True),
    Case('nobody_looks', [(
        'executor/workers.py', """\
self.due.has_looked(now - self.offset)
                self._look()""", 'self.due.has_looked(now - self.offset)')], of(
        'test_gil.py',
        'test_arrivals_with_an_earlier_deadline_overtake_and_others_wait[elsewhere]')),
    Case('add_node_does_not_wake', [(
        'executor/executor.py', 'if added:\n            self.wake()', 'if added:\n            pass'
        )], of('test_executor.py', 'test_tasks_nodes_and_entities_wake_an_idle_executor[spin]')),
    Case('release_is_when_noticed', [(
        'executor/timers.py', 'self._report(fired)',
        'self._report((fired[0], _now(), *fired[2:]))')], of(
        'test_deadlines.py',
        'test_each_callback_runs_for_the_job_that_its_message_belongs_to')),
    Case('messages_go_to_the_oldest_open_job', [(
        'executor/engine.py', 'vertex, leg = target\n        x = ', """\
vertex, leg = target
        dag = origin.dag
        job, slot = min((
            (state.job_index[i], i) for i, of in enumerate(state.job_dag)
            if of == dag and state.job_state[i] == OPEN and state.x_state[
                state.job_base[i] + self.tables.region_offset[vertex] + leg] == IDLE),
            default=(origin.job, origin.slot))
        x = """)], of(
        'test_deadlines.py',
        'test_each_callback_runs_for_the_job_that_its_message_belongs_to')),
    Case('messages_go_to_the_job_before', [(
        'executor/attribution.py', 'publication = Publication(time_ns(), ', """\
before = globals().setdefault('BEFORE', {})
        origin, before[state.topic] = before.get(state.topic, origin), origin
        publication = Publication(time_ns(), """)], of(
        'test_deadlines.py',
        'test_each_callback_runs_for_the_job_that_its_message_belongs_to')),
    Case('late_sinks_counted_in_time', [(
        'core/tally.py', 'SINK_LATE if late else SINK_IN_TIME', 'SINK_IN_TIME')], of(
        'test_live_replay.py', 'test_replay_counts_what_the_executor_counted')),
    Case('late_jobs_counted_in_time', [(
        'core/tally.py', 'self.ends[dag][deadline] += 1',
        'self.ends[dag][COMPLETED if deadline == LATE else deadline] += 1')], of(
        'test_live_replay.py', 'test_replay_counts_what_the_executor_counted')),
    # --- interrupts.py
    Case('interrupts_come_anywhere', [(
        'executor/interrupts.py', 'elif is_second or _may_interrupt(frame):', 'elif True:')], of(
        'test_spin.py', 'test_an_interrupt_at_any_line_of_a_spin_loses_nothing[True-2]',
        'test_an_interrupt_at_any_line_of_a_spin_loses_nothing[False-14]')),
    Case('deferred_interrupts_are_lost', [(
        'executor/interrupts.py', 'self.pending[number] = True', 'pass')], of(
        'test_spin.py', 'test_an_interrupt_at_any_line_of_a_spin_loses_nothing[True-2]')),
    Case('a_second_interrupt_is_deferred_too', [(
        'executor/interrupts.py', 'elif is_second or _may_interrupt(frame):',
        'elif _may_interrupt(frame):')], of(
        'test_spin.py', 'test_a_second_interrupt_comes_at_once')),
    Case('repetitions_of_a_signal_are_handled_as_well', [(
        'executor/interrupts.py', 'return self.pending.pop(number, False)  #',
        'return self.pending.get(number, False)  #')], of(
        'test_spin.py', 'test_a_deferred_signal_is_handled_once')),
    Case('callbacks_are_not_interruptible', [(
        'executor/interrupts.py', 'if frame is not None and frame.f_code in _runs_callbacks:',
        'if False:')], of(
        'test_spin.py', *(f'test_a_callback_is_interrupted_at_once[{kind}]' for kind in (
            'sleep', 'coroutine')))),
    # --- silences.py, optional_topics.py
    Case('silences_are_not_announced', [(
        'executor/silences.py', 'self._engine.optional_topics.on_silent.append(self._announce)',
        'self._engine.optional_topics.on_silent.append(lambda *_: None)'), (
        'executor/silences.py', 'self._engine.optional_topics.on_silent.remove(self._announce)',
        'pass')], of(
        'test_other_processes.py',
        'test_a_result_that_another_machine_did_not_ask_for_is_not_due[machines]')),
    Case('silences_of_any_time_are_believed', [(
        'executor/silences.py', 'is_plausible(releases.clock.of_system(stamp), now)', 'True')],
        of('test_other_processes.py', 'test_forged_silences_are_ignored')),
    Case('silences_of_any_topic_are_believed', [(
        'executor/optional_topics.py', 'return dag >= 0 and self._expected', """\
return True or self._expected""")], of(
        'test_other_processes.py', 'test_forged_silences_are_ignored')),
    Case('what_was_not_published_stays_due', [(
        'executor/optional_topics.py', 'if topic not in published:', 'if False:')], of(
        'test_ordinary_robots.py',
        'test_results_that_nothing_was_published_for_are_not_due')),
    Case('what_was_published_is_not_due', [(
        'executor/optional_topics.py', 'if topic not in published:', 'if True:')], of(
        'test_ordinary_robots.py',
        'test_results_that_nothing_was_published_for_are_not_due')),
    Case('silences_of_one_topic_are_of_all', [(
        'executor/optional_topics.py', 'if each == topic:', 'if True:')], of(
        'test_other_processes.py',
        'test_a_result_that_another_machine_did_not_ask_for_is_not_due[machines]')),
    # --- answers.py
    Case('each_answer_is_of_the_newest_job', [(
        'executor/answers.py', """\
awaiting.named(
                topic, header_stamp(message), work.answers) or NO_ORIGIN""", 'work.answers')], of(
        'test_ordinary_robots.py',
        'test_the_stamp_of_a_result_says_which_of_several_messages_was_used')),
    Case('executions_that_publish_nothing_answer', [(
        'executor/answers.py', ' and awaiting.is_answer(work.published)', '')], of(
        'test_ordinary_robots.py', 'test_a_sync_of_two_rates[Fusion]',
        'test_the_stamp_of_a_result_says_which_of_several_messages_was_used')),
    Case('messages_without_a_job_answer_nothing', [(
        'executor/answers.py', 'awaiting.newest(self._is_open) or NO_ORIGIN', 'NO_ORIGIN')], of(
        'test_ordinary_robots.py', 'test_a_sync_of_two_rates[Fusion]',
        'test_the_stamp_of_a_result_says_which_of_several_messages_was_used')),
    # --- bypass.py
    Case('the_bypass_runs_the_last_one_first', [(
        'executor/bypass.py', 'x = next(iter(queue))', 'x = next(reversed(queue))')], of(
        'test_engine.py', 'test_what_bypasses_the_core_runs_as_the_core_would_run_it')),
    Case('the_core_does_not_hear_of_those_that_wait', [(
        'executor/bypass.py', 'self._running_since, self.queue.values()',
        'self._running_since, ()')], of(
        'test_engine.py', 'test_what_bypasses_the_core_runs_as_the_core_would_run_it')),
    Case('a_full_queue_loses_its_place', [(
        'executor/bypass.py', 'queue[first] = successor',
        'del queue[first]; queue[first] = successor')], of(
        'test_engine.py', 'test_what_bypasses_the_core_runs_as_the_core_would_run_it')),
    # --- outer_places.py
    Case('callbacks_of_a_program_run_together', [(
        'executor/outer_places.py', 'self._scheduler.open_outer(outer, limit, once)',
        'self._scheduler.open_outer(outer, 9 * limit, once)')], of(
        'test_outer_groups.py', 'test_so_many_run_at_a_time[1]',
        'test_so_many_run_at_a_time[2]'), every=True),
    Case('a_program_s_executor_runs_on_after_one_step', [(
        'executor/outer_places.py', 'self._scheduler.open_outer(outer, limit, once)',
        'self._scheduler.open_outer(outer, limit, False)')], of(
        'test_outer_groups.py', 'test_a_step_runs_one')),
    Case('what_waits_stays_in_the_group_that_its_node_has_left', [(
        'executor/outer_places.py', 'self._scheduler.set_outer(work.x, outer)', 'pass')], of(
        'test_outer_groups.py', 'test_what_waits_moves_with_its_node')),
    Case('waiting_for_a_program_is_counted_again_and_again', [(
        'executor/outer_places.py', 'self._state.outer_wait[outer] = 0', 'pass')], of(
        'test_outer_groups.py', 'test_so_many_run_at_a_time[1]')),
    # --- other_processes.py
    Case('each_message_of_a_stamp_starts_a_job', [(
        'executor/other_processes.py', 'if job is None:', 'if True:')], of(
        'test_other_processes.py', 'test_a_dag_leaves_and_comes_back_to_the_same_job')),
    Case('what_came_by_its_stamp_is_released_when_it_arrives', [(
        'executor/other_processes.py', 'self._start_job(dag, release, now)',
        'self._start_job(dag, now, now)')], of(
        'test_other_processes.py',
        'test_a_job_goes_on_in_another_executor_with_its_stamp_as_release')),
    Case('stamps_of_published_messages_are_forgotten', [(
        'executor/other_processes.py', 'self._attribution.note_headers(self.note, leaving)',
        'pass')], of(
        'test_other_processes.py', 'test_a_dag_leaves_and_comes_back_to_the_same_job')),
    Case('publications_are_not_announced', [(
        'executor/other_processes.py', 'self._attribution.announce_on(announced)', 'pass')], of(
        'test_other_processes.py', 'test_every_job_is_found_by_its_number')),
    # --- publishing.py
    Case('a_publication_that_failed_is_counted', [(
        'executor/publishing.py',
        'state.count -= 1  # the middleware has not counted it', 'pass')], of(
        'test_deadlines.py', 'test_messages_after_a_publication_that_failed_have_their_jobs')),
    Case('a_failed_publication_leaves_the_descriptors_off', [(
        'executor/publishing.py', """\
        finally:
            for delivery in deliveries:""", """\
        except ZeroDivisionError:
            pass
        else:
            for delivery in deliveries:""")], of(
        'test_delivery.py', 'test_a_publication_that_fails_leaves_no_subscription_deaf')),
    Case('publications_of_another_executor_have_jobs_here', [(
        'executor/publishing.py', 'if of is not pool:', 'if of is None:')], of(
        'test_other_processes.py',
        'test_without_a_stamp_a_message_of_another_executor_has_no_job')),
    Case('threads_publish_for_executions_that_have_ended', [(
        'executor/starters.py', 'if work.x < 0 or topic', 'if topic')], of(
        'test_starters.py',
        'test_what_is_published_otherwise_belongs_to_no_job_and_is_named[a_task_that_goes_on]')),
    Case('threads_of_pools_publish_for_the_one_that_made_them', [(
        'executor/starters.py', 'with starting_for_all():', 'if True:')], of(
        'test_starters.py',
        'test_a_pool_s_thread_works_for_no_execution_that_has_only_made_it')),
    Case('all_compute_if_the_kernel_hides_what_they_do', [(
        'executor/gil_check.py', '(not gil or abs(address - gil) >= GIL_BYTES)',
        'abs(address - gil) >= GIL_BYTES')], of(
        'test_gil_check.py',
        'test_without_proc_the_time_that_a_thread_has_computed_decides')),
    Case('nodes_that_are_added_later_publish_nothing', [(
        'executor/outside.py', 'number & (number - 1) == 0', 'number == 1')], of(
        'test_starters.py',
        'test_messages_are_counted_from_the_first_one_though_the_node_is_added_later')),
    Case('who_goes_on_in_a_closed_group_waits_behind_fresh_ones', [(
        'core/queues.py', '        _call_returning(s, heap)', '        pass')], of(
        'core/test_outer_groups.py',
        'test_several_that_go_on_in_a_closed_group_do_so_one_after_the_other')),
    Case('an_owner_that_has_awaited_something_is_not_urged', [(
        'core/queues.py', 'min(key[0], s.x_urged[x])', 'key[0]')], of(
        'test_engine.py',
        'test_the_owner_of_a_callback_group_is_urged_after_it_has_awaited_something_as_well')),
    Case('calls_keep_their_worker', [(
        'executor/publishing.py', "with running.lend(f'service {service_name(self)}'):",
        'if True:')], of(
        'test_bounds.py', 'test_blocked_calls_take_a_bounded_number_of_threads')),
    # --- lending.py, holder_check.py
    Case('what_goes_on_at_once_wakes_another_thread', [(
        'executor/lending.py', 'if is_first:', 'if False:')], of(
        'test_gil.py', 'test_a_callback_that_goes_on_at_once_wakes_no_other_thread')),
    Case('one_check_decides_who_goes_on_without_a_worker', [(
        'executor/lending.py', 'seen == (before[0], True)', 'seen[1]')], of(
        'test_gil.py', 'test_a_callback_waits_for_its_worker_while_others_end')),
    Case('who_goes_on_does_not_wait_for_the_pause', [(
        'executor/lending.py', '        me.wait_for_pause()', '        pass')], of(
        'test_gil.py', 'test_a_callback_that_goes_on_waits_until_the_less_urgent_one_pauses')),
    Case('the_time_without_a_worker_counts_as_computing', [(
        'executor/lending.py', 'measurement.pause()', 'pass')], of(
        'test_gil.py', 'test_what_is_learnt_of_callbacks')),
    Case('all_of_a_program_go_on_when_the_spin_ends', [(
        'executor/lending.py', """\
if not self._pool.engine.waits_for_place(work):
                self._go_on_without(work)""", 'self._go_on_without(work)')], of(
        'test_outer_groups.py',
        'test_those_that_have_waited_go_on_one_after_the_other_when_the_spin_ends')),
    Case('what_takes_the_interpreter_is_checked_at_the_next_event', [(
        'executor/workers.py', ' or self._interpreter.is_wanted():', ':')], of(
        'test_engine.py', *(
            f'test_what_takes_the_interpreter_is_checked_if_something_waits_for_it[{wall_ms}]'
            for wall_ms in (0, 100))), every=True),
    Case('what_was_checked_is_kept', [(
        'executor/holder_check.py', """\
self._check.end()
            self._cancel()""", 'self._cancel()')], of(
        'test_engine.py', 'test_what_nothing_waits_for_any_more_is_not_checked_and_not_kept')),
    Case('what_has_come_meanwhile_is_found_after_the_next_one', [(
        'executor/workers.py',
        'if me.thread is not None and (', 'if False and (')], of(
        'test_gil.py', 'test_what_has_come_meanwhile_is_known_before_the_next_one_is_chosen')),
    # --- attribution.py, sent_requests.py, request_ids.py
    Case('two_messages_change_known_numbers', [(
        'executor/attribution.py', '(2 if self._found == NO_NUMBER else MANY_UNLIKE)', '2')], of(
        'test_other_processes.py',
        'test_a_shift_of_known_numbers_is_learnt_of_four_messages_in_a_row')),
    Case('late_messages_change_numbers', [(
        'executor/attribution.py', 'if count <= self._found:', 'if False:')], of(
        'test_other_processes.py',
        'test_messages_that_come_after_that_of_their_publication_teach_nothing')),
    Case('requests_are_taken_later', [(
        'executor/sent_requests.py', 'self._receive(service)', 'pass')], of(
        'test_requests.py',
        'test_the_thread_that_sends_a_request_takes_it_before_it_goes_on')),
    Case('ids_of_any_middleware_are_read', [(
        'executor/request_ids.py', "if not client.implementation.startswith(b'rmw_fastrtps'):",
        'if False:')], of(
        'test_requests.py', 'test_the_id_of_a_client_is_unknown_if_the_rest_in_memory_does_not_'
        'agree[other_middleware]')),
    # --- starters.py, outside.py
    Case('what_is_being_published_is_not_due', [(
        'executor/starters.py', 'engine.attribution.note_optional(topic, origin)', 'pass')], of(
        'test_starters.py',
        'test_a_message_that_is_being_published_when_the_execution_ends_is_due')),
    Case('tasks_of_other_executors_publish_for_jobs', [(
        'executor/starters.py', ' or publishing not in (None, pool)', '')], of(
        'test_starters.py', 'test_a_task_of_another_executor_publishes_for_no_job_there')),
    Case('messages_from_outside_are_logged_again_and_again', [(
        'executor/outside.py', 'self._has_warned.add(key)', 'pass')], of(
        'test_starters.py', 'test_what_is_published_otherwise_belongs_to_no_job_and_is_named'
        '[a_thread_that_goes_on]')),
    # --- queues.py, overload.py, rules.py
    Case('what_waits_for_a_closed_group_loses_its_order', [(
        'core/queues.py', 'del heap[kept:]\n    heapify(heap)', 'del heap[kept:]')], of(
        'core/test_outer_groups.py', *(
            'test_those_that_wait_keep_their_order_when_one_goes_on_in_a_closed_group'
            f'[{seed}]' for seed in range(20)))),
    Case('waiting_for_a_program_counts_from_the_last_time', [(
        'core/rules.py', 'if s.x_aside[x] < 0 and ', 'if ')], of(
        'test_engine.py',
        'test_how_long_something_has_waited_for_its_program_counts_from_the_first_time')),
    Case('less_important_work_gives_way_to_what_gives_way', [(
        'core/overload.py', ' or gives_way(t, s, sink):', ':')], of(
        'core/test_overload.py', 'test_nothing_gives_way_to_a_late_sink_that_gives_way_itself')),
    Case('triggers_are_not_announced', [(
        'executor/publishing.py', 'announce_trigger(self.pointer)', 'pass')], of(
        'test_executor.py', 'test_each_of_many_runs_once[spin-of_guards]')),
]


@dataclass
class Result:
    """The result of each test of a child: its failures' messages, and after how many seconds."""

    tests: dict[str, tuple[str, float]]
    output: str

    def failed(self):
        return {test for test, (message, _) in self.tests.items() if message} - self.hung()

    def hung(self):
        return {test for test, (message, _) in self.tests.items() if 'Timeout' in message}


def run(folder, name, changes, tests, *options, seconds=RUN_S):
    """Run tests with a changed executor, in a process of their own."""
    report = folder / f'{name}.xml'
    environment = {
        key: value for key, value in os.environ.items() if not key.startswith('PYTEST_')}
    environment.update(
        PYTEST_DISABLE_PLUGIN_AUTOLOAD='1', OPENBLAS_NUM_THREADS='1', TMPDIR=str(folder),
        PYTHONPATH=str(HERE), MDDAG_MUTATION=json.dumps(changes))
    child = subprocess.Popen(
        [sys.executable, '-m', 'pytest', '-q', '-p', 'pytest_timeout', '-p', 'test_mutations',
         '-p', 'no:cacheprovider', f'--timeout={HUNG_S}', '--timeout-method=signal',
         f'--junitxml={report}', *options, *(str(TESTS / test) for test in tests)],
        cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        start_new_session=True)
    output = ''
    try:
        output, _ = child.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        return Result(dict.fromkeys(tests, ('Timeout', seconds)), '')
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)  # and what it may have left
    found = {}
    if not report.exists():  # it has crashed, or it could not begin
        crashed = f'ended by signal {-child.returncode}' if child.returncode < 0 else ''
        return Result(dict.fromkeys(tests, (crashed, 0.0)), output[-6000:])
    for case in ElementTree.parse(report).iter('testcase'):
        file = case.get('classname').removeprefix(f'{TESTS}.').replace('.', '/')
        test = f'{file}.py::{case.get("name")}'
        messages = [each.get('message') or 'failed' for each in case]
        found[test] = ' '.join(messages), float(case.get('time'))
    return Result(found, output[-6000:])


@pytest.fixture(scope='module')
def results(request, tmp_path_factory):
    """Give the results of all cases that were asked for."""
    cases = [item.callspec.params['case'] for item in request.session.items
             if item.path == Path(__file__) and hasattr(item, 'callspec')]
    folder = tmp_path_factory.mktemp('mutations')
    with ThreadPoolExecutor(IN_PARALLEL) as pool:
        found = pool.map(lambda case: run(
            folder, case.mutation, case.changes, case.tests,
            *([] if case.every else ['-x'])), cases)
        return dict(zip((case.mutation for case in cases), found))


def test_each_mutation_changes_the_present_executor():
    for case in CASES:
        for file, old, new in case.changes:
            compile(changed(ROOT / 'mddag_executor' / file, [(old, new)]), file, 'exec')


@pytest.mark.nightly
@pytest.mark.timeout(500)
def test_all_of_them_pass_while_nothing_is_broken(tmp_path):
    tests = list(dict.fromkeys(test for case in CASES for test in case.tests))
    result = run(tmp_path, 'unbroken', [], tests, seconds=RUN_OF_ALL_S)
    assert set(result.tests) == set(tests) and not result.failed() | result.hung(), result.output


@pytest.mark.nightly
@pytest.mark.timeout(500)
@pytest.mark.parametrize('case', CASES, ids=lambda case: case.mutation)
def test_a_broken_executor_is_noticed(case, results):
    result = results[case.mutation]
    noticed = result.failed()
    what = f'{case.mutation} was noticed'
    assert noticed, f'{what} by no test, or a time-out only: {result.hung()}\n{result.output}'
    if case.every:
        assert noticed == set(case.tests), f'{what} by some tests only\n{result.output}'
    if case.at_once:
        slow = {test for test in noticed if result.tests[test][1] > AT_ONCE_S}
        assert not slow, f'{what} after waiting in vain only: {slow}'
