# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The one place in which idle workers wait: an epoll over everything that can happen.

Theory of operation
-------------------
1.  *Channels.*  The middleware announces what arrives by writing to an eventfd (``listeners``).
    A channel is such a descriptor with the sources that share it: most sources have one of their
    own; when there are more than ``fd_budget`` of them, several share one.
2.  *Waiting.*  All descriptors are registered edge-triggered in one epoll.  However many workers
    wait, the kernel wakes exactly one for each event.  ``wake`` wakes one more.
3.  *Time.*  One timerfd stands for the earliest of all times at which something has to be done.
4.  *Muting.*  Nobody is woken for what cannot start.  While a callback holds the GIL for long,
    what holds it, too, and has more time than the callback needs stays in the middleware.  So
    sources whose callbacks hold the GIL are registered in nested epolls by relative deadline
    (``URGENCIES_NS``), and ``mute`` switches off those with at least a given relative deadline:
    one system call each.  ``unmute`` switches them on again, and returns what has arrived.
5.  Descriptors of removed sources are used again, never closed before the end: if an entity is
    being destroyed elsewhere, its listener may write once more, which then wakes for nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
import os
import resource
import select
from typing import Protocol

from mddag_executor.executor.listeners import new_eventfd, TimerFd

URGENCIES_NS = tuple(ms * 1_000_000 for ms in (2, 5, 10, 20, 50, 100, 200, 500))
"""
Relative deadlines at which the nested epolls begin; a source is in the last that it reaches.

A callback that holds the GIL for another 250 ms mutes nothing any more: what has a deadline of
500 ms may overtake it (``core.queues.PATIENCE``).
"""

ALWAYS = -1
"""The urgency of what is never muted."""

_EDGE = select.EPOLLIN | select.EPOLLET

Events = list[tuple[int, int]]


class ChannelSource(Protocol):
    """
    What a channel announces arrivals for.

    :ivar asks_others: ``collect`` calls code of others, so nobody may have a lock.
    :ivar is_counted: the descriptor is its own, so its count says how much has arrived.
    """

    fd: int
    urgency: int
    is_counted: bool
    asks_others: bool

    def collect(self) -> None:
        """Take what has arrived."""


def fd_budget() -> int:
    """Return how many eventfds to use at most: a quarter of what the process may open."""
    return max(16, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 4)


def urgency_of(relative_deadline_ns: int) -> int:
    """Return the nested epoll for sources with such a relative deadline, or ALWAYS."""
    found = ALWAYS
    for index, bound in enumerate(URGENCIES_NS):
        if relative_deadline_ns >= bound:
            found = index
    return found


class EventLoop:
    """An epoll with its channels; all methods but ``wait`` and ``wake`` under one lock."""

    def __init__(self, urgencies_ns: tuple[int, ...] = URGENCIES_NS) -> None:
        self._epoll = select.epoll()
        self._urgencies_ns = urgencies_ns
        self._nested = [select.epoll() for _ in urgencies_ns]
        self._nested_fds = {nested.fileno(): nested for nested in self._nested}
        self.timer = TimerFd()
        self._bell = new_eventfd()
        self._leave = new_eventfd()
        self._epoll.register(self.timer.fd, _EDGE)
        self._epoll.register(self._bell, _EDGE)
        for nested in self._nested:
            self._epoll.register(nested.fileno(), _EDGE)
        self._channels: dict[int, tuple[ChannelSource, ...]] = {}
        self._shared: dict[str, list[int]] = {}
        self._shared_fds: set[int] = set()
        self._asking_fds: set[int] = set()
        self._free: list[int] = []
        self._muted = len(urgencies_ns)
        self._budget = fd_budget()

    @property
    def fd(self) -> int:
        """Return the descriptor of the epoll, for another epoll to wait for."""
        return self._epoll.fileno()

    # --- sources ---------------------------------------------------------------------------------

    def add(self, source: ChannelSource, share: str = '') -> None:
        """
        Give a source a descriptor; the caller sets the listener.

        :param share: all sources that name the same share one, because they are seldom used.
        """
        most = 0
        if share:
            most = 1
        elif len(self._channels) >= self._budget:
            most = self._budget
        fds = self._shared.setdefault(share, []) if most else []
        source.urgency = ALWAYS
        source.is_counted = not most
        if most and len(fds) >= most:
            source.fd = fds.pop(0)
            fds.append(source.fd)
            self._channels[source.fd] += (source,)
            return
        source.fd = self._free.pop() if self._free else new_eventfd()
        if most:
            fds.append(source.fd)
            self._shared_fds.add(source.fd)
        if source.asks_others:
            self._asking_fds.add(source.fd)
        self._channels[source.fd] = (source,)
        self._epoll.register(source.fd, _EDGE)

    def add_own(self, source: ChannelSource) -> None:
        """Wait for a source that has a descriptor of its own."""
        self._channels[source.fd] = (source,)
        self._epoll.register(source.fd, _EDGE)

    def remove(self, source: ChannelSource) -> None:
        """Forget a source whose listener has been cleared."""
        fd, source.fd = source.fd, -1
        rest = tuple(each for each in self._channels[fd] if each is not source)
        if rest:
            self._channels[fd] = rest
            return
        del self._channels[fd]
        self._home(source.urgency).unregister(fd)
        self._shared_fds.discard(fd)
        self._asking_fds.discard(fd)
        for fds in self._shared.values():
            if fd in fds:
                fds.remove(fd)
        self._free.append(fd)

    def has(self, source: ChannelSource) -> bool:
        """Return whether a source is one of this loop."""
        return source in self._channels.get(source.fd, ())

    def move(self, source: ChannelSource, urgency: int) -> None:
        """Have a source muted with its urgency from now on; ALWAYS: never."""
        if source.fd < 0 or source.urgency == urgency or source.fd in self._shared_fds:
            return
        self._home(source.urgency).unregister(source.fd)
        self._home(urgency).register(source.fd, _EDGE)  # reports what has arrived meanwhile
        source.urgency = urgency

    def _home(self, urgency: int) -> select.epoll:
        return self._epoll if urgency == ALWAYS else self._nested[urgency]

    def hold(self, sources: Iterable[ChannelSource]) -> None:
        """Wake nobody for some sources until ``release``; from any thread, without the lock."""
        self._set_mask(sources, 0)

    def release(self, sources: Iterable[ChannelSource]) -> None:
        """End ``hold``; what has arrived and was not taken wakes somebody."""
        self._set_mask(sources, _EDGE)

    def _set_mask(self, sources: Iterable[ChannelSource], mask: int) -> None:
        for source in sources:
            fd, urgency = source.fd, source.urgency
            epoll = self._epoll if urgency == ALWAYS else self._nested[urgency]
            try:
                epoll.modify(fd, mask)
                if source.fd != fd:  # removed just now: somebody else may have its descriptor
                    epoll.modify(fd, _EDGE)
            except (OSError, ValueError):
                pass  # it was removed or moved just now

    def announce(self, source: ChannelSource, count: int = 1) -> None:
        """Have a source looked at once more, as if so much had arrived."""
        if source.fd >= 0:
            os.eventfd_write(source.fd, count)

    # --- waiting ---------------------------------------------------------------------------------

    def wait(self, timeout_s: float = -1) -> Events:
        """Return events, waiting for one until the time is over; -1: for ever."""
        return [] if self._epoll.closed else self._epoll.poll(timeout_s)

    def sources(
        self, events: Events
    ) -> tuple[list[ChannelSource], list[ChannelSource], bool]:
        """
        Return the sources at which something has arrived, and whether the timer has expired.

        Those that call code of others come second.
        """
        found: list[ChannelSource] = []
        asking: list[ChannelSource] = []
        expired = False
        for fd, _ in events:
            channel = self._channels.get(fd)
            if channel is not None:
                if fd in self._asking_fds:
                    asking += channel
                else:
                    found += channel
            elif fd == self.timer.fd:
                expired = True
            elif fd in self._nested_fds:
                for inner, _ in self._nested_fds[fd].poll(0):
                    found += self._channels.get(inner, ())
        return found, asking, expired

    def wake(self) -> None:
        """Wake one of those that wait; from any thread, also after ``close``."""
        try:
            os.eventfd_write(self._bell, 1)
        except (OSError, ValueError):
            pass

    def wake_all(self) -> None:
        """Wake all that wait, and let nobody wait until ``let_wait``."""
        os.eventfd_write(self._leave, 1)
        self._epoll.register(self._leave, select.EPOLLIN)

    def let_wait(self) -> None:
        """End what ``wake_all`` has begun."""
        self._epoll.unregister(self._leave)
        os.eventfd_read(self._leave)

    # --- muting ----------------------------------------------------------------------------------

    def mute(self, relative_deadline_ns: int) -> None:
        """Wake nobody for sources that hold the GIL and have at least this relative deadline."""
        first = len(self._nested)
        while first > 0 and self._urgencies_ns[first - 1] >= relative_deadline_ns:
            first -= 1
        for index in range(first, self._muted):
            self._epoll.modify(self._nested[index].fileno(), 0)
        for index in range(self._muted, first):
            self._epoll.modify(self._nested[index].fileno(), _EDGE)
        self._muted = first

    def unmute(self) -> Events:
        """End muting; return what has arrived meanwhile, so that nobody is woken for that."""
        found: Events = []
        for index in range(self._muted, len(self._nested)):
            nested = self._nested[index]
            found += nested.poll(0)
            self._epoll.modify(nested.fileno(), _EDGE)
        self._muted = len(self._nested)
        return found

    def close(self) -> None:
        """
        Close all descriptors, once; nobody waits any more.

        Those of sources that still have a listener stay open: it may write to them.
        """
        fds = [*self._free, self._bell, self._leave, self.timer.fd]
        self._bell = self._leave = self.timer.fd = -1
        self._free.clear()
        for fd in fds:
            if fd >= 0:
                os.close(fd)
        for epoll in (self._epoll, *self._nested):
            epoll.close()

    def __del__(self) -> None:
        """Close what an executor that was never shut down has left open."""
        self.close()
