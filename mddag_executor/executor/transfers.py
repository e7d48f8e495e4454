# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Executions that go with a node from one executor to the next one.

Theory of operation
-------------------
rclpy takes a message when it runs the callback.  This executor takes a message when it arrives.
So a node that moves to another executor may leave behind executions that have not run, and their
messages cannot be taken again.

1.  The executor that has such executions *leaves* them at rclpy's object (``Transfer.leave``).  It
    does so when the node is removed during a spin, when the executor is shut down, and when data
    of the node were just being taken.  For this executor they are dropped.
2.  If a node is removed while nothing spins, its executions stay where they are, because the
    node may come back before the next spin (``rclpy.spin_once``).  Another executor *requests*
    them when it begins to listen (``Owner.give_up``).
3.  The executor that listens to the object runs what was left, as executions of no job; a message
    of a declared source starts a job.  It is notified of executions that are left later.

Executions that no executor requests are freed with rclpy's object.
"""

from __future__ import annotations

from collections import deque
from typing import Any, Protocol
import weakref

_ATTRIBUTE = '_mddag_transfer'


class Owner(Protocol):
    """What listens to an object: see ``upkeep.Upkeep``."""

    def give_up(self, rclpy_object: Any) -> None:
        """Leave the executions of an object whose node was removed while nothing spun."""

    def note_left(self) -> None:
        """Note that executions were left for one of its objects; from any thread."""


class Transfer:
    """
    The executions left at one object of rclpy.

    :ivar left: the executions, the oldest first.
    """

    __slots__ = ('left', '_owner')

    def __init__(self) -> None:
        self.left: deque[Any] = deque()
        self._owner: weakref.ref[Owner] | None = None

    def leave(self, several: list[Any]) -> None:
        """Leave executions to the executor that listens to the object now, or will."""
        self.left.extend(several)
        owner = None if self._owner is None else self._owner()
        if owner is not None:
            owner.note_left()

    def claim(self, owner: Owner, rclpy_object: Any) -> None:
        """Let an executor own the object: what others have for it is left, or will be."""
        before = None if self._owner is None else self._owner()
        self._owner = weakref.ref(owner)
        if before is not None and before is not owner:
            before.give_up(rclpy_object)


def transfer_of(rclpy_object: Any) -> Transfer:
    """Return the transfer of an object of rclpy; of one that cannot have any: an unused one."""
    found: Transfer | None = getattr(rclpy_object, _ATTRIBUTE, None)
    if found is None:
        found = Transfer()
        try:
            setattr(rclpy_object, _ATTRIBUTE, found)
        except AttributeError:
            pass  # a class with slots
    return found
