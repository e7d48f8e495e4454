# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Checks of the engine at the end of every section under its lock, for tests.

If ``MDDAG_DEBUG`` names a Python file, its function ``broken_invariants`` is called with the
engine.  It yields a sentence for each invariant that does not hold.  (The value 1 asks for the
tracebacks of errors: ``cli.main``.)

A check costs time for each waiting execution and each open job.  So if there are more than
``CHECKED_PER_SECTION`` of these, only some sections are followed by a check.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache
import os
import runpy
import threading
from types import TracebackType
from typing import Any

from mddag_executor.errors import MddagError, UsageError

VARIABLE = 'MDDAG_DEBUG'
CHECKED_PER_SECTION = 100
"""How many jobs and executions may be checked after each section: about 0.1 ms."""


class InvariantError(MddagError):
    """
    The engine is in an invalid state; the text lists all violations.

    :ivar broken: these, and what the threads have done before.
    """

    def __init__(self, broken: list[str]) -> None:
        self.broken = broken
        super().__init__(
            f'engine: {"; ".join(broken)}: this is a defect of mddag_executor, please report it')


class CheckedLock:
    """
    A reentrant lock; a check follows each section, unless the section raises.

    :param check: raises when an invariant is violated; it is not called again then.
    :param size: returns how many items there are to check.
    """

    def __init__(self, check: Callable[[], None], size: Callable[[], int]) -> None:
        self._lock = threading.RLock()
        self._check = check
        self._size = size
        self._depth = 0
        self._unchecked = 0
        self._has_failed = False

    def __enter__(self) -> None:
        self._lock.acquire()
        self._depth += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._depth -= 1
        try:
            if kind is None and self._depth == 0 and not self._has_failed:
                self._unchecked += CHECKED_PER_SECTION
                if self._unchecked >= self._size():
                    self._unchecked = 0
                    self._has_failed = True
                    self._check()
                    self._has_failed = False
        finally:
            self._lock.release()

    def _is_owned(self) -> bool:
        return self._lock._is_owned()  # type: ignore[attr-defined, no-any-return]


@cache
def _checks(path: str) -> Callable[[Any], Iterable[str]]:
    """Return the function of a file that finds broken invariants."""
    try:
        found: Callable[[Any], Iterable[str]] = runpy.run_path(path)['broken_invariants']
    except (OSError, KeyError, SyntaxError, UnicodeDecodeError) as error:
        raise UsageError(
            f'{VARIABLE}={path}: the value must be 1, or a Python file with a function '
            f'broken_invariants: {error}') from None
    return found


def engine_lock(engine: Any, story: Callable[[], Iterable[str]]) -> Any:
    """
    Return the lock of an engine: a checked one if ``MDDAG_DEBUG`` asks for it.

    :param story: returns what the threads have done before, for an ``InvariantError``.
    """
    path = os.environ.get(VARIABLE, '')
    if path in ('', '0', '1'):
        return threading.RLock()
    broken_invariants, state = _checks(path), engine.scheduler.state

    def check() -> None:
        broken = [*broken_invariants(engine)]
        if broken:
            raise InvariantError([*broken, *story()])

    return CheckedLock(check, lambda: len(state.job_dag) + len(state.x_state))
