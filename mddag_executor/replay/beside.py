# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A long trace of this executor, read and linked in a process beside this one.

Theory of operation
-------------------
Python computes on one CPU.  Where there is another one and the trace is long, a second process
reads and links it, and feeds the observers that need no verdicts.  What it reports of the run it
sends here, where the judge is, and at the end what has become of the run and its observers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import os
import pickle
import signal
import subprocess
import sys
from typing import Any

from mddag_executor.defaults import processors
from mddag_executor.errors import MddagError
from mddag_executor.replay.drift import DriftObserver
from mddag_executor.replay.happenings import Batch, KINDS, Observer, tell_end
from mddag_executor.replay.own import OwnRun, STOP
from mddag_executor.replay.paths import Paths
from mddag_executor.replay.run import open_run
from mddag_executor.replay.usage import GroupWaits
from mddag_executor.resources import import_environment

LEAST_EVENTS = 1_000_000
Played = tuple[OwnRun, Paths, DriftObserver]
_PROGRAM = 'from mddag_executor.replay.beside import serve; serve()'


def pays(run: OwnRun) -> bool:
    """Return whether a second process is quicker: the trace is long, and there is a CPU for it."""
    return run.when_played is None and run.events >= LEAST_EVENTS and processors() > 1


def play_beside(
    run: OwnRun, waits: GroupWaits, observers: Sequence[Observer],
    progress: Callable[[int], None] | None,
) -> Played:
    """
    Feed observers a run that another process reads; return that run, and who observed there.

    :param waits: is fed there, too, and then what was found by it.
    """
    with subprocess.Popen(
            [sys.executable, '-c', _PROGRAM], env=import_environment(),
            stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stdout is not None
        try:
            pickle.dump(run.recording, process.stdin)
            process.stdin.close()
            while True:
                what, *more = pickle.load(process.stdout)
                if what == 'over':
                    played: Played = more[0]
                    return played
                if what == 'error':
                    raise more[0]
                if what == 'progress':
                    if progress is not None:
                        progress(*more)
                    continue
                if what == 'take':
                    *of_batch, waits.found = more
                    more = [Batch(*of_batch)]
                if what == 'finished':
                    tell_end(observers, *more)
                    continue
                for observer in observers:
                    getattr(observer, what)(*more)
        except (EOFError, pickle.UnpicklingError, BrokenPipeError):
            raise MddagError(
                f'{run.name}: the process that read it has ended early: see whether it ran out of '
                'memory') from None
        finally:
            process.kill()


class _Sender(Observer):
    """Sends what happened to the process that asked."""

    def __init__(self, send: Callable[..., None], waits: GroupWaits) -> None:
        self._send, self._waits = send, waits

    def take(self, batch: Batch) -> None:
        """Send a batch."""
        self._send('take', batch.order, {kind: batch.columns(kind) for kind in range(len(KINDS))},
                   {name: numbers for name, numbers in batch.events.items() if name == STOP},
                   self._waits.found)

    def hosted(self, dag: int, vertices: set[int]) -> None:
        """Send it."""
        self._send('hosted', dag, vertices)

    def judging(self, release: int) -> None:
        """Send it."""
        self._send('judging', release)

    def was_dropped(self, vertex: int, job: int, reason: str) -> None:
        """Send it."""
        self._send('was_dropped', vertex, job, reason)

    def finished(self, now: int, batch: Batch) -> None:
        """Send it; what is decided there comes of it."""
        self._send('finished', now)


def serve() -> None:
    """Read and link the run that standard input names, and write it to standard output."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    with os.fdopen(os.dup(1), 'wb') as out:
        os.dup2(2, 1)

        def send(*what: Any) -> None:
            pickle.dump(what, out, pickle.HIGHEST_PROTOCOL)
            out.flush()     # so that it is taken in while the next is made

        try:
            run = open_run(*pickle.load(sys.stdin.buffer))
            assert isinstance(run, OwnRun)
            waits = GroupWaits(run.who)
            paths, drift = Paths(run), DriftObserver(run)
            run.play([waits, _Sender(send, waits), paths, drift],
                     lambda events: send('progress', events))
            paths.book.results()
            send('over', (run, paths, drift))
        except MddagError as error:
            send('error', error)
        except BrokenPipeError:
            os._exit(1)     # nobody wants it any more
