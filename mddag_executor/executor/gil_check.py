# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether a thread computes, or waits for anything but the GIL.

Theory of operation
-------------------
1.  Linux shows what each thread of a process does, in ``/proc/self/task/TID/syscall``: the system
    call that it sleeps in, and the arguments of this call, or that it runs or is ready to.
2.  A thread that waits for the GIL sleeps in a futex of the interpreter's data about the GIL.  The
    futex' address is the first argument of the call.  It is the same for all threads as long as
    the process lives.  It is learnt once: a thread needs the GIL while another one keeps it.
3.  So a thread that sleeps anywhere else waits for something else: a lock, a socket, a time.
    Neither a late virtual CPU nor the load of the machine can change that.
4.  A callback that computes may wait for something else for a moment, even for the engine's lock,
    which the thread that checks it owns.  So two checks decide (``GilCheck``): at both of them,
    the thread waited for something else, and it has hardly computed in between.  One that polls
    for something, and sleeps in between, waits as well.
5.  If the kernel does not show it (gVisor, or a program with capabilities of its own), or the
    address is not found (a C library that is not the GNU one, an interpreter without GIL), every
    thread counts as waiting for something else.  Then only the time that it has computed decides.
    A callback that got no CPU between two checks shares the GIL with the callback that wants it;
    but none waits for ever.
"""

from __future__ import annotations

import ctypes
from functools import cache
import os
import threading
from time import clock_gettime_ns, pthread_getcpuclockid, sleep

from mddag_executor.core import NEVER

CHECK_NS = 2_000_000
LAST_CHECK_NS = 10 * CHECK_NS
CHECK_PART = 4
"""
The interval between checks grows from the first to the last; short callbacks use the last.  It
begins again at each turn in which something more urgent waits than the interval allows.  So others
start soon after a callback that has computed for long begins to wait: 1 to 14 ms after that on two
busy CPUs.  With an interval that went on growing it was 25 to 50 ms.

The first is shorter if what waits is urgent: this part of ``Interpreter.patience``.  With half of
it, the successor of a callback that waits after its publication started 0.1 ms later.
"""

POLLS = 20
"""A thread that computes for less than this part of the time waits, and polls for something."""

GIL_BYTES = 256
"""
Addresses of the GIL are less than this apart.

Its condition variables and their mutexes are next to each other, and have 176 bytes.
"""

LOOKS = 10_000
LOOK_US = 100
"""
How often, and how far apart, a thread that needs the GIL is looked at to learn the address.

The second look finds it, but on a machine with sixteen busy threads on two CPUs one of sixty
threads got no CPU for a hundred.
"""

_libc = ctypes.PyDLL(None)  # the GIL is kept during calls
_libc.read.restype = ctypes.c_ssize_t


def _fields(path: str) -> list[bytes]:
    """Return the words in a small file of the kernel, and keep the GIL; none if it is missing."""
    file = _libc.open(path.encode(), os.O_RDONLY | os.O_CLOEXEC)
    if file < 0:
        return []
    buffer = ctypes.create_string_buffer(256)
    size = _libc.read(file, buffer, len(buffer))
    _libc.close(file)
    return buffer.raw[:max(0, size)].split()


def _first_argument(tid: int) -> int:
    """Return that of the system call that a thread sleeps in; -1: it runs; 0: it is not known."""
    fields = _fields(f'/proc/self/task/{tid}/syscall')
    if len(fields) == 1:
        return -1
    return int(fields[1], 16) if fields else 0


def cpu_wait_ns() -> int | None:
    """Return how long the calling thread has waited for a CPU in its life; None: unknown."""
    fields = _fields('/proc/thread-self/schedstat')
    # a kernel that does not count this shows zeros; each thread has had at least one turn
    return int(fields[1]) if len(fields) == 3 and fields[2] != b'0' else None


def _is_shown() -> bool:
    """Return whether the kernel shows what threads of this process do."""
    try:
        with open('/proc/self/syscall', encoding='ascii') as file:
            return bool(file.read())
    except OSError:  # a process whose program has capabilities may not read it
        return False


@cache
def _gil_address() -> int:
    """Return an address in the data about the GIL; 0: it is not known."""
    if not _is_shown():
        return 0
    ended: list[bool] = []

    def need_it() -> None:
        while not ended:
            sleep(0)

    thread = threading.Thread(target=need_it, name='needs the GIL', daemon=True)
    thread.start()
    before = 0
    try:
        for _ in range(LOOKS):
            _libc.usleep(LOOK_US)
            address = _first_argument(thread.native_id or 0)
            # no address is as small as the first argument of ``sleep``
            if address == before > GIL_BYTES:
                return address
            before = address
        return 0
    finally:
        ended.append(True)
        thread.join()


def waits_for_else(tid: int) -> bool:
    """Return whether a thread of this process, by its native id, sleeps, but not for the GIL."""
    address, gil = _first_argument(tid), _gil_address()
    return address >= 0 and (not gil or abs(address - gil) >= GIL_BYTES)


def cpu_ns(ident: int) -> int:
    """Return the CPU time of a thread, ns."""
    return clock_gettime_ns(pthread_getcpuclockid(ident))


class GilCheck:
    """
    Finds out whether an execution that holds the GIL computes.

    :ivar at: when to check next, monotonic ns; NEVER: never.
    :ivar subject: the execution to check.
    """

    __slots__ = ('at', 'subject', '_step', '_next_step', '_has_begun', '_waited')

    def __init__(self) -> None:
        _gil_address()
        self.at = NEVER
        self.subject: object = None
        self._step = self._next_step = 0
        self._has_begun = False
        # if it waited when it was last checked: when that was, and its CPU time until then
        self._waited: tuple[int, int] | None = None

    def begin(self, subject: object, now: int, after: int, step: int) -> None:
        """
        Start checking an execution, unless it is being checked already as soon.

        :param after: time until the first check, ns; ``step``: from that to the second one.
        """
        if self.subject is not subject or after < self._step:
            self.subject = subject
            self._step, self._next_step = after, step
            self._has_begun = False
            self._waited = None
            self.at = now + after
            if after >= LAST_CHECK_NS:
                # on a grid, so that several short callbacks do not each set the timer again
                self.at = self.at // CHECK_NS * CHECK_NS + CHECK_NS

    def has_begun(self, subject: object) -> bool:
        """Return whether an execution has been checked once."""
        return self.subject is subject and self._has_begun

    def end(self) -> None:
        """Stop checking."""
        self.subject = None
        self.at = NEVER

    def waits(self, ident: int, tid: int, now: int) -> bool:
        """
        Return whether the thread waits for anything but the GIL, as it did at the last check.

        The thread must not end meanwhile.

        :param ident: the thread's id in Python; ``tid``: its native id.
        :param now: monotonic ns.
        """
        self._has_begun = True
        self._step = self._next_step
        self._next_step = min(2 * self._step, LAST_CHECK_NS)
        self.at = now + self._step
        last, self._waited = self._waited, None
        if not waits_for_else(tid):
            return False
        own = cpu_ns(ident)
        self._waited = now, own
        return last is not None and POLLS * (own - last[1]) < now - last[0]
