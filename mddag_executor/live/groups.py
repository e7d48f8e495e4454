# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Callback groups of their own executors, as rclcpp has them (rclpy#850).

Theory of operation
-------------------
An executor runs all of a node that was added to it, but for the callback groups that somebody has
added to an executor one by one: ``add_callback_group`` takes a group out of the hands of whoever
has the node.  A group belongs to one executor at most, so mutual exclusion within it needs nothing
more.  Who owns a group is known to the process (``_owners``), not to the node: rclpy's nodes know
one executor.  What an executor sees of a node that is shared is a ``NodeShare``, the node with
only those entities that the executor is to run.

A node tells its one executor when entities come and go.  So that the owners of its groups hear of
it too, they are told beside it, from when somebody first adds a group.

The middleware calls one listener for each entity, so an entity changes hands in this order: the
executor that had it lets go (its intake has taken back its listener), then the other one takes
over.  What the first has taken and not run yet is dropped and counted; what runs there goes on.

Only executors of this kind know of all this: one of rclpy's own that has the node too would go on
running the group.
"""

from __future__ import annotations

from collections.abc import Callable
import threading
import time
from typing import Any, TYPE_CHECKING
import weakref

from mddag_executor.live.compat import BareExecutor, tell_of_changes
from rclpy.node import Node

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup

HAND_OVER_S = 2.0
"""For so long an executor is given to let go of a group; it takes a few milliseconds."""

_lock = threading.Lock()
_owners: weakref.WeakKeyDictionary[CallbackGroup, weakref.ref[GroupOwner]] = \
    weakref.WeakKeyDictionary()
_sharers: weakref.WeakKeyDictionary[Node, weakref.WeakSet[GroupOwner]] = \
    weakref.WeakKeyDictionary()
_hooked = False


def owner_of(group: CallbackGroup | None) -> GroupOwner | None:
    """Return the executor that a group was added to by itself, None where there is none."""
    found = _owners.get(group) if group is not None and _owners else None
    return found() if found is not None else None


def groups_of(node: Any) -> list[CallbackGroup]:
    """Return the callback groups of a node's entities and its default one."""
    found = {node.default_callback_group: None}
    for name in _PARTS:
        for entity in list(getattr(node, name)):
            group = getattr(entity, 'callback_group', None)
            if group is not None:
                found[group] = None
    return list(found)


_PARTS = ('subscriptions', 'timers', 'clients', 'services', 'guards', 'waitables')


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
        if name not in _PARTS:
            return value
        return [e for e in list(value) if self._has(getattr(e, 'callback_group', None))]


class GroupOwner(BareExecutor):
    """The part of the executor that has callback groups."""

    _intake: Any

    def __init__(self, **kwargs: Any) -> None:
        # groups that were added one by one, with their nodes
        self._groups: dict[CallbackGroup, Node] = {}
        self._shares: dict[Node, NodeShare] = {}
        super().__init__(**kwargs)

    def _let_go(self, settled: Callable[[], bool]) -> None:
        raise NotImplementedError

    def add_callback_group(self, group: CallbackGroup, node: Node) -> None:
        """
        Run the callbacks of one group of a node, and of those that will be created in it.

        The executor that the node was added to, if there is one, runs the others.

        :raises RuntimeError: when the group has been added to an executor already, or rclpy's own
            executor has the node, which would run the group too.
        """
        _hook_nodes()
        holder = node.executor
        if holder is not None and not isinstance(holder, GroupOwner):
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
        if holder is not None and holder is not self:
            holder._hand_over()
        self.wake()

    def remove_callback_group(self, group: CallbackGroup) -> None:
        """
        Stop running a group that was added by itself; who has its node runs it again.

        :raises RuntimeError: when it was not added to this executor.
        """
        with _lock:
            if owner_of(group) is not self:
                raise RuntimeError('the callback group was not added to this executor')
            del _owners[group]
            node = self._groups.pop(group)
        self._hand_over()
        holder = node.executor
        if holder is not None:
            holder.wake()

    def get_manually_added_callback_groups(self) -> list[CallbackGroup]:
        """Return the groups that were added one by one."""
        with _lock:
            return list(self._groups)

    def get_automatically_added_callback_groups_from_nodes(self) -> list[CallbackGroup]:
        """Return the groups that came with their nodes."""
        return [group for node in self.get_nodes() for group in groups_of(node)
                if owner_of(group) is None]

    def get_all_callback_groups(self) -> list[CallbackGroup]:
        """Return all groups that this executor runs."""
        return [*self.get_manually_added_callback_groups(),
                *self.get_automatically_added_callback_groups_from_nodes()]

    def _served_nodes(self) -> list[Any]:
        """Return the nodes with what this executor is to run of them."""
        nodes: list[Any] = self.get_nodes()
        if not _owners:
            return nodes
        with _lock:
            own = set(self._groups.values())
            shared = {node for node, sharers in _sharers.items() if len(sharers)}
        nodes.extend(own.difference(nodes))
        self._shares = {
            node: self._shares.get(node) or NodeShare(node, _Has(self, node))
            for node in nodes if node in shared}
        return [self._shares.get(node, node) for node in nodes]

    def _hand_over(self) -> None:
        """Let go of what is no longer this executor's, and return when that is done."""
        self._let_go(self._wait_until_settled)

    def _wait_until_settled(self) -> bool:
        end = time.monotonic() + HAND_OVER_S
        while True:
            intake = self._intake
            if intake is None or intake.settled():
                return True
            if time.monotonic() > end:
                return False
            time.sleep(0.001)

    def _release_groups(self) -> None:
        """Give all groups up, at the end."""
        for group in self.get_manually_added_callback_groups():
            try:
                self.remove_callback_group(group)
            except RuntimeError:
                pass  # somebody else has removed it meanwhile


class _Has:
    """Tells whether an executor runs a group of a node."""

    def __init__(self, executor: GroupOwner, node: Node) -> None:
        self._executor = weakref.ref(executor)
        self._node = node

    def __call__(self, group: CallbackGroup | None) -> bool:
        executor = self._executor()
        owner = owner_of(group)
        if owner is None:
            return executor is not None and self._node.executor is executor
        return owner is executor


def _hook_nodes() -> None:
    """Have nodes also wake the executors that have groups of theirs."""
    global _hooked
    with _lock:
        if _hooked:
            return
        _hooked = True
    tell_of_changes(_wake_sharers)


def _wake_sharers(node: Node) -> None:
    for executor in list(_sharers.get(node, ())):
        executor.wake()
