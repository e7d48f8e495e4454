# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The facts of a recorded run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from mddag_executor.core import NEVER
from mddag_executor.recording.columns import Ints
from mddag_executor.recording.head import Head
from msg_graph import Process, TaskSet


@dataclass(frozen=True)
class Run:
    """
    The facts of a recorded run.

    :ivar name: the recording's name in messages.
    :ivar head: settings: policy, workers, …
    :ivar task_set: numbers DAGs and vertices.
    :ivar recorded_set: the recorded DAG tasks.
    :ivar declared: whether the recording contains a declaration.
    :ivar imported: whether another executor ran it, or some of its processes.
    :ivar own_processes: the processes that this executor ran, each with its number of workers.
    :ivar same: whether the run itself was judged by ``task_set``.
    :ivar start: the first release, or when the first execution became ready, ns; None: neither.
    :ivar end: the end of the run, ns; ``shut_down``: whether it is recorded.
    :ivar judged: whether jobs that are open at the end are judged.
    :ivar judged_until: when the run was judged, ns: what was open then and past its deadline
        missed it; ``judged_order``: the position of this in the order.
    :ivar judge_from: the first judged release, ns; -NEVER: all are judged.
    :ivar judged_releases: range of judged releases, ns; None: all.
    :ivar hosted: changes of the vertices of a DAG that the process runs, by position in the order.
    :ivar processes: number of processes; ``workers_each``: their largest number of workers.
    :ivar placed: nodes of each process; empty: one process.
    :ivar links: whether ``message`` is the publication that started an execution; otherwise the
        job links them.
    :ivar unsent: if no publishers are recorded: by the vertices of an edge the jobs in which the
        message of ``may_publish`` that joins them was not published.
    :ivar messages: number of messages of an ordinary bag; None: it is a trace.
    :ivar notes: assumptions, one line each.
    """

    name: str
    head: Head
    task_set: TaskSet
    recorded_set: TaskSet
    declared: bool = True
    imported: bool = False
    own_processes: Mapping[int, int] = field(default_factory=dict)
    same: bool = True
    start: int | None = None
    end: int = 0
    shut_down: bool = False
    judged: bool = True
    judged_until: int = 0
    judged_order: int = 2 ** 62 - 1
    judge_from: int = -NEVER
    judged_releases: tuple[int, int] | None = None
    hosted: Sequence[tuple[int, int, frozenset[int]]] = ()
    processes: int = 1
    workers_each: int = 0
    placed: Sequence[Process] = ()
    links: bool = False
    unsent: Mapping[tuple[int, int], Ints] = field(default_factory=dict)
    messages: int | None = None
    notes: Sequence[str] = ()

    @property
    def begin(self) -> int:
        """Return ``start``, or the end if nothing is recorded."""
        return self.end if self.start is None else self.start
