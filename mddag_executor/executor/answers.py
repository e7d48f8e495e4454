# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Driven syncs in a live run: which job an execution answers (``core.driven``, rule 14).

Messages of the topic that drives a sync belong to jobs; those of its other topics belong to none.
Each execution may complete the vertex of the job that its output shows: ``Work.answers``.
"""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

from mddag_executor.core import Tables
from mddag_executor.core.driven import Awaiting
from mddag_executor.core.jobs import due_of_answer
from mddag_executor.core.state import OPEN, State
from mddag_executor.executor.attribution import header_stamp, NO_ORIGIN, Origin
from msg_graph import TaskSet

if TYPE_CHECKING:
    from mddag_executor.executor.work import Work


def open_release(state: State, origin: Origin) -> int | None:
    """Return the release of an open job, None if the job has ended."""
    slot = origin.slot
    is_open = (state.job_dag[slot] == origin.dag and state.job_index[slot] == origin.job
               and state.job_state[slot] == OPEN)
    return state.job_release[slot] if is_open else None


class Answers:
    """
    The driven syncs of a task set.

    :ivar awaiting: by the key of a callback that is a driven sync: its jobs.
    """

    def __init__(self, task_set: TaskSet | None, tables: Tables, state: State) -> None:
        self._tables = tables
        self._state = state
        self.awaiting: dict[str, Awaiting[Origin]] = {}
        self._vertices: dict[str, list[int]] = {}
        for number, vertex in enumerate(task_set.vertices if task_set else ()):
            callback = vertex.callback
            if callback.driven_by is not None:
                self._vertices.setdefault(callback.key, []).append(number)
                self.awaiting.setdefault(callback.key, Awaiting(callback))

    def due(self, key: str, now: int) -> int:
        """Return the reference absolute deadline of an execution without a job of a callback."""
        return min(due_of_answer(self._tables, self._state, vertex, now)
                   for vertex in self._vertices[key])

    def begin(self, work: Work) -> None:
        """Note the start of an execution: which job it may answer."""
        awaiting = work.entity.awaiting
        if awaiting is None or work.answers is not None:
            return  # it goes on, or is of no driven sync
        awaiting.hear(work.entity.topic)
        if work.origin is not None:
            awaiting.receive(work.origin, header_stamp(work.args[0]) if work.args else -1)
            work.answers = work.origin
        else:
            work.answers = awaiting.newest(self._is_open) or NO_ORIGIN

    @staticmethod
    def note_published(work: Work, topic: str, message: Any) -> None:
        """
        Note what an execution publishes: which job it answers.

        A thread that publishes calls this without the lock.
        """
        awaiting = work.entity.awaiting
        if awaiting is None:
            return
        work.published |= {topic}
        if work.origin is None:
            work.answers = awaiting.named(
                topic, header_stamp(message), work.answers) or NO_ORIGIN

    def job_of(self, work: Work) -> Origin | None:
        """Return the open job that an execution answers so far, if any."""
        awaiting, job = work.entity.awaiting, work.answers
        if awaiting is None or job is None or job is NO_ORIGIN or not (
                self._is_open(job) and awaiting.is_answer(work.published)):
            return None
        return job

    def completed_by(self, work: Work) -> list[Origin]:
        """Return the jobs that an execution completes the vertex of, the one it answers first."""
        awaiting, job = work.entity.awaiting, self.job_of(work)
        if awaiting is None or job is None:
            return []
        return [each for each in awaiting.answer(job) if self._is_open(each)]

    def _is_open(self, origin: Origin) -> bool:
        return open_release(self._state, origin) is not None
