# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A waitable of a user's own."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.waitable import NumberOfEntities, Waitable


class Pulse(Waitable):
    """A waitable that consists of a guard condition."""

    def __init__(self, node: Node, group: Any) -> None:
        super().__init__(group)
        self.guard = node.create_guard_condition(lambda: None)
        node._guards.remove(self.guard)
        self._index: int | None = None
        self.order: list[str] = []

    def __enter__(self) -> None:
        self.guard.handle.__enter__()

    def __exit__(self, *_: Any) -> None:
        self.guard.handle.__exit__(None, None, None)

    def is_ready(self, wait_set: Any) -> bool:
        ready = bool(wait_set.is_ready('guard_condition', self._index))
        if ready:
            self.order.append('ready')
        return ready

    def take_data(self) -> int:
        self.order.append('take')
        return len(self.order)

    async def execute(self, taken_data: int) -> None:
        pass

    def get_num_entities(self) -> NumberOfEntities:
        return NumberOfEntities(num_gcs=1)

    def add_to_wait_set(self, wait_set: Any) -> None:
        self._index = wait_set.add_guard_condition(self.guard.handle)
