# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The executor's asyncio event loop, which coroutines of callbacks share with worker threads.

Theory of operation
-------------------
1.  *One thread at a time runs asyncio code.*  asyncio's objects are not thread-safe, and worker
    threads run several coroutines at the same time.  So there is one turnstile: the thread of the
    loop owns it except while it waits for events, and each step of a coroutine (``coroutines``)
    owns it to its end.  Awaiting a future calls no method of the loop, so a step has to own it
    from its start.
2.  *Until a coroutine uses the loop, no step needs the turnstile.*  In each step
    ``asyncio.get_running_loop()`` returns the loop.  Each of its methods lets the step join, and
    starts the loop.  ``__hash__`` does so as well, because ``asyncio.current_task()`` looks the
    task up by its loop and calls no method.
3.  *The thread* starts with the first step that joins.  A step that has scheduled something wakes
    it, if it would otherwise sleep too long.  A future that is done makes the execution that
    awaits it ready at once, in the thread that has completed it.
4.  *Other threads* use ``call_soon_threadsafe`` or ``run_coroutine_threadsafe``, as with any loop.
    A callback that is not a coroutine owns the turnstile for each single call.
5.  *The end.*  Tasks that are not done are cancelled, and a warning names them.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
import contextvars
from functools import partial, wraps
import selectors
import threading
from threading import get_ident
import time
from typing import Any, Protocol

from mddag_executor.executor.compat import QuickCallback
from mddag_executor.executor.starters import starting_for_all

CLOSE_S = 2.0
"""How long cancelled tasks may take to end."""


class Turnstile:
    """
    A lock that threads get in the order in which they ask for it.

    :ivar owner: the thread that owns it; 0: none does, or it is being passed on.
    """

    def __init__(self) -> None:
        self.owner = 0
        self._lock = threading.Lock()
        self._is_taken = False
        self._queue: deque[threading.Lock] = deque()

    def acquire(self) -> None:
        """Wait until the calling thread owns it; an interrupt leaves it to the others."""
        try:
            self._acquire()
        except BaseException:
            if self.owner == get_ident():
                self.release()
            raise

    def _acquire(self) -> None:
        with self._lock:
            if not self._is_taken:
                self._is_taken = True
                self.owner = get_ident()
                return
            turn = threading.Lock()
            turn.acquire()
            self._queue.append(turn)
        try:
            turn.acquire()
            self.owner = get_ident()
        except BaseException:
            with self._lock:
                if turn in self._queue:
                    self._queue.remove(turn)
                else:  # it has been passed to this thread
                    self.owner = get_ident()
            raise

    def release(self) -> None:
        """Pass it to the thread that has waited longest."""
        self.owner = 0
        with self._lock:
            if self._queue:
                self._queue.popleft().release()
            else:
                self._is_taken = False


class _Selector(selectors.DefaultSelector):
    """Gives the turnstile up while the loop waits for events."""

    loop: CallbackLoop | None = None

    def select(self, timeout: float | None = None) -> Any:
        """Wait for events."""
        loop = self.loop
        if loop is None:
            return super().select(timeout)
        loop.let_others(timeout)
        try:
            return super().select(timeout)
        finally:
            loop.own()


class Stepped(Protocol):
    """A coroutine of which a step runs; see ``coroutines.Steps``."""

    loop: Any
    has_joined: bool

    def let_others(self) -> None:
        """Give the turnstile up."""


class _Stepping(threading.local):
    steps: Stepped | None = None
    is_passing = False


stepping = _Stepping()
"""
Of the calling thread: ``steps``, the coroutine of which a step runs in it; ``is_passing``: it is
inside the turnstile.
"""

# Attributes that are safe in any thread, or not meant for callbacks.
_WITHOUT_TURN = {
    'call_soon_threadsafe', 'run_forever', 'run_until_complete', 'stop', 'is_running',
    'is_closed', 'close', 'shutdown_asyncgens', 'shutdown_default_executor', 'get_debug',
    'set_debug', 'set_task_factory', 'get_task_factory', 'set_default_executor',
    'set_exception_handler', 'get_exception_handler', 'call_exception_handler',
    'default_exception_handler'}


class CallbackLoop(asyncio.SelectorEventLoop):
    """
    An event loop whose methods steps of coroutines may use in any thread.

    :param warn: receives a line about tasks that are cancelled at the end.
    :param must_not_wait: whether the calling thread owns a lock that others may need meanwhile.
    """

    def __init__(self, warn: Callable[[str], None], must_not_wait: Callable[[], bool]) -> None:
        selector = _Selector()
        super().__init__(selector)
        selector.loop = self
        self._warn = warn
        self._must_not_wait = must_not_wait
        self._turnstile = Turnstile()
        self._wakes_at = 0.0    # when its thread wakes by itself
        self._thread: threading.Thread | None = None
        self._start_lock = threading.Lock()

    def __hash__(self) -> int:
        """Return the hash; its user may be asking for the current task (rule 2)."""
        if not self.is_owner():
            self.join()
        return object.__hash__(self)

    def __eq__(self, other: object) -> bool:
        return self is other

    def _check_thread(self) -> None:
        """Allow calls from steps even in debug mode: they own the turnstile."""

    def call_soon(  # type: ignore[override]
        self, callback: Callable[..., object], *args: Any,
        context: contextvars.Context | None = None,
    ) -> asyncio.Handle:
        """Call a function in the next turn; one that makes a step ready at once (rule 3)."""
        if type(callback) is QuickCallback:
            callback(*args)
            return asyncio.Handle(callback, args, self)
        return super().call_soon(callback, *args, context=context)

    # --- the turnstile ---------------------------------------------------------------------------

    def is_owner(self) -> bool:
        """Return whether the calling thread may run asyncio code."""
        return self._turnstile.owner == get_ident()

    def own(self) -> None:
        """Let the calling thread run asyncio code."""
        stepping.is_passing = True
        try:
            self._turnstile.acquire()
        finally:
            stepping.is_passing = False

    def let_others(self, timeout: float | None) -> None:
        """Let other threads run asyncio code while the loop waits for events."""
        self._wakes_at = float('inf') if timeout is None else self._clock() + timeout
        self._release()

    def _release(self) -> None:
        stepping.is_passing = True
        try:
            self._turnstile.release()
        finally:
            stepping.is_passing = False

    def join_if_it_runs(self) -> None:
        """Let the calling thread's step run asyncio code if any step has done so before."""
        if self._thread is not None and not self.is_closed():
            self.join()

    def join(self) -> bool:
        """Let the calling thread's step run asyncio code to its end; False: there is no step."""
        steps = stepping.steps
        if steps is None or steps.loop is not self:
            return False
        self._start()
        self.own()
        steps.has_joined = True
        asyncio._enter_task(self, steps)  # type: ignore[arg-type]
        return True

    def leave(self, steps: Stepped) -> None:
        """Note that a step that has joined ends or pauses."""
        if steps.has_joined:
            asyncio._leave_task(self, steps)  # type: ignore[arg-type]
            steps.has_joined = False
        self._give_up()

    def _give_up(self) -> None:
        scheduled: Any = self._scheduled  # type: ignore[attr-defined]
        wakes = bool(self._ready) or (  # type: ignore[attr-defined]
            len(scheduled) > 0 and scheduled[0]._when < self._wakes_at)
        self._release()
        if wakes:
            self._write_to_self()  # type: ignore[attr-defined]

    def call_in_turn(self, method: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """
        Call a method in a thread that does not own the turnstile.

        A finalizer may come anywhere: if it must not wait, its call is made by the loop's thread.
        """
        if stepping.is_passing or self._must_not_wait():
            return self.call_soon_threadsafe(partial(method, self, *args, **kwargs))
        if self.join():
            return method(self, *args, **kwargs)
        self._start()
        self.own()
        try:
            return method(self, *args, **kwargs)
        finally:
            self._give_up()

    _clock = staticmethod(time.monotonic)

    # --- its thread ------------------------------------------------------------------------------

    def _start(self) -> None:
        if self._thread is not None or self.is_closed():
            return
        with self._start_lock:
            if self._thread is None:
                runs = threading.Event()
                self.call_soon_threadsafe(runs.set)
                thread = threading.Thread(target=self._run, name='mddag-asyncio', daemon=True)
                with starting_for_all():
                    thread.start()
                self._thread = thread
                runs.wait()

    def _run(self) -> None:
        self.own()
        asyncio.set_event_loop(self)
        try:
            self.run_forever()
        finally:
            try:
                self._cancel_tasks()
            finally:
                self._release()

    def _cancel_tasks(self) -> None:
        """Cancel what is not done, and let it end."""
        tasks = asyncio.all_tasks(self)
        for task in tasks:
            self._warn(f'the asyncio task {name_of(task.get_coro())} has not ended before its '
                       'executor: it is cancelled')
            task.cancel()
        if tasks:
            self.run_until_complete(asyncio.wait(tasks, timeout=CLOSE_S))
        self.run_until_complete(self.shutdown_asyncgens())
        executor = self._default_executor  # type: ignore[attr-defined]
        if executor is not None:
            executor.shutdown(wait=False)

    def calls(self, function: Callable[[], object]) -> bool:
        """Let its thread call a function; False: it does not within ``CLOSE_S``."""
        self._start()
        has_called = threading.Event()
        self.call_soon_threadsafe(function)
        self.call_soon_threadsafe(has_called.set)
        return has_called.wait(CLOSE_S)

    def end(self) -> None:
        """Cancel what is not done, end the thread, and close the loop."""
        thread = self._thread
        if self.is_closed():
            return
        if thread is not None:
            self.call_soon_threadsafe(self.stop)
            if thread is threading.current_thread():
                return
            thread.join(2 * CLOSE_S)
            if thread.is_alive():
                self._warn('a callback of asyncio has not ended: it is abandoned')
                return
        self.close()


def _take_turn_in(name: str) -> None:
    method = getattr(CallbackLoop, name)

    @wraps(method)
    def in_turn(self: CallbackLoop, *args: Any, **kwargs: Any) -> Any:
        if self.is_owner():
            return method(self, *args, **kwargs)
        return self.call_in_turn(method, *args, **kwargs)

    setattr(CallbackLoop, name, in_turn)


for _name in vars(asyncio.AbstractEventLoop):
    if not _name.startswith('_') and _name not in _WITHOUT_TURN and hasattr(
            asyncio.SelectorEventLoop, _name):
        _take_turn_in(_name)


# --- names and futures ---------------------------------------------------------------------------

def name_of(coroutine: Any) -> str:
    """Return the name of a coroutine for messages."""
    return str(getattr(coroutine, '__qualname__', type(coroutine).__name__))


def is_asyncio_future(yielded: Any) -> bool:
    """Return whether a coroutine has yielded a future of asyncio, to wait for it."""
    return getattr(yielded, '_asyncio_future_blocking', None) is not None
