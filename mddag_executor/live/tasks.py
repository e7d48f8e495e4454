# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Tasks of the executor: futures that know whether somebody takes care of their exception."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
import inspect
from typing import Any

from mddag_executor.live.entries import AtOnce, Entry, TaskWork
from rclpy.task import Future, Task


class ObservedTask(Task):
    """
    A task that knows whether somebody waits for it, and so takes care of its exception.

    :ivar waits_for: the future that its coroutine waits for, where rclpy says so (7.1.9).
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.observed = False
        self.waits_for: Future | None = None
        super().__init__(*args, **kwargs)  # type: ignore[no-untyped-call]

    def add_done_callback(self, callback: Callable[[Future], None]) -> None:
        """Add a callback for when the task is done."""
        self.observed = True
        super().add_done_callback(callback)  # type: ignore[no-untyped-call]

    def _add_resume_callback(self, future: Future, executor: Any) -> None:
        """Leave it to the pool to go on: rclpy's own way (7.1.9) would be a second one."""
        self.waits_for = future


def make_task(
    entry: Entry, executor: Any, resume: Callable[[TaskWork], None],
    callback: Any, args: tuple[Any, ...], kwargs: dict[str, Any],
) -> tuple[ObservedTask, TaskWork]:
    """
    Make a task of a function, a coroutine function or a coroutine, and the work that runs it.

    :param resume: makes the work ready again; called when the task is cancelled.
    """
    coroutine = None
    if inspect.iscoroutinefunction(callback):
        callback, args, kwargs = callback(*args, **kwargs), (), {}
    if inspect.iscoroutine(callback):
        coroutine = callback
    task = ObservedTask(callback, args, kwargs, executor=executor)
    work = TaskWork(entry, task, ())
    work.coroutine = coroutine
    work.then = _raise_unobserved
    if coroutine is not None:
        Future.add_done_callback(task, AtOnce(partial(resume, work)))  # not an observer
    return task, work


def _raise_unobserved(task: Any) -> None:
    """Raise a finished task's exception, unless somebody has asked to be told of its end."""
    if not task.observed:
        error: BaseException | None = task.exception()
        if error is not None:
            raise error
