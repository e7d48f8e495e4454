# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Warns once of declared callbacks that no node has, and suggests the ones that may be meant.

Theory of operation
-------------------
A declaration names nodes and topics.  If a program uses different names (a namespace, a remapping,
a typing error), its callbacks run without any verdict.  Two periods after the executor began to
judge, but not before ``LEAST_S``, a warning lists the declared callbacks that no entity is bound
to, each with the undeclared one that may be meant (``msg_graph.binding.suggest_entity``), and the
undeclared callbacks that have run.  There is no warning while the executor has no nodes, and none
of callbacks that may run in another process (``msg_graph.drift``).
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from mddag_executor.text import counted, listed
from msg_graph import Callback, TaskSet
from msg_graph.binding import is_background, suggest_entity
from msg_graph.drift import dags_of, may_run_elsewhere
from msg_graph.errors import printable
from rclpy.logging import get_logger

if TYPE_CHECKING:
    from mddag_executor.executor.registry import Registry

LEAST_S = 1.0
"""How long programs may take to make their nodes during a spin."""


class NameCheck:
    """Compares the names of the nodes with those of the declaration, once."""

    def __init__(
        self, task_set: TaskSet | None, registry: Registry, process: str | None
    ) -> None:
        self._task_set = task_set
        self._dags = {} if task_set is None else dags_of(task_set)
        self._registry = registry
        self._process = process
        self._begin: float | None = None
        self._done = task_set is None

    def rest_s(self) -> float | None:
        """Return the seconds until the next ``check``; None: never."""
        return None if self._done else LEAST_S

    def check(self, is_judging: bool) -> None:
        """Warn if it is time to; the spinning thread calls this repeatedly."""
        if self._done or not is_judging or not self._registry.by_id:
            return
        now = time.monotonic()
        if self._begin is None:
            self._begin = now
        if now - self._begin < LEAST_S:
            return
        missing = self._missing()
        periods = [dag.period_ns for callback in missing for dag in self._dags[callback.key]]
        if periods and now - self._begin < 2e-9 * min(periods):
            return
        self._done = True
        if missing and self._task_set is not None:
            text = unbound_text(self._task_set, missing, self._registry)
            get_logger('mddag_executor').warning(
                f'{text}: use the same names in the declaration and the nodes, or remap the nodes')

    def _missing(self) -> list[Callback]:
        assert self._task_set is not None
        elsewhere = self._registry.elsewhere(self._process)
        nodes = {entity.node for entity in self._registry.by_id.values()}
        return [callback for callback in self._registry.unbound()
                if callback.key not in elsewhere and not may_run_elsewhere(
                    callback, self._dags.get(callback.key, ()), nodes, self._task_set)]


def unbound_text(task_set: TaskSet, missing: list[Callback], registry: Registry) -> str:
    """Return one line about declared callbacks without an entity: which ones may be meant."""
    others = registry.undeclared()
    names = []
    for callback in missing:
        question = suggest_entity(callback, others)
        names.append(callback.key if question is None else f'{callback.key} ({question})')
    found = counted(len(missing), 'declared callback was', 'declared callbacks were')
    text = f'{task_set.file}: {found} found in no node: {listed(names)}'
    ran = sorted({entity.name for entity in registry.by_id.values()
                  if entity.callback is None and entity.ran and not entity.is_own
                  and entity.declarable is not None
                  and not is_background(entity.label, entity.node)})
    if ran:
        text += f'; undeclared callbacks that ran: {listed(ran)}'
    return printable(text)
