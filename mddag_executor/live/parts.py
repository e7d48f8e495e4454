# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What passes between a run of several processes and each of these, and the result of all.

Theory of operation
-------------------
The run makes a folder with the declaration as all processes are to have it.  Each process leaves
there, under its process id, what came of it.  Sinks are judged where they are, so the run's
verdicts are put together by the core (``core.tally.of_processes``); callbacks are counted where
they are; rules that need all of them (drift, what the synthetic nodes measured) get the sum of
what was observed.

Synthetic nodes start together in all processes, as they do in one.  So each process notes in the
folder that its nodes are *made*; when those of all are, it waits until publishers and
subscriptions have met; then it notes when it is *ready*, and starts ``LEAD_NS`` after the last of
these times.  However long another process takes for that, it is waited for; but not if it has
*ended*, which the run notes: then nobody is waited for any more.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import json
import os
from pathlib import Path
import time
from typing import Any

from mddag_executor.core.tally import of_processes
from mddag_executor.live.entity import COUNTS
from mddag_executor.live.measure import ExecutionPlan, Ledger, measure
from mddag_executor.live.session import MATCH_TIMEOUT_S, Session
from msg_graph import TaskSet
from msg_graph.binding import Entity
from msg_graph.drift import drift, Observed, Releases

LEAD_NS = 100_000_000

Results = Sequence[tuple[str, Mapping[str, Any]]]
"""The name of each process that has left a result, and that."""


@dataclass(frozen=True)
class Part:
    """
    A process of a run, as it sees itself.

    :ivar parent: the process id of the run.
    :ivar text: the declaration.
    """

    folder: Path
    parent: int
    text: str

    @classmethod
    def make(cls, folder: str, text: str) -> None:
        """Prepare the folder of a run."""
        Path(folder, 'run.json').write_text(json.dumps({'parent': os.getpid(), 'text': text}))

    @classmethod
    def read(cls, folder: str) -> Part:
        """Return what a process is to know."""
        return cls(Path(folder), **json.loads(Path(folder, 'run.json').read_text()))

    def leave(self, result: Any) -> None:
        """Leave what came of this process."""
        path = self.folder / f'{os.getpid()}.json'
        part = path.with_suffix('.part')
        part.write_text(json.dumps(result, default=list))
        part.replace(path)

    @staticmethod
    def starts(folder: str, name: str) -> None:
        """Note, in the run, that a process is going to be started, perhaps again."""
        Path(folder, f'{name}.ended').unlink(missing_ok=True)

    @staticmethod
    def ended(folder: str, name: str) -> None:
        """Note, in the run, that a process has ended."""
        Path(folder, f'{name}.ended').touch()

    def start_together(
        self, name: str, names: Sequence[str], session: Session,
        unmatched: Callable[[], list[str]], patience_s: float = MATCH_TIMEOUT_S,
    ) -> int:
        """
        Wait for the instant at which all processes start, and return it (monotonic ns).

        Not if the run is to end.

        :param unmatched: returns the topics where publishers and subscriptions have not met yet;
            ``patience_s``: for how long to wait until more of them have.
        :raises mddag_executor.live.session.SessionError: when they do not meet.
        """
        self._come_to('made', name, names, session)
        session.wait_until_matched(
            lambda: [] if self._is_left_alone() else unmatched(), patience_s)
        at = self._come_to('ready', name, names, session) + LEAD_NS
        session.wait(max(0, at - time.monotonic_ns()) / 1e9)
        return at

    def _is_left_alone(self) -> bool:
        return any(self.folder.glob('*.ended'))

    def _come_to(self, step: str, name: str, names: Sequence[str], session: Session) -> int:
        """Wait until all processes have come to a step; return when the last one did."""
        own = self.folder / f'{name}.{step}'
        part = own.with_suffix('.part')
        part.write_text(str(time.monotonic_ns()))
        part.replace(own)
        paths = [self.folder / f'{each}.{step}' for each in names]
        while not (all(path.exists() for path in paths) or self._is_left_alone()):
            if session.wait(0.01):
                break
        return max(int(path.read_text()) for path in paths if path.exists())


def left(folder: str, pid: int) -> Any:
    """Return what a process has left, None where that is nothing."""
    try:
        return json.loads(Path(folder, f'{pid}.json').read_text())
    except FileNotFoundError:
        return None


def together(task_set: TaskSet, results: Results, plan: ExecutionPlan | None) -> dict[str, Any]:
    """
    Return the result of a run from those of its processes.

    :param plan: of the synthetic nodes, where they are such.
    """
    parts = [result for _, result in results]
    callbacks = _callbacks(parts)
    ledgers = [part['ledger'] for part in parts if part['ledger'] is not None]
    every = {process.name for process in task_set.processes}
    return {
        **of_processes(task_set, results),
        'causes': {cause: sum(part['causes'][cause] for part in parts)
                   for cause in parts[0]['causes']},
        'stops': {key: sum(part['stops'][key] for part in parts)
                  for key in ('count', 'total_ns', 'misses')},
        'callbacks': callbacks,
        **{key: sum(part[key] for part in parts)
           for key in ('undeclared', 'queue', 'idle_workers', 'lent')},
        'dropped': {name: c['dropped'] for name, c in callbacks.items() if c['dropped']},
        'unattributed': {key: sum(part['unattributed'][key] for part in parts)
                         for key in ('unknown', 'doubtful')},
        'never_ran': [c.key for c in task_set.callbacks
                      if not callbacks.get(c.key, {'ran': 0})['ran']],
        # only what all of them measured has a window
        'measured': None if plan is None or {
            name for name, part in results if part['ledger'] is not None} != every else measure(
                Ledger.of_processes(task_set, ledgers), plan),
        'drift': [each.result() for each in drift(task_set, _observed(task_set, results))]}


def _callbacks(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the counts of all callbacks; some of the executors' own have the same names."""
    callbacks: dict[str, Any] = {}
    for part in parts:
        for name, counts in part['callbacks'].items():
            mine = callbacks.get(name)
            if mine is None:
                callbacks[name] = dict(counts)
                continue
            for key in (*COUNTS, 'waiting'):
                mine[key] += counts[key]
            mine['holds_interpreter'] |= counts['holds_interpreter']
            mine['interpreter_share'] = max(
                mine['interpreter_share'], counts['interpreter_share'], key=lambda s: s or 0.0)
    return callbacks


def _observed(task_set: TaskSet, results: Results) -> Observed:
    """Return what was observed of the whole system: releases, where they happened."""
    whole = Observed()
    homes = {dag.vertices[dag.source].callback.key: task_set.process_of(
        dag.vertices[dag.source].callback.node) for dag in task_set.dags}
    undeclared: list[Entity] = []
    publishes: dict[str, set[str]] = {}
    for name, result in results:
        part = result['observed']
        whole.duration_ns = max(whole.duration_ns, part['duration_ns'])
        for key, releases in part['releases'].items():
            if homes.get(key) == name:
                whole.releases[key] = Releases(**releases)
        for field in ('got', 'ran'):
            sums = getattr(whole, field)
            for key, count in part[field].items():
                sums[key] = sums.get(key, 0) + count
        for key, topics in part['publishes'].items():
            publishes.setdefault(key, set()).update(topics)
        undeclared += [Entity(*entity) for entity in part['undeclared']]
    whole.publishes = {**publishes}
    whole.undeclared = undeclared
    return whole
