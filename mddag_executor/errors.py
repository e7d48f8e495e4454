# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The errors that a user of this package can cause.

Theory of operation: whatever is wrong with a file, an argument or a recording becomes an exception
of this tree whose text is the one line that the user sees, `FILE[:LINE]: what is wrong: what to
do`. The command line prints it after `error: ` and exits with status 2; a Python user catches
`MddagError`. An exception outside this tree is a defect of the program and keeps its traceback.
(`msg_graph` is below this package and has `msg_graph.GraphError`, with the same form.)
"""

from __future__ import annotations

import os
from types import TracebackType
from typing import Any

_OWN_FOLDER = os.path.dirname(os.path.abspath(__file__)) + os.sep


class MddagError(Exception):
    """
    Base of this package's errors; its text is the one line that the user sees.

    The line names the place, says what is wrong and what to do about it.

    :ivar status: the exit status of the command that it ends.
    """

    status = 2


class InputError(MddagError):
    """A file or stream that cannot be used as asked."""

    def __init__(self, file: str, problem: str, remedy: str, line: int | None = None) -> None:
        """
        Keep the parts of the message.

        :param file: the path as the user gave it, or `<stdin>`
        :param problem: what is wrong
        :param remedy: what to do about it
        :param line: the line in the file, counted from 1, where that is known
        """
        place = file if line is None else f'{file}:{line}'
        super().__init__(f'{place}: {problem}: {remedy}')
        self.file = file
        self.line = line
        self.problem = problem
        self.remedy = remedy

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str, int | None]]:
        """Pickle by parts, so that the error passes from a worker process unchanged."""
        return type(self), (self.file, self.problem, self.remedy, self.line)


class UserCodeError(MddagError):
    """
    A node raised an exception, which is the cause of this one.

    The command line shows the traceback of the cause and exits with status 70: the line alone,
    and the status of bad input, would take the node's `FileNotFoundError` for one of this program.

    :ivar result: of the run, if ``hosting.run`` raises it.
    """

    status = 70
    result: Any = None


class UsageError(MddagError):
    """Settings, or a command line, that ask for something impossible."""


def from_user_code(error: BaseException) -> BaseException:
    """
    Let an exception's traceback begin in the user's code, and return it.

    The frames of this package before that say nothing about the error.  With `MDDAG_DEBUG=1`, and
    if there are no others, they stay.
    """
    first: TracebackType | None = error.__traceback__
    while first is not None and first.tb_frame.f_code.co_filename.startswith(_OWN_FOLDER):
        first = first.tb_next
    if first is not None and os.environ.get('MDDAG_DEBUG') != '1':
        error.__traceback__ = first
    return error
