# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Starts, watches and ends the processes of one run.

Theory of operation
-------------------
The processes put themselves into groups of their own, so that Ctrl-C reaches the supervisor only,
which passes it on, and they end when the supervisor does, even if that was killed
(``belong_to_parent``).  They stay in its session, which has its share of the CPUs.

What they print is passed on line by line, each line with the name of its process before it.  An
error line of one that then ends with status 2 is the supervisor's error.

A process that ends ahead of the run's end has *died*, unless its status is 0.  What follows is
said by ``on_exit``: ``end`` ends all, ``continue`` lets the others go on, ``restart`` starts it
again after ``REST_S``, for what is left of the run then.  The run ends when nothing runs any more.

It does end: what does not end ``END_TIMEOUT_S`` after another one has ended in order, because the
run was over, is asked to end (SIGTERM); what has not ended as long after it was asked is killed.
Both are said, in one line that names the process.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
import ctypes
from dataclasses import dataclass, field
import os
import signal
import subprocess
import threading
import time
from typing import BinaryIO, TextIO

from mddag_executor.errors import MddagError

REST_S = 1.0
END_TIMEOUT_S = 20.0
_LOOK_S = 0.02
_PR_SET_PDEATHSIG = 1
_BAD_INPUT = 2


class ProcessError(MddagError):
    """What a process of the run found wrong with its input."""


def belong_to_parent(parent: int) -> None:
    """Leave Ctrl-C to the process that started this one, and end when it ends (on Linux)."""
    os.setpgrp()
    try:
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    except (AttributeError, OSError):
        return
    if os.getppid() != parent:  # it has ended already
        os.kill(os.getpid(), signal.SIGTERM)


@dataclass
class Run:
    """
    One process, from its start to its end.

    :ivar name: of the process in the declaration.
    :ivar nth: how many of this name there have been, with this one.
    :ivar status: its exit status, negative for a signal; None while it runs.
    :ivar asked: it was asked to end; ``killed``: it did not, and was killed.
    """

    name: str
    nth: int
    process: subprocess.Popen[bytes]
    status: int | None = None
    asked: bool = False
    killed: bool = False
    _words: deque[str] = field(default_factory=lambda: deque(maxlen=50))
    _errors: list[str] = field(default_factory=list)
    _threads: list[threading.Thread] = field(default_factory=list)

    @property
    def died(self) -> bool:
        """Return whether it ended by an exception, a signal or an error."""
        # asked to end while it started: ahead of its own handler, or its nodes cannot start then
        as_asked = self.asked and self.status in (-signal.SIGTERM, _BAD_INPUT)
        return self.status not in (None, 0) and not as_asked

    @property
    def said(self) -> str:
        """Return the last line that it wrote to standard error."""
        lines = (*self._words, *self._errors)
        return next((line for line in reversed(lines) if line.strip()), '')

    @property
    def how(self) -> str:
        """Return how it ended."""
        if self.status is not None and self.status < 0:
            try:
                return f'was ended by {signal.Signals(-self.status).name}'
            except ValueError:
                return f'was ended by signal {-self.status}'
        return f'ended with status {self.status}'


class Supervisor:
    """
    Runs processes.

    :param command: returns the command line of a process, by its name and number, and the seconds
        since the run's begin.
    :param on_exit: ``end``, ``continue`` or ``restart``.
    :param out: where standard output goes; ``err``: standard error.
    :param on_end: called with each that has ended.
    """

    def __init__(
        self, command: Callable[[str, int, float], Sequence[str]], on_exit: str, out: TextIO,
        err: TextIO, on_end: Callable[[Run], None],
    ) -> None:
        self.runs: list[Run] = []
        self._command = command
        self._on_exit = on_exit
        self._out, self._err = out, err
        self._on_end = on_end
        self._lock = threading.Lock()
        self._stop = False
        self._asked_at: float | None = None
        self._over_at: float | None = None
        self._to_start: list[tuple[float, str]] = []

    def stop(self, hurried: bool = False) -> None:
        """Let the run end; from any thread, also from a signal's handler."""
        self._stop = True

    def run(self, names: Sequence[str], seconds: float | None) -> None:
        """
        Run processes until all have ended.

        :param seconds: so long they run by themselves: one that ends in order later takes no other
            along; None: for ever.
        :raises ProcessError: when one finds its input wrong.
        """
        begin = time.monotonic()
        try:
            for name in names:
                self._start(name, 0.0)
            while any(run.status is None for run in self.runs) or self._to_start:
                time.sleep(_LOOK_S)
                now = time.monotonic()
                for run in self.runs:
                    if run.status is None and run.process.poll() is not None:
                        is_over = seconds is not None and now - begin >= seconds
                        self._ended(run, now, is_over)
                if seconds is not None and now - begin >= seconds:
                    self._to_start.clear()
                self._start_again(now, now - begin)
                self._end_if_asked(now)
        finally:
            for run in self.runs:
                if run.status is None:
                    run.process.kill()
                    self._reap(run)

    def _start(self, name: str, since: float) -> None:
        nth = 1 + sum(run.name == name for run in self.runs)
        process = subprocess.Popen(
            self._command(name, nth, since), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, env={**os.environ, 'PYTHONUNBUFFERED': '1'})
        run = Run(name, nth, process)
        self.runs.append(run)
        for source, target in ((process.stdout, self._out), (process.stderr, self._err)):
            assert source is not None
            thread = threading.Thread(
                target=self._pass_on, args=(run, source, target), daemon=True,
                name=f'output of {name}')
            run._threads.append(thread)
            thread.start()

    def _pass_on(self, run: Run, source: BinaryIO, target: TextIO) -> None:
        """Pass on what a process prints."""
        for raw in source:
            line = raw.decode(errors='replace').rstrip('\r\n')
            if target is self._err:
                if line.startswith('error: '):
                    run._errors.append(line)
                    continue
                run._words.append(line)
            self._print(f'[{run.name}] {line}', target)

    def _print(self, line: str, target: TextIO) -> None:
        with self._lock:
            try:
                target.write(f'{line}\n')
                target.flush()
            except (OSError, ValueError):
                pass  # nobody reads it any more: the process goes on

    def _reap(self, run: Run) -> None:
        run.status = run.process.wait()
        for thread in run._threads:
            thread.join(1.0)  # what it has started itself may hold its output open
        if run.status != _BAD_INPUT:
            for line in run._errors:
                self._print(f'[{run.name}] {line}', self._err)

    def _ended(self, run: Run, now: float, is_over: bool) -> None:
        self._reap(run)
        if run.status == _BAD_INPUT and not run.asked:
            raise ProcessError(f'process {run.name}: {run.said.removeprefix("error: ")}')
        self._on_end(run)
        if is_over and not run.died and self._over_at is None:
            self._over_at = now
        if self._stop or (is_over and not run.died):
            return
        if self._on_exit == 'restart':
            self._to_start.append((now + REST_S, run.name))
        elif self._on_exit == 'end':
            self._stop = True

    def _start_again(self, now: float, since: float) -> None:
        if self._stop:
            self._to_start.clear()
        for at, name in [each for each in self._to_start if each[0] <= now]:
            self._to_start.remove((at, name))
            self._start(name, since)

    def _end_if_asked(self, now: float) -> None:
        """Ask all to end, once, also those that should have ended; kill what then does not."""
        running = [run for run in self.runs if run.status is None]
        late = self._over_at is not None and now - self._over_at > END_TIMEOUT_S
        if (self._stop or late) and self._asked_at is None:
            self._asked_at = now
            for run in running:
                if not self._stop:
                    self._print(f'warning: process {run.name} has not ended with the others: it '
                                'is asked to', self._err)
                run.asked = True
                run.process.terminate()
            self._stop = True
        elif self._asked_at is not None and now - self._asked_at > END_TIMEOUT_S:
            for run in running:
                if not run.killed:
                    self._print(f'warning: process {run.name} has not ended within '
                                f'{END_TIMEOUT_S:g} s: it is killed', self._err)
                    run.killed = True
                    run.process.kill()
