# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A function that runs in a separate process.

rclpy's executors cannot be stopped in order while callbacks wait for their pool, so the child ends
without destroying anything.  A child that does not end in time is killed, because rclpy's
EventsExecutor blocks SIGTERM.  The kernel also kills it when its parent ends
(``signal_at_end_of``), even if it hangs and holds the GIL.
"""

from __future__ import annotations

from collections.abc import Callable
import ctypes
from multiprocessing import get_context
from multiprocessing.connection import Connection
import os
from pathlib import Path
import pkgutil
import signal
import time
from typing import Any, NoReturn

from mddag_executor.errors import MddagError
from mddag_executor.shared_memory import remove_segments, segments_removed
from msg_graph import GraphError

_PR_SET_PDEATHSIG = 1

Tick = Callable[[float], None]
"""Called every half second with the seconds since the start of the run."""


class ChildError(MddagError):
    """A run that the child cannot make."""


class CrashError(ChildError):
    """A run whose child crashed or hung."""


def run_child(
    function: str, arguments: tuple[Any, ...], name: str, limit_s: float, tick: Tick | None = None
) -> Any:
    """
    Call a function in a child and return its result; its output is not shown.

    :param function: as ``module:function``; only the child imports the module.
    :param name: of the run, for messages.
    :param limit_s: the child is killed after this time.
    :raises CrashError: when the child crashed, was killed, or gave no result.
    :raises ChildError: when its input is wrong.
    """
    context = get_context('spawn')
    results, sender = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(sender, os.getpid(), function, arguments))
    process.start()
    sender.close()
    begin = time.monotonic()
    try:
        while not results.poll(0.5):
            passed = time.monotonic() - begin
            if passed > limit_s:
                raise CrashError(f'{name}: it did not end within {limit_s:.0f} s and was killed')
            if tick is not None:
                tick(passed)
        error, result = results.recv()
    except EOFError:
        process.join()
        status = process.exitcode or 0
        how = f'crashed with signal {-status}' if status < 0 else f'ended with status {status}'
        raise CrashError(f'{name}: it {how} and gave no result') from None
    finally:
        with segments_removed(process.pid or 0):
            process.kill()
            process.join()
        results.close()
    if error is not None:
        raise error(result if error is ChildError else f'{name}: {result}')
    return result


def _answer(
    sender: Connection, parent: int, function: str, arguments: tuple[Any, ...]
) -> NoReturn:
    """Send the class of an error, or None, and its text or the result."""
    signal_at_end_of(parent, signal.SIGKILL)
    for stream in (1, 2):  # native code of rclpy also writes there
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    # This machine only: the child and nodes of other machines must not discover each other.
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    try:
        try:
            result = pkgutil.resolve_name(function)(*arguments)
        finally:
            remove_segments()   # first: the parent kills this process when it has the answer
        sender.send((None, result))
    except (MddagError, GraphError) as error:
        sender.send((ChildError, str(error)))
    except BaseException as error:
        sender.send((CrashError, f'{type(error).__name__}: {error}'))
    os._exit(0)  # the interpreter's exit would join the executor's threads


def signal_at_end_of(parent: int, which: signal.Signals) -> None:
    """Let the kernel send this process a signal when its parent ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, which)
    if has_ended(parent):
        os.kill(os.getpid(), which)


def has_ended(parent: int) -> bool:
    """
    Return whether the parent of this process has ended, or is ending.

    The signal comes when the thread that started this process has ended.  A parent that was killed
    remains the parent until its other threads have ended as well.
    """
    if os.getppid() != parent:
        return True
    try:
        state = Path('/proc', str(parent), 'stat').read_text().rpartition(')')[2].split()[0]
    except OSError:     # it ended just now, or this machine does not show it
        return os.getppid() != parent
    return state in 'ZX'    # of its first thread
