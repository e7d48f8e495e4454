# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The executor that the nodes of a run see: it spins nothing, because the loop runs them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mddag_executor.executor.compat import (
    alive,
    BareExecutor,
    heritage_of_response,
    QuickCallback,
)
from mddag_executor.executor.recorder import Recorder
from mddag_executor.executor.tasks import make_task, TaskEntities, Unclaimed
from mddag_executor.executor.work import Work
from mddag_executor.hosting.guest import Guest
from mddag_executor.hosting.host import Host
from mddag_executor.rerun.loop import Loop, POLL_NS
from rclpy.node import Node
from rclpy.task import Task


class NodeHolder(BareExecutor):
    """
    The executor of the nodes of a run.

    :param recorder: records the functions of tasks; None: the run is not recorded.
    """

    def __init__(self, context: Any, loop: Loop, recorder: Recorder | None) -> None:
        super().__init__(context=context)
        self._task_entities = TaskEntities(recorder)
        self._loop = loop
        self._unclaimed = Unclaimed(lambda error: None)  # none is kept

    def ordered_nodes(self) -> list[Node]:
        """Return the nodes, by name: their order must not depend on the machine."""
        nodes = filter(alive, self.get_nodes())  # a callback may have destroyed its node
        return sorted(nodes, key=lambda node: node.get_fully_qualified_name())

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Task:
        """Run a function or coroutine in the run; return its task, which is a future."""
        if type(callback) is QuickCallback:
            task = Task(callback, args, kwargs)
            task()
            return task
        loop = self._loop

        def resume(work: Work) -> None:
            loop.call_in_run(lambda: loop.engine.resume(work, loop.now))

        heritage = heritage_of_response(args) or loop.heritage(of_task=True)
        task, work = make_task(
            self._task_entities.of(callback, args), self, resume, self._unclaimed, None, callback,
            args, kwargs)
        work.heritage = heritage
        loop.call_in_run(lambda: loop.engine.posted(work, loop.now))
        return task

    def on_callback_ended(
        self, listener: Callable[[Any, BaseException | None, int], bool]
    ) -> None:
        """Have a function called after each callback; what one raises ends the run."""
        self._loop.on_ended = lambda entity: listener(entity, None, -1)


class RerunHost(Host):
    """Runs programs as run threads: their waiting takes virtual time."""

    def __init__(self, loop: Loop) -> None:
        super().__init__()
        self._loop = loop

    def program_failed(self, guest: Guest, error: BaseException) -> None:
        """End the run."""
        self.end_run()

    def _wait_for_nodes(self, guest: Guest) -> None:
        loop = self._loop
        loop.wait(lambda: guest.is_complete or loop.run_threads.has_waiting(guest.thread), None,
                  'for a program to start')

    def wait(
        self, changed: Any, until: Callable[[], bool], timeout_s: float | None,
        guest: Guest | None,
    ) -> None:
        """Wait in virtual time for something, the end of the run or the program, or a time."""
        loop = self._loop
        if not loop.in_run:
            super().wait(changed, until, timeout_s, guest)
            return
        if timeout_s is not None:  # callbacks are to run meanwhile
            timeout_s = max(POLL_NS / 1e9, timeout_s) if timeout_s >= 0 else None
        loop.wait(
            lambda: until() or self.is_over(guest), timeout_s, 'for the end of the run', True)
