# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The core for drivers that run callbacks: tables, state and policy in one object."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from heapq import heappush

from mddag_executor.core import inheritance, jobs, rules
from mddag_executor.core.policies import policy
from mddag_executor.core.queues import call_next, change_key, open_outer, remove
from mddag_executor.core.state import (
    add_group,
    add_outer_group,
    add_queue,
    add_slot,
    ALONE,
    as_object,
    Decision,
    DONE,
    DROPPED,
    empty,
    fill_state,
    IDLE,
    NO_PLACE,
    OPEN,
    OUTER,
    State,
    SUSPENDED,
    WAITING,
)
from mddag_executor.core.tables import Tables


class Scheduler:
    """
    The scheduling rules bound to one run, in which messages make the edges true.

    A driver reports events in order of time; the object is not thread-safe.  Executions ``x``,
    slots, DAGs and vertices are the integers of ``core.state`` and ``core.tables``.

    :param tables: the task set's tables.
    :param n_workers: size of the bounded pool.
    :param policy_name: a row of ``core.policies``; PolicyError when there is none.
    :ivar ready: ``ready(x, now)`` makes an execution ready.
    :ivar ready_undeclared: ``ready_undeclared(job, group, holds, queue, now)`` makes an
        undeclared callback ready, and returns its execution.
    :ivar inherit: ``inherit(x, priority, like)`` lets a waiting undeclared execution inherit (rule
        15), which ``heritage(x)`` of the sending one returns.
    :ivar take: ``take(worker, now)`` dispatches the next execution on an idle worker and returns
        it; -1: there is none to run.
    :ivar complete: ``complete(x, now)`` ends a running execution; it returns False for a leg that
        did not complete its vertex.
    :ivar fail: ``fail(x, now)`` ends a failed execution; see ``complete``.
    :ivar answer: ``answer(slot, vertex, answered, now)`` completes a driven sync (rule 14).
    :ivar resume: ``resume(x, job, holds, now)`` makes a suspended execution ready to go on.
    :ivar rejoin: ``rejoin(x, job, holds, now)`` makes one that has lent its worker ready to go on.

    Functions without own logic here (``drop``, ``lend``, ``refuse``, …) are bound unchanged: see
    ``core.rules`` and ``core.jobs``.
    """

    def __init__(self, tables: Tables, n_workers: int, policy_name: str = 'rad') -> None:
        self.tables = as_object(tables)
        self.policy = policy(policy_name)
        state = empty(State)
        fill_state(
            tables, state, n_workers, propagate=0, urgency=self.policy.urgency)
        self.state = as_object(state)
        self._free_groups: list[int] = []
        self._free_queues: list[int] = []
        self._free_outer_groups: list[int] = []
        # bound here: a method would be one more call for each execution
        rule = self.tables, self.state
        self.ready: Callable[[int, int], None] = partial(
            rules.make_ready, *rule, self.policy.key)
        self.ready_undeclared: Callable[[int, int, int, int, int], int] = partial(
            rules.ready_undeclared, *rule, self.policy.key)
        self.inherit: Callable[[int, int, int], None] = partial(inheritance.inherit, *rule)
        self.heritage: Callable[[int], tuple[int, int] | None] = partial(
            inheritance.heritage, self.state)
        self.take: Callable[[int, int], int] = partial(rules.take, *rule)
        self.complete: Callable[[int, int], bool] = partial(
            rules.complete, *rule, self.policy.key)
        self.fail: Callable[[int, int], bool] = partial(rules.fail, *rule, self.policy.key)
        self.drop: Callable[[int, int], None] = partial(rules.drop, *rule)
        self.lend, self.stop_holding, self.suspend, self.refuse, self.leave_group = (
            partial(function, self.state) for function in (
                rules.lend, rules.stop_holding, rules.suspend, rules.refuse, rules.leave_group))
        self.ask_again: Callable[[int], None] = partial(rules.ask_again, self.state)
        self.go_on_without: Callable[[int], None] = partial(rules.go_on_without, self.state)
        self.resume: Callable[[int, int, int, int], None] = partial(
            rules.resume, *rule, self.policy.key)
        self.answer: Callable[[int, int, int, int], None] = partial(
            rules.answer, *rule, self.policy.key)
        self.rejoin: Callable[[int, int, int, int], None] = partial(
            rules.rejoin, *rule, self.policy.key)
        self.finish: Callable[[int], None] = partial(jobs.finish, *rule)

    def release(self, dag: int, job: int, release: int, now: int) -> int:
        """Open a job of a DAG and return its slot."""
        slot = jobs.release_job(self.tables, self.state, dag, job, release, now)
        if slot < 0:
            add_slot(self.tables, self.state, dag)
            slot = jobs.release_job(self.tables, self.state, dag, job, release, now)
        return slot

    def expect(self, dag: int, here: list[int]) -> None:
        """Set which vertices of a DAG run here, by local index; see ``core.jobs.expect``."""
        jobs.expect(self.tables, self.state, dag, here)

    def execution(self, slot: int, vertex: int, leg: int = 0) -> int:
        """Return the execution of a (global) vertex, or of one leg of it, in a job's slot."""
        return self.state.job_base[slot] + self.tables.region_offset[vertex] + leg

    def source(self, slot: int) -> int:
        """Return the execution of the source of the job in a slot."""
        return self.execution(slot, self.tables.source[self.state.job_dag[slot]])

    def give_up(self, slot: int, end: int, now: int) -> None:
        """End the job in a slot early unless it has ended already; see ``core.jobs.give_up``."""
        if self.state.job_state[slot] == OPEN:
            jobs.give_up(self.tables, self.state, slot, end, now)

    def withhold(self, slot: int, by: int, vertex: int, now: int) -> None:
        """Note that no message starts a vertex of the job in a slot (``core.jobs.withhold``)."""
        if self.state.job_state[slot] == OPEN:
            jobs.withhold_from(self.tables, self.state, slot, by, vertex, now)

    def expire_idle(self, now: int) -> None:
        """Expire every job that can no longer complete."""
        for dag in range(self.tables.n_dags):
            jobs.expire_idle(self.tables, self.state, dag, now)

    def new_group(self) -> int:
        """Add a mutually exclusive callback group and return its number."""
        for place, group in enumerate(self._free_groups):
            if self.state.group_owner[group] == -1 and not self.state.group_heap[group]:
                del self._free_groups[place]
                return group
        return add_group(self.state)

    def free_group(self, group: int) -> None:
        """Free a group's number, for reuse after its executions have ended."""
        self._free_groups.append(group)

    def new_outer_group(self) -> int:
        """Add an outer group, which is closed, and return its number."""
        state = self.state
        if self._free_outer_groups:
            used = {outer for outer, kind in zip(state.x_outer, state.x_state)
                    if kind not in (IDLE, DROPPED, DONE)}
            for place, outer in enumerate(self._free_outer_groups):
                if outer not in used and not state.outer_heap[outer]:
                    del self._free_outer_groups[place]
                    state.outer_limit[outer] = state.outer_once[outer] = 0
                    state.outer_wait[outer] = 0
                    return outer
        return add_outer_group(state)

    def free_outer_group(self, outer: int) -> None:
        """Free an outer group's number, for reuse after its executions have ended."""
        self._free_outer_groups.append(outer)

    def open_outer(self, outer: int, limit: int, once: bool = False) -> None:
        """Set how many executions of an outer group may run; see ``core.queues.open_outer``."""
        open_outer(self.state, outer, limit, int(once))

    def set_outer(self, x: int, outer: int) -> None:
        """Move an execution that has no place in its outer group to another outer group."""
        state = self.state
        before, queue = state.x_outer[x], state.x_queue[x]
        if before >= 0 and state.x_state[x] == ALONE:
            if remove(state.outer_heap[before], ~x):
                heappush(state.ready, state.x_key[x])
        elif before >= 0 and state.x_state[x] == WAITING and state.queue_place[queue] <= OUTER:
            change_key(state, queue, state.queue_key[queue])
        state.x_outer[x] = outer
        if outer < 0:  # it no longer needs a place
            state.x_place[x] = NO_PLACE
        if before >= 0:
            call_next(state, before)

    def new_queue(self) -> int:
        """Add a queue of an undeclared callback and return its number."""
        return self._free_queues.pop() if self._free_queues else add_queue(self.state)

    def free_queue(self, queue: int) -> None:
        """Free the number of an empty queue, for reuse."""
        self._free_queues.append(queue)

    def decisions(self) -> list[Decision]:
        """Return and clear the decisions since the last call."""
        taken = self.state.decisions[:]
        self.state.decisions.clear()
        return taken

    @property
    def queue_length(self) -> int:
        """Return the number of executions that wait, for a worker or for their group."""
        states = self.state.x_state
        refused = sum(map(self._is_refused, self.state.group_owner))
        return states.count(WAITING) + states.count(ALONE) + refused

    def _is_refused(self, x: int) -> bool:
        state = self.state
        return x >= 0 and state.x_state[x] == SUSPENDED and state.x_started[x] < 0
