# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Coroutines as rclpy runs them since 7.1.9, also where the rclpy that is installed is older.

There a future that is awaited hands itself to the task, which goes on by itself when it is done;
and a coroutine that goes on before is told off.
"""

import inspect

import pytest
from rclpy.task import Future, Task

from .test_asked_for import (  # noqa: F401
    test_an_exception_that_is_handled_does_not_end_the_executor,
)
from .test_executor import (  # noqa: F401
    test_service_and_client_from_a_coroutine,
    test_tasks_functions_coroutines_and_futures_across_them,
)
from .test_like_rclpy import (  # noqa: F401
    test_a_coroutine_goes_on_in_the_step_after_its_future_is_done,
    test_a_task_awaits_one_future_after_another,
)
from .test_spin import test_a_coroutine_that_awaits_something_unknown_is_asked_again  # noqa: F401
from .test_waitables import test_many_goals_at_once  # noqa: F401


@pytest.fixture(autouse=True)
def newer_rclpy(monkeypatch):
    """Let futures and tasks do what they do since rclpy 7.1.9."""
    if hasattr(Task, '_add_resume_callback'):
        return
    call_function = Task.__call__

    def wait(self):
        if self._pending():
            yield self
        if self._pending():
            raise RuntimeError('it goes on before the future that it awaits is done')
        return self.result()

    def call(self):
        if not inspect.iscoroutine(self._handler):
            call_function(self)
        elif self._pending():
            step(self)

    def step(task):
        try:
            yielded = task._handler.send(None)
        except StopIteration as stop:
            task.set_result(stop.value)
        except Exception as error:
            task.set_exception(error)
        else:
            if yielded is None:
                task._executor()._call_task_in_next_spin(task)
            else:
                task._add_resume_callback(yielded, task._executor())

    def resume(self, future, executor):
        future.add_done_callback(lambda _: self())

    monkeypatch.setattr(Future, '__await__', wait)
    monkeypatch.setattr(Task, '__call__', call)
    monkeypatch.setattr(Task, '_add_resume_callback', resume, raising=False)
