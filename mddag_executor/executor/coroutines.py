# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Coroutines of callbacks, run step by step; they may await futures of rclpy and of asyncio.

Theory of operation
-------------------
A worker runs one step of a coroutine: up to the future that it awaits next.  When that future is
done, the execution becomes ready again.  This is the same for both kinds of futures.  During a
step ``asyncio.get_running_loop()`` returns the executor's loop (``asyncio_loop``), and the
``Steps`` are the current task, so ``asyncio.timeout`` and a ``TaskGroup`` can cancel them.  If the
thread that spins already runs an event loop (``asyncio.run`` with ``spin_once``, or
``spin_async``), the steps use that loop instead.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Generator, Iterable
from contextlib import suppress
import contextvars
import threading
import time
from typing import Any

from mddag_executor.errors import MddagError
from mddag_executor.executor.asyncio_loop import (
    CallbackLoop,
    CLOSE_S,
    is_asyncio_future,
    name_of,
    stepping,
)
from mddag_executor.executor.compat import awaited, NEXT_TURN, QuickCallback
from mddag_executor.executor.interrupts import runs_callbacks


class Loops:
    """
    Gives the coroutines of an executor their event loop, made for the first one.

    :param warn: receives a line about coroutines and tasks that are cancelled at the end.
    :param must_not_wait: see ``CallbackLoop``.
    """

    def __init__(self, warn: Callable[[str], None], must_not_wait: Callable[[], bool]) -> None:
        self._warn = warn
        self._must_not_wait = must_not_wait
        self._loop: CallbackLoop | None = None
        self._lock = threading.Lock()

    def loop(self) -> CallbackLoop:
        """Return the loop."""
        with self._lock:
            if self._loop is None:
                self._loop = CallbackLoop(self._warn, self._must_not_wait)
            return self._loop

    def end(self, coroutines: Iterable[tuple[str, Steps]]) -> None:
        """
        Cancel what awaits asyncio, and close the loop; no worker runs a step any more.

        :param coroutines: those that have begun, with the names of their callbacks.
        """
        try:
            for name, steps in coroutines:
                if is_asyncio_future(steps.waits_for):
                    self._warn(f'{name}: its coroutine {name_of(steps.get_coro())} has not ended '
                               'before its executor: it is cancelled')
                    if not self._abandon(name, steps):
                        break
        finally:
            if self._loop is not None:
                self._loop.end()

    def _abandon(self, name: str, steps: Steps) -> bool:
        """Cancel a coroutine; return False if a callback of asyncio keeps all from ending."""
        try:
            return steps.abandon()
        except Exception as error:
            self._warn(f'{name}: its coroutine, when it was cancelled, raised '
                       f'{type(error).__name__}: {error}')
            return True


class _NoLoop:
    """Takes the place of the event loop where there is none: in a rerun."""

    def __getattr__(self, name: str) -> Any:
        raise MddagError('a rerun does not run asyncio: leave this node out of it, or let its '
                         'callbacks await futures of rclpy only')


_NO_LOOP: Any = _NoLoop()


class Steps:
    """
    A coroutine, run in steps; in each step it is asyncio's current task.

    :param loops: of the executor; None: it has no event loop.
    :ivar waits_for: the future that it awaits; ``NEXT_TURN``: it goes on in the next turn.
    :ivar resume: makes its execution ready again, while it is suspended.
    :ivar loop: the event loop of its current or last step.
    :ivar has_joined: whether its current step may run asyncio code in ``loop``.
    """

    def __init__(self, coroutine: Coroutine[Any, Any, Any], loops: Loops | None) -> None:
        self._inner: Any = coroutine
        self._loops = loops
        self._context = contextvars.copy_context()
        self._drive = self.__await__()
        self.waits_for: Any = NEXT_TURN
        self.resume: Callable[[], object] = bool
        self.loop: Any = None
        self.has_joined = False
        self._is_done = False
        self._must_cancel = False
        self._n_cancelled = 0
        self._message: Any = None
        self._waited: tuple[Any, Any] | None = None

    # --- the steps -------------------------------------------------------------------------------

    def send(self) -> None:
        """
        Run the next step.

        :raises StopIteration: when the coroutine has returned, with its result.
        """
        self._drive.send(None)

    def as_coroutine(self) -> Any:
        """Return a coroutine that runs a step each time it is resumed, for rclpy's tasks."""
        made: Any = self._whole()
        made.__name__, made.__qualname__ = self._inner.__name__, self._inner.__qualname__
        return made

    async def _whole(self) -> Any:
        return await self

    def __await__(self) -> Generator[None, None, Any]:
        try:
            while True:
                try:
                    self.waits_for = self._step()
                except StopIteration as stop:
                    return stop.value
                yield
        except GeneratorExit:
            self._inner.close()
            raise
        finally:
            self._is_done = True
            self.waits_for = None

    def _step(self) -> Any:
        """Run a step in the context of its event loop; return what the coroutine awaits then."""
        waited, self._waited = self._waited, None
        if waited is not None:
            self._forget(*waited)
        outer, before = stepping.steps, asyncio._get_running_loop()
        if outer is not None:
            outer.let_others()  # a spin within a step
        is_foreign = before is not None and (outer is None or before is not outer.loop)
        if is_foreign:
            self.loop = before
            replaced = _replace_task(before, self)
        else:
            self.loop = _NO_LOOP if self._loops is None else self._loops.loop()
        stepping.steps = self
        asyncio._set_running_loop(self.loop)
        try:
            if isinstance(self.loop, CallbackLoop):
                self.loop.join_if_it_runs()
            return self._awaited(self._context.run(self._continue))
        finally:
            self.let_others()
            if is_foreign:
                _replace_task(before, replaced)
            asyncio._set_running_loop(before)
            stepping.steps = outer

    @runs_callbacks
    def _continue(self) -> Any:
        """Continue the coroutine until it yields."""
        if self._must_cancel:
            self._must_cancel = False
            return self._inner.throw(
                asyncio.CancelledError(*() if self._message is None else (self._message,)))
        return self._inner.send(None)

    def _awaited(self, yielded: Any) -> Any:
        if yielded is None:
            return awaited(self._inner)
        if is_asyncio_future(yielded):
            yielded._asyncio_future_blocking = False
            if self._must_cancel and yielded.cancel(msg=self._message):
                self._must_cancel = False
        return yielded

    def suspended(self, resume: Callable[[], object], waits_for: Any = None) -> None:
        """
        Note that its execution is suspended, before anything may resume it.

        :param resume: makes it ready again.
        :param waits_for: the future that resumes it when it is done.
        """
        self.resume = resume
        self._waited = None
        if waits_for is not None:
            waited = self._waited = waits_for, QuickCallback(resume)
            waits_for.add_done_callback(waited[1])
            if self._waited is not waited:  # another thread has resumed it meanwhile
                self._forget(*waited)
        if self._must_cancel:
            resume()

    @staticmethod
    def _forget(waits_for: Any, callback: Any) -> None:
        """Leave no callback in a future that it no longer waits for, as it was cancelled."""
        if not (waits_for.done() or waits_for.cancelled()):
            waits_for.remove_done_callback(callback)

    def let_others(self) -> None:
        """Let other threads run asyncio code: a step ends, or waits for something else."""
        loop = self.loop
        if self.has_joined or isinstance(loop, CallbackLoop) and loop.is_owner():
            loop.leave(self)

    def abandon(self) -> bool:
        """
        Cancel the coroutine, which is suspended, and let it run its last step.

        :return: False: it cannot, as a callback in the thread of its loop does not end.
        """
        waits_for, loop = self.waits_for, self.loop
        if isinstance(loop, CallbackLoop):
            if not loop.calls(self.cancel):
                return False
            end = time.monotonic() + CLOSE_S
            while not waits_for.done() and time.monotonic() < end:  # a task ends some time later
                time.sleep(0.001)
        else:
            self.cancel()
        if not waits_for.done():
            self._must_cancel = True
        try:
            self.send()
            with suppress(RuntimeError):  # it awaits something more, and ignores its end
                self._drive.close()
        except (StopIteration, asyncio.CancelledError):
            pass
        return True

    # --- as asyncio's current task ---------------------------------------------------------------

    def cancel(self, msg: Any = None) -> bool:
        """Raise CancelledError in the coroutine, soon; return False if it has ended."""
        if self._is_done:
            return False
        self._n_cancelled += 1
        self._message = msg
        waits_for = self.waits_for
        if is_asyncio_future(waits_for) and waits_for.cancel(msg=msg):
            return True
        self._must_cancel = True
        self.resume()
        return True

    def uncancel(self) -> int:
        """Take one request to cancel back; return how many remain."""
        self._n_cancelled = max(0, self._n_cancelled - 1)
        if not self._n_cancelled:
            self._must_cancel = False
        return self._n_cancelled

    def cancelling(self) -> int:
        """Return how many requests to cancel there are."""
        return self._n_cancelled

    def done(self) -> bool:
        """Return whether the coroutine has ended."""
        return self._is_done

    @property
    def _fut_waiter(self) -> Any:
        """Return the future of asyncio that it awaits, as anyio asks asyncio's tasks."""
        return self.waits_for if is_asyncio_future(self.waits_for) else None

    def get_loop(self) -> Any:
        """Return the event loop."""
        return self.loop

    def get_coro(self) -> Any:
        """Return the coroutine."""
        return self._inner

    def get_context(self) -> contextvars.Context:
        """Return the context variables of the coroutine."""
        return self._context

    def get_name(self) -> str:
        """Return the name of the coroutine."""
        return name_of(self._inner)


def _replace_task(loop: Any, task: Any) -> Any:
    """Make a task the current one of a loop, or none; return the one before."""
    before = asyncio.current_task(loop)
    if before is not None:
        asyncio._leave_task(loop, before)
    if task is not None:
        asyncio._enter_task(loop, task)
    return before
