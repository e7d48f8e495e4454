# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Callback groups of their own executors, and those of a user's own class.

Theory of operation
-------------------
**Their own executors**, as rclcpp has them (rclpy#850).  An executor runs all of a node that was
added to it, but for the callback groups that somebody has added to an executor one by one:
``add_callback_group`` takes a group out of the hands of whoever has the node.  A group belongs to
one executor at most, so mutual exclusion within it needs nothing more.  Who owns a group is known
to the process (``_owners``), not to the node: rclpy's nodes know one executor.  What an executor
sees of a node that is shared is a ``NodeShare``, the node with only those entities that the
executor is to run.

A node notifies its one executor when entities come and go.  So that the owners of its groups hear
of it too, they are notified beside it, from when somebody first adds a group.

The middleware calls one listener for each entity, so an entity changes hands in this order, with
its group or its node: the executor that had it lets go (its intake has taken back its listener),
then the other one takes over.  What the first has taken and not run yet is dropped and counted;
what runs there goes on.

Only executors of this kind know of all this: one of rclpy's own that has the node too would go on
running the group.

**Of a user's own class** (``Gate``).  Of rclpy's two kinds of callback groups the core knows what
they allow.  Any other is asked, as rclpy's executors do: ``can_execute`` and
``beginning_execution`` before a callback, and ``ending_execution`` after it.  That is code of the
user's, which may wait for a lock.  So the worker that is to run the callback asks, without the
engine's lock.

Each entity of such a group is a group of one in the core (rule 4), which it leaves as soon as it
may run: so its messages are asked about one at a time, in their order.  What is refused waits,
and is asked about again after each callback that ends, and every few milliseconds in a spin.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
import threading
from typing import Any, TYPE_CHECKING
import weakref

from mddag_executor.live.compat import on_changes
from mddag_executor.live.intake.entities import LISTS
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import Executor
from rclpy.node import Node

if TYPE_CHECKING:
    from mddag_executor.live.work import Work
    from rclpy.callback_groups import CallbackGroup

_METHODS = ('can_execute', 'beginning_execution', 'ending_execution')
_lock = threading.Lock()
_owners: weakref.WeakKeyDictionary[CallbackGroup, weakref.ref[Groups]] = \
    weakref.WeakKeyDictionary()
_sharers: weakref.WeakKeyDictionary[Node, weakref.WeakSet[Groups]] = weakref.WeakKeyDictionary()
_by_executor: weakref.WeakKeyDictionary[Executor, weakref.ref[Groups]] = \
    weakref.WeakKeyDictionary()
_hooked = False


def owner_of(group: CallbackGroup | None) -> Groups | None:
    """Return who has a group that was added to an executor by itself; None: nobody."""
    found = _owners.get(group) if group is not None and _owners else None
    return found() if found is not None else None


def groups_of(node: Any) -> list[CallbackGroup]:
    """Return the callback groups of a node's entities and its default one."""
    found = {node.default_callback_group: None}
    for name in LISTS:
        for entity in list(getattr(node, name)):
            group = getattr(entity, 'callback_group', None)
            if group is not None:
                found[group] = None
    return list(found)


class NodeShare:
    """
    A node, with only those entities that one executor is to run.

    Everything else is the node's.

    :param has: whether the executor is to run a group (None: an entity without one).
    """

    def __init__(self, node: Node, has: Callable[[CallbackGroup | None], bool]) -> None:
        self._node = node
        self._has = has

    def __getattr__(self, name: str) -> Any:
        """Return what the node has, or of its entities those of the groups."""
        value = getattr(self._node, name)
        if name not in LISTS:
            return value
        return [e for e in list(value) if self._has(getattr(e, 'callback_group', None))]


class Groups:
    """
    The callback groups of an executor, and its nodes as far as it runs them.

    :param executor: whose they are.
    :param wake: has the executor look at its entities anew.
    :param hand_over: has it take nothing more of what is not its own now, and then forget that.
    """

    def __init__(
        self, executor: Executor, wake: Callable[[], None], hand_over: Callable[[], None],
    ) -> None:
        # groups that were added one by one, with their nodes
        self._groups: dict[CallbackGroup, Node] = {}
        self._shares: dict[Node, NodeShare] = {}
        self._executor = weakref.ref(executor)
        self._wake = wake
        self._hand_over = hand_over
        _by_executor[executor] = weakref.ref(self)

    def add(self, group: CallbackGroup, node: Node) -> None:
        """Add a group, as ``MultiDeadlineExecutor.add_callback_group`` says."""
        _hook_nodes()
        holder = node.executor
        known = _by_executor.get(holder) if holder is not None else None
        holding = known() if known is not None else None
        if holder is not None and holding is None:
            raise RuntimeError(
                f'node {node.get_fully_qualified_name()} is on a {type(holder).__name__}, which '
                'would run the callback group too: remove it there, or use a '
                'MultiDeadlineExecutor')
        with _lock:
            if owner_of(group) is not None:
                raise RuntimeError('the callback group has been added to an executor already')
            _owners[group] = weakref.ref(self)
            self._groups[group] = node
            _sharers.setdefault(node, weakref.WeakSet()).add(self)
        if holding is not None and holding is not self:
            holding._hand_over()
        self._wake()

    def remove(self, group: CallbackGroup) -> None:
        """Remove a group, as ``MultiDeadlineExecutor.remove_callback_group`` says."""
        with _lock:
            if owner_of(group) is not self:
                raise RuntimeError('the callback group was not added to this executor')
            del _owners[group]
            node = self._groups.pop(group)
        self._hand_over()
        holder = node.executor
        if holder is not None:
            holder.wake()

    def one_by_one(self) -> list[CallbackGroup]:
        """Return the groups that were added one by one."""
        with _lock:
            return list(self._groups)

    def from_nodes(self) -> list[CallbackGroup]:
        """Return the groups that came with their nodes."""
        return [group for node in self._nodes() for group in groups_of(node)
                if owner_of(group) is None]

    def _nodes(self) -> list[Any]:
        executor = self._executor()
        return [] if executor is None else executor.get_nodes()

    def served_nodes(self) -> list[Any]:
        """Return the nodes with what this executor is to run of them."""
        nodes = self._nodes()
        if not _owners:
            return nodes
        with _lock:
            own = set(self._groups.values())
            shared = {node for node, sharers in _sharers.items() if len(sharers)}
        nodes.extend(own.difference(nodes))
        self._shares = {
            node: self._shares.get(node) or NodeShare(node, partial(self._has, node))
            for node in nodes if node in shared}
        return [self._shares.get(node, node) for node in nodes]

    def _has(self, node: Node, group: CallbackGroup | None) -> bool:
        """Return whether the executor runs a group of a node."""
        owner = owner_of(group)
        if owner is None:
            executor = self._executor()
            return executor is not None and node.executor is executor
        return owner is self

    def release(self) -> None:
        """Give all groups up, at the end."""
        for group in self.one_by_one():
            try:
                self.remove(group)
            except RuntimeError:
                pass  # somebody else has removed it meanwhile


def _hook_nodes() -> None:
    """Have nodes also wake the executors that have groups of theirs."""
    global _hooked
    with _lock:
        if _hooked:
            return
        _hooked = True
    on_changes(_wake_sharers)


def _wake_sharers(node: Node) -> None:
    for groups in list(_sharers.get(node, ())):
        groups._wake()


class Refused(Exception):
    """The callback group does not let a callback run now."""


def decides_itself(group: Any) -> bool:
    """Return whether a callback group is of neither of rclpy's kinds, or changes one of them."""
    return not any(
        all(getattr(getattr(group, name), '__func__', None) is getattr(kind, name)
            for name in _METHODS)
        for kind in (MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup))


class Gate:
    """
    An entity's callback group that decides itself.

    :param passed: called with an execution that may run, before it does.
    """

    def __init__(self, group: Any, entity: Any, passed: Callable[[Work], None]) -> None:
        self._group = group
        self._entity = entity
        self._passed = passed

    def step(self, work: Work) -> Any:
        """
        Run a step of an execution as ``Work.step`` does, if it may begin.

        :raises Refused: where it may not.
        """
        group, entity = self._group, self._entity
        if work.coroutine is None:
            if not (group.can_execute(entity) and group.beginning_execution(entity)):
                raise Refused
            self._passed(work)
        waits_for = None
        try:
            waits_for = work.step()
        finally:
            if waits_for is None:
                group.ending_execution(entity)
        return waits_for
