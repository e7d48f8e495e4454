# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The two places in which idle threads wait: an epoll over all events, and one over none of them.

Theory of operation
-------------------
1.  *Channels.*  The middleware announces arrivals by writing to an eventfd (``listeners``).  A
    channel is an eventfd with the sources that share it.  Most sources have their own; seldom used
    ones of a node (timers, built-in services) share one, as do all after ``_budget`` channels.
2.  *Waiting.*  All descriptors are registered edge-triggered in one epoll.  However many workers
    wait, the kernel wakes exactly one for each event.  ``wake`` wakes one more.
3.  *Time.*  One timerfd is set to the earliest time at which anything has to be done.
4.  *Parking.*  Threads that are not to be woken by events wait in ``Parking``, a second epoll.
5.  Descriptors of removed sources are used again and closed only at the end.  If an entity is
    being destroyed concurrently, its listener may write once more; that wake-up is spurious.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import cache
import os
import resource
import select

from mddag_executor.executor.listeners import (
    announce,
    change_events,
    new_eventfd,
    Poll,
    read_count,
    TimerFd,
)

_EDGE = select.EPOLLIN | select.EPOLLET

Events = list[tuple[int, int]]


MOST_DESCRIPTORS = 65_536
"""The soft limit of open files is raised to this at most: some programs visit each one."""


@cache
def raise_limit() -> None:
    """
    Raise the soft limit of open files of the process to the hard one; further calls do nothing.

    The usual soft limit, 1,024, is for programs that use ``select``.  Child processes inherit it.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = MOST_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, MOST_DESCRIPTORS)
    if soft != resource.RLIM_INFINITY and soft < most:
        with suppress(ValueError, OSError):  # a sandbox may forbid it
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


class ChannelSource:
    """
    Anything that announces arrivals by a descriptor.

    :ivar fd: the descriptor, -1: none.
    :ivar is_counted: the descriptor is not shared, so its count is the number of arrivals.
    """

    __slots__ = ('fd', 'is_counted')

    def __init__(self) -> None:
        self.fd = -1
        self.is_counted = False

    def collect(self) -> None:
        """Collect the arrivals."""
        raise NotImplementedError


class EventLoop:
    """An epoll with its channels; all methods but ``wait`` and ``wake`` need one lock."""

    _bell = _leave = _epoll_fd = -1

    def __init__(self) -> None:
        self._free: list[int] = []
        try:
            self._open()
        except BaseException:  # too many open files
            self.close()
            raise

    def _open(self) -> None:
        self._epoll = select.epoll()
        #: waits for events until the timeout (s; -1: for ever), and returns them
        self.wait: Callable[..., Events] = self._epoll.poll
        self._epoll_fd = self._epoll.fileno()
        #: returns events without waiting; needs the lock
        self.poll: Callable[[], Events] = Poll(self._epoll_fd)
        self.timer = TimerFd()
        self._bell = new_eventfd()
        self._leave = new_eventfd()
        self._epoll.register(self.timer.fd, _EDGE)
        self._epoll.register(self._bell, _EDGE)
        #: the sources of each descriptor
        self.channels: dict[int, tuple[ChannelSource, ...]] = {}
        self._shared: dict[str, int] = {}
        # a quarter of the descriptors that the process may open
        soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        self._budget = (MOST_DESCRIPTORS if soft == resource.RLIM_INFINITY else soft) // 4

    @property
    def fd(self) -> int:
        """Return the descriptor of the epoll, for use in another epoll."""
        return self._epoll.fileno()

    # --- sources ---------------------------------------------------------------------------------

    def add(self, source: ChannelSource, share: str = '') -> None:
        """
        Give a source a descriptor; the caller sets the listener.

        :param share: sources with the same name share one descriptor, as they are seldom used.
        """
        if not share and len(self.channels) >= self._budget:
            share = 'the rest'
        source.is_counted = not share
        if share in self._shared:
            source.fd = self._shared[share]
            self.channels[source.fd] += (source,)
            return
        source.fd = self._free.pop() if self._free else new_eventfd()
        if share:
            self._shared[share] = source.fd
        self.channels[source.fd] = (source,)
        self._epoll.register(source.fd, _EDGE)

    def add_own(self, source: ChannelSource) -> None:
        """Wait for a source that has its own descriptor."""
        self.channels[source.fd] = (source,)
        self._epoll.register(source.fd, _EDGE)

    def remove(self, source: ChannelSource) -> None:
        """Forget a source whose listener has been cleared."""
        fd, source.fd = source.fd, -1
        rest = tuple(each for each in self.channels[fd] if each is not source)
        if rest:
            self.channels[fd] = rest
            return
        del self.channels[fd]
        self._epoll.unregister(fd)
        self._shared = {name: each for name, each in self._shared.items() if each != fd}
        self._free.append(fd)

    def mute(self, sources: Iterable[ChannelSource]) -> None:
        """Stop wake-ups for some sources until ``unmute``; from any thread, without the lock."""
        self._set_mask(sources, 0)

    def unmute(self, sources: Iterable[ChannelSource]) -> None:
        """End ``mute``; arrivals that were not collected wake a thread."""
        self._set_mask(sources, _EDGE)

    def _set_mask(self, sources: Iterable[ChannelSource], mask: int) -> None:
        for source in sources:
            fd = source.fd
            change_events(self._epoll_fd, fd, mask)
            if source.fd != fd:  # removed just now: another source may have its descriptor
                change_events(self._epoll_fd, fd, _EDGE)

    def announce(self, source: ChannelSource, count: int = 1) -> None:
        """Announce a source again, as if ``count`` more messages had arrived."""
        announce(source.fd, count)

    # --- waiting ---------------------------------------------------------------------------------

    def sources(self, events: Events) -> Iterator[ChannelSource]:
        """Yield the sources with arrivals."""
        for fd, _ in events:
            yield from self.channels.get(fd, ())

    def wake(self) -> None:
        """Wake one waiting thread; from any thread, also after ``close``."""
        announce(self._bell)

    def wake_all(self) -> None:
        """Wake all waiting threads, and let no thread wait until ``let_wait``, unless closed."""
        if self._leave >= 0:
            announce(self._leave)
            self._epoll.register(self._leave, select.EPOLLIN)

    def let_wait(self) -> None:
        """End ``wake_all``: threads may wait again, unless the loop was closed meanwhile."""
        if self._leave >= 0:
            self._epoll.unregister(self._leave)
            read_count(self._leave)

    def close(self) -> None:
        """
        Close all descriptors, once; no thread waits any more.

        Descriptors of sources that still have a listener stay open: it may write to them.
        """
        fds = [*self._free, self._bell, self._leave]
        self._bell = self._leave = self._epoll_fd = -1
        self._free.clear()
        self.wait = self.poll = lambda *_: []
        _close(self, fds, ('timer', '_epoll'))

    def __del__(self) -> None:
        """Close the descriptors of an executor that was never shut down."""
        self.close()


def _close(owner: object, fds: Iterable[int], names: Iterable[str]) -> None:
    """Close descriptors, and what an owner has by these names, as far as it could be opened."""
    for fd in fds:
        if fd >= 0:
            os.close(fd)
    for name in names:
        if hasattr(owner, name):
            getattr(owner, name).close()


class Parking:
    """
    Where threads wait that no event is to wake: one at a time wakes, for a call or the watch.

    :ivar watch: a timerfd, set to the time at which one of them is to look.
    """

    _bell = _end = -1

    def __init__(self) -> None:
        try:
            self._epoll = select.epoll()
            #: waits, and returns what has woken the thread
            self.wait: Callable[[], Events] = self._epoll.poll
            self.watch = TimerFd()
            self._bell = new_eventfd()
            self._end = new_eventfd()
            for fd in (self.watch.fd, self._bell):
                self._epoll.register(fd, _EDGE)
            self._epoll.register(self._end, select.EPOLLIN)
        except BaseException:  # too many open files
            self.close()
            raise

    def call(self) -> None:
        """Wake one thread."""
        announce(self._bell)

    def end(self) -> None:
        """Wake all threads, and let no thread wait any more; from any thread."""
        announce(self._end)

    def close(self) -> None:
        """Close all descriptors, once; no thread waits any more."""
        fds = self._bell, self._end
        self._bell = self._end = -1
        _close(self, fds, ('watch', '_epoll'))

    def __del__(self) -> None:
        """Close the descriptors of an executor that was never shut down."""
        self.close()
