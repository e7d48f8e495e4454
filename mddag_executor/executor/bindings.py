# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Which declared callback each entity is, and which declared callbacks have no entity.

Theory of operation
-------------------
A declaration names nodes and topics.  An entity that appears is bound to the declared callback
that fits (``msg_graph.binding``), and is undeclared if there is none.  When it disappears, the
callback is free for the next one.

If a program uses different names (a namespace, a remapping, a typing error), its callbacks run
without any verdict.  Two periods after the executor began to judge, but not before ``LEAST_S``, a
warning lists the declared callbacks that no entity is bound to, each with the undeclared one that
may be meant (``msg_graph.binding.suggest_entity``), and the undeclared callbacks that have run.
There is no warning while the executor has no nodes, and none of callbacks that may run in another
process (``msg_graph.drift``).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import time

from mddag_executor.core.jobs import source_depth
from mddag_executor.executor.bounds import REMEMBERED
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.entity import Entity, link
from mddag_executor.text import counted, listed
from msg_graph import binding, Callback, TaskSet
from msg_graph.drift import dags_of, may_run_elsewhere
from msg_graph.errors import printable
from rclpy.logging import get_logger

LEAST_S = 1.0
"""How long programs may take to make their nodes during a spin."""


class Bindings:
    """
    The declared callbacks of the entities.

    It changes under the engine's lock; other threads may ask at any time.
    """

    def __init__(self, task_set: TaskSet | None, engine: Engine) -> None:
        self._task_set = task_set
        self._engine = engine
        self._binder = binding.Binder(task_set) if task_set is not None else None
        self._dags = {} if task_set is None else dags_of(task_set)
        # by declared callback: the topics that its entities, also removed ones, have published
        # (they share the set), and have got messages of
        self._published: dict[str, set[str]] = {c.key: set() for c in self.declared}
        self._received: dict[str, set[str]] = {c.key: set() for c in self.declared}
        self._undeclared: dict[binding.Entity, None] = {}
        self._made_when_needed = {
            c.key for c in self.declared if c.kind == 'timer' and c.sporadic}
        #: The keys of the declared callbacks that have had an entity.
        self._found: set[str] = set()
        #: By declared callback, by topic: when its only entity disappeared, engine's time.
        self._gone: dict[str, Mapping[str, int]] = {}
        engine.verdicts.gone = self._gone.keys()
        # of the warning: when the executor began to judge (monotonic s), and whether it is over
        self._begin: float | None = None
        self._has_checked = task_set is None

    @property
    def declared(self) -> tuple[Callback, ...]:
        """Return the declared callbacks."""
        return self._task_set.callbacks if self._task_set is not None else ()

    def bind(self, entity: Entity) -> None:
        """Bind a new entity to its declared callback, if there is one."""
        declarable = entity.declarable
        if declarable is None:
            return
        callback = None if self._binder is None else self._binder.bind(
            declarable, binding.function_of(entity.symbol))
        if callback is None:
            if not entity.is_own and len(self._undeclared) < REMEMBERED:
                self._undeclared[declarable] = None
            return
        engine = self._engine
        assert self._task_set is not None
        self._found.add(callback.key)
        lacks = self._gone.pop(callback.key, {})
        if lacks.keys() - {entity.topic}:   # a sync lacks another one
            self._gone[callback.key] = {
                topic: at for topic, at in lacks.items() if topic != entity.topic}
        entity.declare(callback)
        link(entity, self._task_set, engine.tables)
        entity.awaiting = engine.answers.awaiting.get(callback.key)
        entity.publishes = self._published[callback.key]
        if entity.is_due_at_release and entity.source >= 0:
            scheduler = engine.scheduler
            entity.depth = source_depth(
                scheduler.tables, scheduler.state, engine.tables.dag_of[entity.source])

    def unbind(self, entity: Entity, now: int) -> None:
        """Free the declared callback of an entity that has disappeared."""
        if self._binder is not None and entity.callback is not None:
            self._binder.release(entity.callback, entity.topic or None)
            key = entity.callback.key
            self._gone[key] = {**self._gone.get(key, {}), entity.topic: now}

    def gone(self) -> dict[str, int]:
        """Return by declared callback when the first entity disappeared that it still lacks."""
        return {key: min(lacks.values()) for key, lacks in self._gone.copy().items()}

    def note_received(self, entity: Entity) -> None:
        """Note of which topic the callback of an entity has got messages."""
        if entity.callback is not None and entity.ready:
            self._received[entity.callback.key].add(entity.topic)

    def published(self) -> dict[str, set[str]]:
        """Return on which topics each declared callback has published."""
        return {key: set(topics) for key, topics in self._published.items()}

    def received(self) -> dict[str, set[str]]:
        """Return of which topics each sync has got messages, as far as that has been noted."""
        return {c.key: set(self._received[c.key]) for c in self.declared if c.kind == 'sync'}

    def elsewhere(self, process: str | None) -> set[str]:
        """Return the declared callbacks that run in other processes."""
        if self._task_set is None or process is None:
            return set()
        return {c.key for c in self.declared if self._task_set.process_of(c.node) != process}

    def not_found(self) -> dict[str, str | None]:
        """Return the declared callbacks that never had an entity, each with a question or None."""
        others = self.undeclared()
        questions = {each.key: binding.suggest_entity(each, others)
                     for each in self.declared if each.key not in self._found}
        # a sporadic timer that was not needed is made by no node
        return {key: question for key, question in questions.items()
                if question is not None or key not in self._made_when_needed}

    def undeclared(self) -> list[binding.Entity]:
        """Return all undeclared timers, subscriptions and services, including removed ones."""
        return list(self._undeclared)

    # --- the warning -----------------------------------------------------------------------------

    def rest_s(self) -> float | None:
        """Return the seconds until the next ``check``; None: never."""
        return None if self._has_checked else LEAST_S

    def check(
        self, entities: Mapping[int, Entity], is_judging: bool, process: str | None
    ) -> None:
        """
        Warn once of declared callbacks without an entity; the spinning thread calls this often.

        :param process: the declared process that this is; None: the declaration has none.
        """
        if self._has_checked or not is_judging or not entities:
            return
        now = time.monotonic()
        if self._begin is None:
            self._begin = now
        if now - self._begin < LEAST_S:
            return
        missing = self._missing({entity.node for entity in entities.values()}, process)
        periods = [dag.period_ns for callback in missing for dag in self._dags[callback.key]]
        if periods and now - self._begin < 2e-9 * min(periods):
            return
        self._has_checked = True
        if missing:
            text = self.unbound_text(entities.values(), missing)
            get_logger('mddag_executor').warning(
                f'{text}: use the same names in the declaration and the nodes, or remap the nodes')

    def _missing(self, nodes: set[str], process: str | None) -> list[Callback]:
        assert self._task_set is not None and self._binder is not None
        elsewhere = self.elsewhere(process)
        return [callback for callback in self._binder.unbound()
                if callback.key not in elsewhere and callback.key not in self._found
                and not callback.once and callback.key not in self._made_when_needed
                and not may_run_elsewhere(
                    callback, self._dags.get(callback.key, ()), nodes, self._task_set)]

    def unbound_text(
        self, entities: Iterable[Entity], missing: list[Callback] | None = None
    ) -> str:
        """
        Return one line about declared callbacks without an entity: which ones may be meant.

        :param missing: these callbacks; None: all.
        """
        assert self._task_set is not None and self._binder is not None
        missing = self._binder.unbound() if missing is None else missing
        others = self.undeclared()
        names = []
        for callback in missing:
            question = binding.suggest_entity(callback, others)
            names.append(callback.key if question is None else f'{callback.key} ({question})')
        found = counted(len(missing), 'declared callback was', 'declared callbacks were')
        text = f'{self._task_set.file}: {found} found in no node: {listed(names)}'
        ran = sorted({entity.name for entity in entities
                      if entity.callback is None and entity.ran and not entity.is_own
                      and entity.declarable is not None
                      and not binding.is_background(entity.label, entity.node)})
        if ran:
            text += f'; undeclared callbacks that ran: {listed(ran)}'
        return printable(text)
