# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The trace writer of a live run: many threads record, one thread writes.

Theory of operation:

1. `record()` is on the executor's hot path. It appends one tuple to a deque, which is atomic in
   CPython: no lock, no waiting. If the deque is full, the event is counted as lost.
2. The writer thread empties the deque every `flush_interval_s` and passes whole chunks to the
   operating system, so a killed process loses little more than that.
3. Encoding needs the GIL, which the workers also need: the thread encodes a small slice of events,
   then sleeps, so no worker waits for more than one slice. If it falls behind, it does not sleep.
4. Losses are written into the trace as `mddag:lost` for readers.
5. If writing fails, recording ends and the run continues; `error` has the reason, and `close()`
   raises it.
"""

from __future__ import annotations

import atexit
from collections import deque
from collections.abc import Callable
import logging
import os
import threading
import time
from typing import Any, TYPE_CHECKING

from mddag_executor.trace.errors import TraceError
from mddag_executor.trace.groups import events_of
from mddag_executor.trace.trace_file import TraceFile

if TYPE_CHECKING:
    from typing_extensions import Unpack

_LOGGER = logging.getLogger(__name__)
_SLICE = 128            # events encoded at once: about 0.2 ms
_NAP_S = 50e-6          # long enough for a waiting thread to get the GIL


def _nothing() -> None:
    pass


def _log(error: TraceError) -> None:
    _LOGGER.error('%s', error)


class TraceWriter:
    """
    Records events from many threads into a trace file.

    The file is readable at any time up to its last whole chunk, and complete after `close()`.
    """

    def __init__(self, path: str | os.PathLike[str], *, clock_offset: int = 0,
                 flush_interval_s: float = 0.25, capacity: int = 1 << 17,
                 overwrite: bool = False) -> None:
        """
        Open the file and start the writer thread.

        :param clock_offset: ns between the trace's clock and `time.monotonic_ns()`
        :param flush_interval_s: interval at which events are written to the operating system
        :param capacity: maximum number of events that wait for the writer thread
        :param overwrite: whether an existing file may be replaced
        """
        #: Offset from `time.monotonic_ns()` to the trace's clock.
        self.clock_offset = clock_offset
        #: Called by the writer thread each time before it writes; it may record.
        self.before_write: Callable[[], None] = _nothing
        #: Why recording ended early; None: no error.
        self.error: TraceError | None = None
        #: Called by the writer thread with this error, at once.
        self.on_error: Callable[[TraceError], None] = _log
        self._file = TraceFile(path, overwrite=overwrite)
        self._interval_s = flush_interval_s
        self._pending: deque[tuple[Any, ...]] = deque()
        self._capacity = capacity       # 0: recording has ended
        self._lost = 0
        self._after_end = 0             # recorded after the end of the trace: not a loss
        # Reentrant: a finalizer or signal handler may record while its thread counts a loss.
        self._lost_lock = threading.RLock()
        self._slice: list[tuple[Any, ...]] = []     # the last slice passed to the file,
        self._given = 0                             # and the number of events before it
        self._reported_lost = 0         # by `mddag:lost` events so far,
        self._reported_until = self.now()           # and up to which time
        self._reported_rejection = False
        self._vpid = os.getpid()
        self._stop = threading.Event()
        self._close_lock = threading.Lock()
        self._ending = self._closed = False
        # A daemon, so that a program without close() can end; atexit completes its file.
        self._thread = threading.Thread(target=self._run, name='mddag trace writer', daemon=True)
        self._thread.start()
        atexit.register(self._end)

    # The tuple of all arguments is stored as it is: unpacking it would double the cost.
    def record(self, *event: Unpack[tuple[str, int, int, Unpack[tuple[Any, ...]]]]) -> None:
        """
        Record one event: its name, its time, the native thread id, then its fields.

        An entry of `groups` records several at once. Never waits, never raises. An event that is
        unknown or whose fields do not fit is skipped by the writer thread, counted in `dropped`,
        and logged once.

        :param event: name (as in `callback_start`), ns on the trace's clock, native id of the
            thread, the values of the event's fields in the order of its type
        """
        if len(self._pending) < self._capacity:
            self._pending.append(event)
        else:
            with self._lost_lock:
                if self._ending:
                    self._after_end += events_of(event)
                else:
                    self._lost += events_of(event)

    def now(self) -> int:
        """Return the time in ns on the trace's clock."""
        return time.monotonic_ns() + self.clock_offset

    @property
    def path(self) -> str:
        """Return the path of the file."""
        return self._file.path

    @property
    def dropped(self) -> int:
        """Return how many recorded events will not be in the file."""
        late = sum(map(events_of, list(self._pending))) if self._closed or self.error else 0
        return self._lost + self._after_end + self._file.rejected + late

    def close(self) -> None:
        """
        Write the rest and the summary, and end the writer thread; a second call does nothing.

        :raises TraceError: (the first time) if writing failed
        """
        if self._end() and self.error:
            raise self.error

    def _end(self) -> bool:
        with self._close_lock:
            # A forked child has no writer thread and must not write the parent's file.
            if self._closed or os.getpid() != self._vpid:
                return False
            self._ending = True
            self._capacity = 0
            self._stop.set()
            self._thread.join()
            self._closed = True
            atexit.unregister(self._end)
            return True

    def _run(self) -> None:
        try:
            while not self._stop.wait(self._interval_s):
                self.before_write()
                self._drain()
                self._file.flush()
            self._drain()
            self._file.finish()
        except TraceError as error:
            self._give_up(error)
        except Exception as error:      # a defect here must not end the traced run
            self._file.abandon()
            self._give_up(TraceError(self._file.path, f'recording ended ({error!r})',
                                     'please report this; what was written before is there'))

    def _drain(self) -> None:
        pending = self._pending
        # Only the present number: recording threads must not delay the flush.
        waiting = len(pending)
        while waiting > 0:
            count = min(waiting, _SLICE)
            self._extend([pending.popleft() for _ in range(count)])
            waiting -= count
            if len(pending) * 2 < self._capacity:
                time.sleep(_NAP_S)
        self._report_losses()

    def _report_losses(self) -> None:
        lost = self._lost + self._file.rejected
        since, self._reported_until = self._reported_until, self.now()
        if lost == self._reported_lost:
            return
        if self._file.rejection and not self._reported_rejection:
            self._reported_rejection = True
            _LOGGER.warning('%s: %s', self._file.path, self._file.rejection)
        count = lost - self._reported_lost
        self._reported_lost = lost
        self._extend([
            ('mddag:lost', self._reported_until, threading.get_native_id(), count, since)])

    def _extend(self, events: list[tuple[Any, ...]]) -> None:
        self._given = self._file.given
        self._slice = events
        self._file.extend(events, self._vpid)

    def _give_up(self, error: TraceError) -> None:
        self._capacity = 0
        with self._lost_lock:
            taken = self._given + sum(map(events_of, self._slice))
            self._lost += taken - self._file.rejected - self._file.written
        self.error = error
        self.on_error(error)
