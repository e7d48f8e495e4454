# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the verbs print for people: messages and progress; tables are in ``report.text``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import sys
import time
from types import TracebackType
from typing import TextIO, TYPE_CHECKING

from mddag_executor import progress
from mddag_executor.report.text import Cell, format_ns, is_coloured, printable, table

if TYPE_CHECKING:
    import subprocess

__all__ = [
    'Cell', 'Progress', 'format_ns', 'is_quiet', 'label', 'one_line', 'printable', 'run_program',
    'say', 'set_quiet', 'table', 'warn']


def one_line(text: str) -> str:
    """Return a message as a single harmless line."""
    return printable(' '.join(text.split()))


SLOW_S = 10.0
_quiet = False


def set_quiet(quiet: bool) -> None:
    """Say whether tables, warnings and progress are left out from now on (`-q`)."""
    global _quiet
    _quiet = quiet


def is_quiet() -> bool:
    """Return whether only errors and results in files are wanted."""
    return _quiet


def label(word: str, stream: TextIO) -> str:
    """Return the word that begins a message, in bold on a terminal that shows colours."""
    return f'\x1b[1m{word}\x1b[0m' if is_coloured(stream) else word


def say(text: str) -> None:
    """Print a line for people."""
    if not _quiet:
        print(text)


def warn(*texts: str) -> None:
    """Print warnings on standard error, each as a single harmless line."""
    for text in () if _quiet else texts:
        print(f'{label("warning", sys.stderr)}: {one_line(text)}', file=sys.stderr)


class Progress:
    """
    One line on a terminal for work that takes longer than two seconds, and silence otherwise.

    It is a context manager; the line is wiped when the work ends. Nothing is written when the
    stream (standard error by default) is not a terminal. It shows ``what`` is going on, for
    instance `simulating`, and how much of the ``total`` is done, if that is known.
    """

    PATIENCE_S = 2.0
    INTERVAL_S = 0.2

    def __init__(self, what: str, total: int | float | None = None, *,
                 stream: TextIO | None = None,
                 clock: Callable[[], float] = time.monotonic) -> None:
        self._what = one_line(what)
        self._total = total
        self._stream = sys.stderr if stream is None else stream
        self._clock = clock
        self._next = clock() + self.PATIENCE_S if self._stream.isatty() and not _quiet else (
            float('inf'))
        self._shown = 0

    def __enter__(self) -> Progress:
        progress.LISTENERS.append(self._note)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        progress.LISTENERS.remove(self._note)
        self.wipe()

    def wipe(self) -> None:
        """Remove the line, for other output."""
        if self._shown:
            self._stream.write('\r' + ' ' * self._shown + '\r')
            self._stream.flush()
            self._shown = 0

    def update(self, done: int | float, note: str = '') -> None:
        """Show how much of the total is done, and a note; cheap enough for an inner loop."""
        if self._next == float('inf') or self._clock() < self._next:
            return
        if self._total:
            part = f'{100 * min(done / self._total, 1.0):.0f} %'
        else:
            part = f'{done:g}'
        self._show(f'{part} {one_line(note)}'.rstrip())

    def _note(self, what: str) -> None:
        if self._clock() >= self._next:
            self._show(what)

    def _show(self, text: str) -> None:
        self._next = self._clock() + self.INTERVAL_S
        line = f'{self._what}: {text}'[:79]
        self._stream.write('\r' + line.ljust(self._shown))
        self._stream.flush()
        self._shown = max(self._shown, len(line))

    def events(self, done: int) -> None:
        """Show how many events of a trace have been read so far."""
        self.update(round(done / 1e6, 1), 'million events')


def run_program(
    command: Sequence[str], what: str, seconds: float | None = None, given: bytes | None = None,
    environment: Mapping[str, str] | None = None, slow: str = '',
) -> subprocess.CompletedProcess[bytes]:
    """
    Run a program on the given input; show progress, of `seconds` if that is known.

    :param slow: a warning if it takes longer than ``SLOW_S``.
    """
    import subprocess
    begin = time.monotonic()
    with Progress(what, seconds) as line, subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            env=environment) as process:
        try:
            while True:
                try:
                    out, errors = process.communicate(given, timeout=0.5)
                    return subprocess.CompletedProcess(command, process.returncode, out, errors)
                except subprocess.TimeoutExpired:
                    given = None
                    passed = time.monotonic() - begin
                    if slow and passed > SLOW_S:
                        line.wipe()
                        warn(slow)
                        slow = ''
                    line.update(round(passed, 1), 's')
        except BaseException:
            process.terminate()
            raise
