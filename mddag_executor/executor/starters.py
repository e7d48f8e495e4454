# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Code that a callback starts and that publishes for it: threads, tasks, later parts of coroutines.

Theory of operation
-------------------
1.  A callback may leave publishing to code that runs elsewhere: a task of asyncio, a function in a
    ``ThreadPoolExecutor`` (``submit``, ``run_in_executor``, ``to_thread``) or in a ``ThreadPool``
    of multiprocessing, a thread or ``threading.Timer``, a task of an executor.  Until the
    execution of the callback has ended, such code works *on its behalf*: what it publishes belongs
    to the execution, as if the callback had published it.  So if the callback awaits or joins such
    code, the messages belong to its job.
2.  The execution that has started the code is its *starter*.  It is noted when the code starts:

    * of a thread, in the thread (``Thread.start``);
    * of a function in a pool, and of what asyncio runs, in a context variable.  Asyncio passes it
      on to its tasks and to ``to_thread``;
    * of a task of an executor, in its ``Work``.

    Code that such code starts has the same starter.  The threads of a pool, and the thread of the
    event loop, run code of several executions, so they have no starter themselves.
3.  When the execution has ended, it is decided what its job has not published.  A message that is
    published later belongs to no job: see ``outside``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
import contextvars
from functools import partial, wraps
from multiprocessing.pool import ThreadPool
import threading
from typing import Any, NamedTuple
import weakref

from mddag_executor.executor.attribution import Origin

_ATTRIBUTE = '_mddag_starter'
_OF_POOLS = ('apply_async', 'map', 'map_async', 'starmap', 'starmap_async', 'imap',
             'imap_unordered')    # ``apply`` calls the first one


class Claim(NamedTuple):
    """
    The execution that a message belongs to which other code publishes.

    :ivar work: the execution (``Work``), which runs in ``pool`` (a ``WorkerPool``).
    :ivar origin: its job.
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

    def claim(self, topic: str, message: Any, publishing: Any = None) -> Claim | None:
        """
        Return the execution, which publishes a message; None: it has ended, or has no job.

        :param publishing: the pool that runs the callback or task which publishes; None: a thread
            outside of all pools does.  An execution of another pool does not publish by it.
        """
        work, pool = self._work(), self._pool()
        if work is None or pool is None or publishing not in (None, pool):
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


class _Starting(threading.local):
    is_for_all = False


_starting = _Starting()
"""Whether a thread that the calling one starts runs code of several executions."""


def starter_outside() -> Starter | None:
    """Return the starter of the calling thread, which runs no callback; None: it has none."""
    found = _starter.get()
    if found is None:
        found = getattr(threading.current_thread(), _ATTRIBUTE, None)
    return found


def set_starter(context: contextvars.Context, starter: Starter | None) -> None:
    """Let code that runs in a context work on behalf of an execution; None: change nothing."""
    if starter is not None:
        context.run(_starter.set, starter)


@contextmanager
def starting_for_all() -> Iterator[None]:
    """Let threads that are started while entered work on behalf of no execution."""
    before, _starting.is_for_all = _starting.is_for_all, True
    try:
        yield
    finally:
        _starting.is_for_all = before


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
    start: Any = threading.Thread.start
    submit: Any = ThreadPoolExecutor.submit

    @wraps(start)
    def start_thread(self: threading.Thread) -> None:
        starter = None if _starting.is_for_all else starter_here()
        if starter is not None:
            self.__dict__[_ATTRIBUTE] = starter
        start(self)

    @wraps(submit)
    def submit_with_starter(
        self: ThreadPoolExecutor, function: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> Any:
        starter = starter_here()
        if starter is None:
            return submit(self, function, *args, **kwargs)
        with starting_for_all():  # its threads also run functions that others submit
            return submit(self, run_for, starter, function, *args, **kwargs)

    def with_starter(method: Any) -> Any:
        @wraps(method)
        def run_with_starter(
            self: ThreadPool, func: Callable[..., Any], *args: Any, **kwargs: Any
        ) -> Any:
            starter = starter_here()
            if starter is not None:
                func = partial(run_for, starter, func)
            return method(self, func, *args, **kwargs)
        return run_with_starter

    make: Any = ThreadPool.__init__

    @wraps(make)
    def make_pool(self: ThreadPool, *args: Any, **kwargs: Any) -> None:
        with starting_for_all():
            make(self, *args, **kwargs)

    ThreadPool.__init__ = make_pool  # type: ignore[method-assign]
    for name in _OF_POOLS:
        setattr(ThreadPool, name, with_starter(getattr(ThreadPool, name)))
    threading.Thread.start = start_thread  # type: ignore[method-assign]
    ThreadPoolExecutor.submit = submit_with_starter  # type: ignore[assignment,method-assign]
