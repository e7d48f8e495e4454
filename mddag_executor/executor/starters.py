# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Code that a callback starts and that publishes for it: threads, tasks, parts of coroutines.

Theory of operation
-------------------
1.  A callback may leave publishing to code that runs elsewhere: a task of asyncio, a function in a
    pool of threads (``run_in_executor``, ``to_thread``, ``submit``), a thread or
    ``threading.Timer``, a task of an executor.  Until the execution of the callback has ended,
    such code works *on its behalf*: what it publishes belongs to the execution, as if the callback
    had published it.  So a callback that awaits or joins such code publishes in time.
2.  Who has started the code (its *starter*) is in a context variable, which asyncio passes on to
    its tasks and to ``to_thread``; in the thread; or in the ``Work`` of the task.
3.  When the execution has ended, it is decided what its job has not published.  A later message
    belongs to no job: see ``outside``.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
import contextvars
from functools import wraps
import threading
from typing import Any, NamedTuple
import weakref

from mddag_executor.executor.attribution import Origin

_ATTRIBUTE = '_mddag_starter'


class Claim(NamedTuple):
    """
    What a starter publishes.

    :ivar work: the execution (``Work``), which runs in ``pool``; ``origin``: its job.
    """

    work: Any
    pool: Any
    origin: Origin


class Starter:
    """
    The execution that has started some code; it is not kept alive.

    :param work: the execution (``Work``), which runs in ``pool`` (a ``WorkerPool``, or the loop of
        a rerun).
    """

    __slots__ = ('_pool', '_work')

    def __init__(self, work: Any, pool: Any) -> None:
        self._work = weakref.ref(work)
        self._pool = weakref.ref(pool)

    def claim(self, topic: str, message: Any) -> Claim | None:
        """Let the execution publish a message; None: it has ended, or has no job."""
        work, pool = self._work(), self._pool()
        if work is None or pool is None or pool.is_inside():
            return None
        engine = pool.engine
        with pool.lock:     # it does not end meanwhile
            if work.x < 0 or topic not in engine.attribution.topics:
                return None
            if work.entity.awaiting is not None:
                engine.answers.note_published(work, topic, message)
            origin = engine.origin_of(work)
            if origin is None:
                return None
            engine.attribution.note_optional(topic, origin)
        return Claim(work, pool, origin)


_starter: contextvars.ContextVar[Starter | None] = contextvars.ContextVar(
    'mddag_starter', default=None)


class _Submitting(threading.local):
    is_submitting = False


_calling = _Submitting()


def starter_outside() -> Starter | None:
    """Return the starter of the calling thread, which runs no callback; None: it has none."""
    found = _starter.get()
    if found is None:
        found = getattr(threading.current_thread(), _ATTRIBUTE, None)
    return found


def set_starter(context: contextvars.Context, starter: Starter | None) -> None:
    """Let what runs in a context work on behalf of an execution; None: leave it as it is."""
    if starter is not None:
        context.run(_starter.set, starter)


def forget_starter(thread: threading.Thread) -> None:
    """Let a thread that has just been made work on behalf of no execution."""
    thread.__dict__.pop(_ATTRIBUTE, None)


def run_for(
    starter: Starter | None, function: Callable[..., Any], /, *args: Any, **kwargs: Any
) -> Any:
    """Call a function that works on behalf of an execution; None: of none."""
    token = _starter.set(starter)
    try:
        return function(*args, **kwargs)
    finally:
        _starter.reset(token)


def install(starter_here: Callable[[], Starter | None]) -> None:
    """
    Let threads, and functions in pools of threads, know their starter; call this once.

    :param starter_here: returns the starter of what the calling thread starts.
    """
    make: Any = threading.Thread.__init__
    submit: Any = ThreadPoolExecutor.submit

    @wraps(make)
    def make_thread(self: threading.Thread, *args: Any, **kwargs: Any) -> None:
        make(self, *args, **kwargs)
        # a thread of a pool also runs functions that others submit; a dummy is the calling thread
        if not _calling.is_submitting and type(self).__name__ != '_DummyThread':
            starter = starter_here()
            if starter is not None:
                self.__dict__[_ATTRIBUTE] = starter

    @wraps(submit)
    def submit_with_starter(
        self: ThreadPoolExecutor, function: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> Any:
        starter = starter_here()
        if starter is None:
            return submit(self, function, *args, **kwargs)
        before, _calling.is_submitting = _calling.is_submitting, True
        try:
            return submit(self, run_for, starter, function, *args, **kwargs)
        finally:
            _calling.is_submitting = before

    threading.Thread.__init__ = make_thread  # type: ignore[method-assign]
    ThreadPoolExecutor.submit = submit_with_starter  # type: ignore[assignment,method-assign]
