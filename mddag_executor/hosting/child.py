# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A run in a separate process, which returns its result as JSON.

``run_child`` is called by the process that wants the result, ``answer`` by the child.  rclpy's
executors cannot be stopped in order while callbacks wait for their pool, so the child ends without
destroying anything.  A child that does not end in time is killed, because rclpy's EventsExecutor
blocks SIGTERM.  The kernel also kills it when its parent ends (``signal_at_end_of``), even if it
hangs and holds the GIL.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import ctypes
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from typing import Any, NoReturn, TextIO

from mddag_executor.errors import MddagError
from msg_graph import GraphError

_BAD_INPUT, _DEFECT = 2, 70
_KILLED = -9
_PR_SET_PDEATHSIG = 1
_PARENT = 'MDDAG_CHILD_OF'

Tick = Callable[[float], None]
"""Called every half second with the seconds since the start of the child."""


class ChildError(MddagError):
    """A run that the child cannot make."""


class CrashError(ChildError):
    """A run whose child crashed or hung."""


def run_child(
    command: Sequence[str], name: str, limit_s: float, tick: Tick | None = None
) -> dict[str, Any]:
    """
    Run a child and return its result.

    :param name: of the run, for messages.
    :param limit_s: the child is killed after this time.
    :raises CrashError: when the child crashed, was killed, or gave no result.
    :raises ChildError: when its input is wrong.
    """
    # This machine only: the child and nodes of other machines must not discover each other.
    environment = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', **os.environ,
                   _PARENT: str(os.getpid())}
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=out, stderr=err, env=environment)
        try:
            _wait(process, limit_s, tick)
        finally:
            process.kill()
            process.wait()
        out.seek(0)
        err.seek(0)
        lines = err.read().decode(errors='replace').strip().splitlines()
        if process.returncode == _BAD_INPUT and lines:
            raise ChildError(lines[-1])
        if process.returncode != 0:
            raise CrashError(f'{name}: {_reason(process.returncode, limit_s, lines)}')
        text = out.read()
        try:
            result: dict[str, Any] = json.loads(text)
        except ValueError:
            raise CrashError(
                f'{name}: it ended well but gave no result: {text[:60]!r}') from None
        return result


def _wait(process: subprocess.Popen[bytes], limit_s: float, tick: Tick | None) -> None:
    begin = time.monotonic()
    while (passed := time.monotonic() - begin) < limit_s:
        if tick is not None:
            tick(passed)
        try:
            process.wait(0.5)
            return
        except subprocess.TimeoutExpired:
            continue


def _reason(status: int, limit_s: float, lines: Sequence[str]) -> str:
    if status == _KILLED:
        return f'it did not end within {limit_s:.0f} s and was killed'
    if status < 0:
        return f'it crashed with signal {-status}'
    return lines[-1] if lines else f'it ended with status {status}'


def answer(run: Callable[[], dict[str, Any]]) -> NoReturn:
    """Make a run in this process, print its result as JSON, and end the process."""
    if _PARENT in os.environ:
        signal_at_end_of(int(os.environ.pop(_PARENT)), signal.SIGKILL)
    output = _take_stdout()
    status = 0
    try:
        result = run()
        with output:
            json.dump(result, output, default=list)
            output.write('\n')
    except (MddagError, GraphError) as error:
        print(error, file=sys.stderr)
        status = _BAD_INPUT
    except BaseException:
        traceback.print_exc()
        status = _DEFECT
    sys.stderr.flush()
    os._exit(status)  # the interpreter's exit would join the executor's threads


def signal_at_end_of(parent: int, which: signal.Signals) -> None:
    """
    Let the kernel send this process a signal when its parent ends, on Linux.

    :param parent: the process id of the parent.
    """
    try:
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, which)
    except (AttributeError, OSError):
        return
    if os.getppid() != parent:  # it has ended already
        os.kill(os.getpid(), which)


def _take_stdout() -> TextIO:
    """
    Return standard output, and redirect other output on it to standard error.

    Native code of rclpy writes there: for instance about a clock with many timers.
    """
    output = os.fdopen(os.dup(sys.stdout.fileno()), 'w')
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return output
