# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A process that a callback forks ends when the callback does.

The child has one thread, the one that runs the callback, and shares the descriptors of the
executor with its parent.  If it went on, it would take events of the parent, wait for locks that
threads of the parent own, and run the nodes a second time.
"""

from __future__ import annotations

from contextlib import suppress
import os
import sys
import traceback
from typing import Any, NoReturn

from mddag_executor.executor.work import current, Work


def end_copy(work: Work, outcome: Any) -> NoReturn:
    """
    End this process, a copy whose callback has ended.

    :param outcome: what the callback returned or raised.  ``SystemExit`` says the exit status;
        else it is 1, and standard error has the reason.
    """
    status: Any = 1
    with suppress(BaseException):
        if isinstance(outcome, SystemExit):
            status = outcome.code
        elif isinstance(outcome, BaseException):
            traceback.print_exception(outcome)
        else:
            print(f'error: {work.entity.label}: it forked this process and returned in the copy, '
                  'which ends, as it would run all nodes a second time: end the copy with '
                  'os._exit, or use subprocess', file=sys.stderr)
        if status is None:
            status = 0
        elif not isinstance(status, int):
            print(status, file=sys.stderr)
            status = 1
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
    os._exit(status & 0xff if isinstance(status, int) else 1)


def _note_fork() -> None:
    """Note in a child that it is a copy whose callback runs."""
    if current.running is not None:
        current.running.is_copy = True


os.register_at_fork(after_in_child=_note_fork)
