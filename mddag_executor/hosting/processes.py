# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A run of several processes: start, watch and end them, and combine their results.

Theory of operation
-------------------
1. *Signals.*  Each process has its own process group, from its start on (with Python 3.10 a
   little later).  So Ctrl-C reaches only the supervisor, which passes it on.  The processes end
   when the supervisor does, even if it was killed (``belong_to_parent``).  They stay in its
   session, which has its share of the CPUs.
2. *Output* is passed on line by line, each prefixed with the name of its process.  If a process
   ends with status 2, its error line becomes the supervisor's error.
3. *Ends.*  A process that ends before the run does has *died*, unless its status is 0.  Then all
   processes end, or the others continue (``goes_on``).  The run ends when no process runs any
   more.
4. *Timeouts.*  When a process has ended in order because the run was over, each process that still
   runs ``END_TIMEOUT_S`` later receives SIGTERM.  After the same time again it is killed.  Both
   are reported in one line with the name of the process.
5. *Results.*  The run makes a folder with the declaration for all processes.  Each process leaves
   its result there, under its process id.  Sinks are judged and callbacks are counted where they
   run.  The core combines the verdicts (``core.tally.of_processes``).  The rules of drift get the
   sum of the observations.
6. *Common start.*  Synthetic nodes start at the same time in all processes.  Each process notes in
   the folder that its nodes are *made*.  When all have, it waits until publishers and
   subscriptions have discovered each other, and notes that it is *ready*.  The start is
   ``LEAD_NS`` after the last of these times.  Processes wait for each other without a
   timeout; but once the run has noted that a process has *ended*, none is waited for any more.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
import json
import math
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import threading
import time
from typing import Any, BinaryIO, TextIO

from mddag_executor.child import has_ended, signal_at_end_of
from mddag_executor.core.tally import of_processes
from mddag_executor.errors import MddagError
from mddag_executor.executor.entity import add_counts
from mddag_executor.executor.session import MATCH_TIMEOUT_S, Session
from mddag_executor.shared_memory import segments_removed
from msg_graph import TaskSet
from msg_graph.binding import Entity
from msg_graph.drift import drift, Observed, Releases

END_TIMEOUT_S = 40.0  # longer than a session's
_POLL_S = 0.02
_OWN_GROUP: Any = {'process_group': 0} if sys.version_info >= (3, 11) else {}
_BAD_INPUT = 2
LEAD_NS = 100_000_000

Results = Mapping[str, Mapping[str, Any]]
"""The result of each process that has left one, by name."""


class ProcessError(MddagError):
    """A process of the run has found an error in its input."""


def belong_to_parent(parent: int) -> None:
    """Ignore Ctrl-C, which the parent passes on, and end when the parent ends."""
    os.setpgrp()
    signal_at_end_of(parent, signal.SIGTERM)


@dataclass
class Run:
    """
    One process, from its start to its end.

    :ivar name: of the process in the declaration.
    :ivar status: its exit status, negative for a signal; None while it runs.
    :ivar asked: it was sent SIGTERM, or ended when the run was to end.
    """

    name: str
    process: subprocess.Popen[bytes]
    status: int | None = None
    asked: bool = False
    _last_words: str = ''
    _errors: list[str] = field(default_factory=list)
    _threads: list[threading.Thread] = field(default_factory=list)

    @property
    def died(self) -> bool:
        """Return whether it ended by an exception, a signal or an error."""
        # SIGTERM during its start: before `main`, before the run, or its nodes could not start.
        # The terminal's SIGINT reaches a process before that has a group of its own.
        as_asked = self.asked and self.status in (
            -signal.SIGTERM, 128 + signal.SIGTERM, -signal.SIGINT, 128 + signal.SIGINT, _BAD_INPUT)
        return self.status not in (None, 0) and not as_asked

    @property
    def said(self) -> str:
        """Return the last line that it wrote to standard error."""
        return (self._errors or [self._last_words])[-1]

    @property
    def how(self) -> str:
        """Return how it ended."""
        if self.status is not None and self.status < 0:
            return f'was ended by signal {-self.status} ({signal.strsignal(-self.status)})'
        return f'ended with status {self.status}'

    def kill(self) -> None:
        """End it: see ``kill``."""
        kill(self.process)


def kill(process: subprocess.Popen[Any]) -> None:
    """End a process, and remove the middleware's shared memory that it leaves."""
    with segments_removed(process.pid):
        process.kill()
        process.wait()


class Supervisor:
    """
    Runs processes.

    :param command: returns the command line of a process, by its name.
    :param goes_on: whether the others continue when one ends by itself.
    :param out: the target of standard output; ``err``: of standard error.
    :param on_end: called with each process that has ended.
    """

    def __init__(
        self, command: Callable[[str], Sequence[str]], goes_on: bool, out: TextIO, err: TextIO,
        on_end: Callable[[Run], None],
    ) -> None:
        self.runs: list[Run] = []
        self._command = command
        self._goes_on = goes_on
        self._out, self._err = out, err
        self._on_end = on_end
        self._lock = threading.Lock()
        self._stop = False
        self._ask_at = math.inf
        self._kill_at: float | None = None

    @property
    def stopped(self) -> bool:
        """Return whether the run is to end."""
        return self._stop

    def stop(self) -> None:
        """End the run; from any thread or signal handler."""
        self._stop = True

    def hurry(self) -> None:
        """Let the processes wait no longer for what still runs at the end."""
        for run in self.runs:
            if run.status is None and run.asked:
                run.process.send_signal(signal.SIGINT)

    def run(self, names: Sequence[str], seconds: float | None) -> None:
        """
        Run processes until all have ended.

        :param seconds: how long they run by themselves: a process that ends in order after that
            does not end the others; None: for ever.
        :raises ProcessError: when a process finds an error in its input.
        """
        begin = time.monotonic()
        try:
            for name in names:
                self._start(name)
            while any(run.status is None for run in self.runs):
                time.sleep(_POLL_S)
                now = time.monotonic()
                for run in self.runs:
                    if run.status is None and run.process.poll() is not None:
                        is_over = seconds is not None and now - begin >= seconds
                        self._ended(run, now, is_over)
                self._end_if_due(now)
        finally:
            for run in self.runs:
                if run.status is None:
                    run.kill()
                    self._reap(run)

    def _start(self, name: str) -> None:
        process = subprocess.Popen(
            self._command(name), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, env={**os.environ, 'PYTHONUNBUFFERED': '1'},
            **_OWN_GROUP)
        run = Run(name, process)
        self.runs.append(run)
        for source, target in ((process.stdout, self._out), (process.stderr, self._err)):
            assert source is not None
            thread = threading.Thread(
                target=self._pass_on, args=(run, source, target), daemon=True,
                name=f'output of {name}')
            run._threads.append(thread)
            thread.start()

    def _pass_on(self, run: Run, source: BinaryIO, target: TextIO) -> None:
        """Pass on the output of a process."""
        for raw in source:
            line = raw.decode(errors='replace').rstrip('\r\n')
            if target is self._err:
                if line.startswith('error: '):
                    run._errors.append(line)
                    continue
                run._last_words = line.strip() or run._last_words
            self._print(f'[{run.name}] {line}', target)

    def _print(self, line: str, target: TextIO) -> None:
        # where the reader has closed the output, the process continues
        with self._lock, suppress(OSError, ValueError):
            print(line, file=target, flush=True)

    def _reap(self, run: Run) -> None:
        run.status = run.process.wait()
        for thread in run._threads:
            thread.join(1.0)  # a subprocess may keep its output open
        if run.status != _BAD_INPUT:
            for line in run._errors:
                self._print(f'[{run.name}] {line}', self._err)

    def _ended(self, run: Run, now: float, is_over: bool) -> None:
        self._reap(run)
        run.asked |= self._stop
        if run.status == _BAD_INPUT and not run.asked:
            raise ProcessError(f'process {run.name}: {run.said.removeprefix("error: ")}')
        self._on_end(run)
        if is_over and not run.died:
            self._ask_at = min(self._ask_at, now + END_TIMEOUT_S)
        if not self._goes_on and (run.died or not is_over):
            self._stop = True

    def _end_if_due(self, now: float) -> None:
        """Send SIGTERM to all processes once the run is over; kill those that do not end then."""
        running = [run for run in self.runs if run.status is None]
        if self._kill_at is None and (self._stop or now > self._ask_at):
            self._kill_at = now + END_TIMEOUT_S
            for run in running:
                if not self._stop:
                    self._print(f'warning: process {run.name} has not ended with the others: it '
                                'is asked to', self._err)
                run.asked = True
                run.process.terminate()
        elif self._kill_at is not None and now > self._kill_at:
            for run in running:
                self._print(f'warning: process {run.name} has not ended within '
                            f'{END_TIMEOUT_S:g} s: it is killed', self._err)
                run.kill()
                self._ended(run, now, is_over=True)


@dataclass(frozen=True)
class Part:
    """
    A process of a run, as it sees itself.

    :ivar parent: the process id of the run.
    :ivar text: the declaration.
    :ivar options: those of the command line that are common to all processes.
    """

    folder: Path
    parent: int
    text: str
    options: dict[str, Any]

    @classmethod
    def make(cls, folder: str, text: str, options: dict[str, Any]) -> None:
        """Prepare the folder of a run."""
        _write(Path(folder, 'run.json'), json.dumps(
            {'parent': os.getpid(), 'text': text, 'options': options}))

    @classmethod
    def read(cls, folder: str) -> Part:
        """Return this process's part from the folder of its run."""
        return cls(Path(folder), **json.loads(Path(folder, 'run.json').read_text()))

    def write_result(self, result: Any) -> None:
        """Store the result of this process in the folder, which goes if the run was killed."""
        try:
            _write(self.folder / f'{os.getpid()}.json', json.dumps(result, default=list))
        except FileNotFoundError:   # another process has removed it, if the run was killed
            if not has_ended(self.parent):
                raise
        if has_ended(self.parent):  # nothing else can remove the folder
            shutil.rmtree(self.folder, ignore_errors=True)

    @staticmethod
    def has_begun(folder: str) -> bool:
        """Return whether a process was ready to begin."""
        return any(Path(folder).glob('*.ready'))

    @staticmethod
    def note_end(folder: str, name: str) -> None:
        """Note in the folder that a process has ended."""
        Path(folder, f'{name}.ended').touch()

    def start_together(
        self, name: str, names: Sequence[str], session: Session,
        unmatched: Callable[[], list[str]], patience_s: float = MATCH_TIMEOUT_S,
    ) -> int:
        """
        Wait for the common start of all processes, and return it (monotonic ns).

        Returns early if the run is to end.

        :param unmatched: returns the topics on which publishers and subscriptions have not
            discovered each other; ``patience_s``: how long to wait for progress.
        :raises mddag_executor.executor.session.SessionError: when discovery fails.
        """
        self._reach('made', name, names, session)
        session.wait_until_matched(
            lambda: [] if self._is_left_alone() else unmatched(), patience_s)
        at = self._reach('ready', name, names, session) + LEAD_NS
        session.wait(max(0, at - time.monotonic_ns()) / 1e9)
        return at

    def _is_left_alone(self) -> bool:
        return any(self.folder.glob('*.ended'))

    def _reach(self, step: str, name: str, names: Sequence[str], session: Session) -> int:
        """Wait until all processes have reached a step; return when the last one did."""
        _write(self.folder / f'{name}.{step}', str(time.monotonic_ns()))
        paths = [self.folder / f'{each}.{step}' for each in names]
        while not (all(path.exists() for path in paths) or self._is_left_alone()):
            if session.wait(0.01):
                break
        return max(int(path.read_text()) for path in paths if path.exists())


def _write(path: Path, text: str) -> None:
    """Write a file that others never see half written."""
    part = path.with_suffix('.part')
    try:
        part.write_text(text)
    except OSError as error:    # a full disk
        error.filename = error.filename or str(path.parent)
        raise
    part.replace(path)


def read_result(folder: str, pid: int) -> Any:
    """Return the result of a process, None if it has none."""
    path = Path(folder, f'{pid}.json')
    return json.loads(path.read_text()) if path.exists() else None


def combine_results(task_set: TaskSet, results: Results) -> dict[str, Any]:
    """Return the result of a run, combined from those of its processes."""
    parts = list(results.values())
    begun = {each['callback'] for part in parts for each in part['unfinished']}
    callbacks: dict[str, dict[str, Any]] = {}
    for part in parts:  # executors' internal callbacks may share a name
        for name, counts in part['callbacks'].items():
            add_counts(callbacks, name, counts)
    return {
        **of_processes(task_set, results),
        'requirements': {name: each for part in parts
                         for name, each in part['requirements'].items()},
        'stops': {key: sum(part['stops'][key] for part in parts)
                  for key in ('count', 'total_ns', 'misses')},
        'callbacks': callbacks,
        **{key: sum(part[key] for part in parts)
           for key in ('undeclared', 'queue', 'idle_workers', 'lent')},
        'unfinished': [each for part in parts for each in part['unfinished']],
        # of one machine each process notices the same ones
        'clock_steps': max((part['clock_steps'] for part in parts), key=len, default=[]),
        'dropped': {name: c['dropped'] for name, c in callbacks.items() if c['dropped']},
        'unattributed': {key: sum(part['unattributed'][key] for part in parts)
                         for key in ('unknown', 'doubtful')},
        # of a process that has died nothing is known
        'never_ran': [c.key for c in task_set.callbacks
                      if str(task_set.process_of(c.node)) in results and c.key not in begun
                      and not callbacks.get(c.key, {'ran': 0})['ran']],
        'not_found': {key: question for part in parts
                      for key, question in part['not_found'].items()},
        'measured': None,
        'exclusion': [each for part in parts for each in part['exclusion']],
        'drift': [each.result() for each in drift(task_set, _observed(task_set, results))]}


def _observed(task_set: TaskSet, results: Results) -> Observed:
    """Return the observations of the whole system: releases, where they happened."""
    parts = {name: result['observed'] for name, result in results.items()}
    messages, executions = Counter[str](), Counter[str]()
    publishes: dict[str, set[str]] = {}
    received: dict[str, set[str]] = {}
    for part in parts.values():
        messages.update(part['messages'])
        executions.update(part['executions'])
        for found, here in ((publishes, part['publishes']),
                            (received, part['topics_received'])):
            for key, topics in here.items():
                found.setdefault(key, set()).update(topics)
    releases = {}
    for source in (dag.vertices[dag.source].callback for dag in task_set.dags):
        home = parts.get(str(task_set.process_of(source.node)))
        if home is not None:
            releases[source.key] = Releases(**home['releases'][source.key])
    return Observed(
        duration_ns=max((part['duration_ns'] for part in parts.values()), default=0),
        end_ns=max((part['end_ns'] for part in parts.values()), default=0),
        releases=releases, messages=messages, executions=executions,
        topics_received=received, publishes={**publishes},
        nodes={c.node for c in task_set.callbacks if str(task_set.process_of(c.node)) in parts},
        undeclared=[Entity(*each) for part in parts.values() for each in part['undeclared']],
        # of the process that should have it: no other one lacks it
        gone={key: lacks for name, part in parts.items() for key, lacks in part['gone'].items()
              if str(task_set.process_of(key.rpartition(':')[0])) == name},
        outside=[tuple(each) for part in parts.values() for each in part['outside']])
