# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A waitable of a user's own."""

from rclpy.waitable import NumberOfEntities, Waitable


class Pulse(Waitable):
    """A waitable that consists of a guard condition."""

    def __init__(self, node, group):
        super().__init__(group)
        self.guard = node.create_guard_condition(lambda: None)
        node._guards.remove(self.guard)
        self._index = None
        self.order = []

    def __enter__(self):
        self.guard.handle.__enter__()

    def __exit__(self, *_):
        self.guard.handle.__exit__(None, None, None)

    def is_ready(self, wait_set):
        ready = bool(wait_set.is_ready('guard_condition', self._index))
        if ready:
            self.order.append('ready')
        return ready

    def take_data(self):
        self.order.append('take')
        return len(self.order)

    async def execute(self, taken_data):
        pass

    def get_num_entities(self):
        return NumberOfEntities(num_gcs=1)

    def add_to_wait_set(self, wait_set):
        self._index = wait_set.add_guard_condition(self.guard.handle)
