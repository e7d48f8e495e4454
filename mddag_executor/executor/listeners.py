# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Descriptors for an epoll: eventfds that the middleware writes to, and a timerfd.

Theory of operation
-------------------
rcl calls a listener ``callback(const void * user_data, size_t number_of_events)`` for each
message, request, response or event that arrives, and for each reset of a timer.  libc's
``eventfd_write(int fd, eventfd_t value)`` fits this call on the ABIs of x86-64 and aarch64.  So
the middleware writes to an eventfd directly: without Python, without the GIL, and without a thread
of this package.  Setting and clearing a listener is synchronous.

An eventfd counts arrivals.  epoll reports each write once (edge-triggered), so the count need not
be read.

The calls of the hot path keep the GIL (``ctypes.PyDLL``), as none of them blocks: those of ``os``
and ``select`` give it away, partly under the engine's lock, and then another thread that computes
keeps it for a switch interval.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
import ctypes
from functools import cache, partial
import os
import platform
import threading
import time
from typing import Any

from mddag_executor.core import NEVER
from mddag_executor.errors import MddagError

_libc = ctypes.PyDLL(None, use_errno=True)  # no call blocks, so the GIL is kept
# Those of the hot path, without errno, and without ``argtypes``, whose conversions take a third of
# a call.  ``os`` and ``select`` would let another thread take the GIL.
_quick = ctypes.PyDLL(None)
_eventfd_write = _quick.eventfd_write
_eventfd_read = _quick.eventfd_read
_rcl = ctypes.CDLL('librcl.so')  # rclpy has loaded it
_WRITE = ctypes.cast(_libc.eventfd_write, ctypes.c_void_p)

MANY = 1 << 20
"""The count for all messages present, if they were not counted."""

_SETTERS = {
    'subscription': 'rcl_subscription_set_on_new_message_callback',
    'service': 'rcl_service_set_on_new_request_callback',
    'client': 'rcl_client_set_on_new_response_callback',
    'event': 'rcl_event_set_callback',
    'timer': 'rcl_timer_set_on_reset_callback',
}
# rcl has no listener for guard conditions: their trigger is wrapped (``publishing``)
_GUARDS: dict[int, tuple[int, ...]] = {}
_guards_lock = threading.Lock()


def _setter(name: str) -> Any:
    function = getattr(_rcl, name)
    function.argtypes = [ctypes.c_void_p] * 3
    function.restype = ctypes.c_int
    return function


_SET = {kind: _setter(name) for kind, name in _SETTERS.items()}

_next_call_time = ctypes.PyDLL('librcl.so').rcl_timer_get_next_call_time  # it reads one number
_until_next_call = _rcl.rcl_timer_get_time_until_next_call
_timer_settime = _quick.timerfd_settime


class ListenerError(MddagError):
    """The middleware cannot announce arrivals at an entity."""


def set_listener(kind: str, address: int, fd: int) -> None:
    """
    Let the middleware write to an eventfd at each arrival at an entity.

    Earlier arrivals count as well: the descriptor becomes readable at once, with ``MANY``.

    :param kind: ``subscription``, ``service``, ``client``, ``event``, ``timer`` or
        ``guard_condition``.
    :param address: of the rcl entity, which must not be destroyed meanwhile.
    :raises ListenerError: when the middleware has no listener for such an entity.
    """
    if kind == 'guard_condition':
        with _guards_lock:
            _GUARDS[address] = (*_GUARDS.get(address, ()), fd)
    elif _SET[kind](address, _WRITE, fd) != 0:
        raise ListenerError(f'{kind}: the middleware cannot announce what arrives: use another '
                            'RMW_IMPLEMENTATION')
    announce(fd, MANY)


def clear_listener(kind: str, address: int, fd: int) -> None:
    """Stop the middleware from writing for an entity; it does not write after this returns."""
    if kind != 'guard_condition':
        _SET[kind](address, None, None)
        return
    with _guards_lock:
        rest = tuple(each for each in _GUARDS.get(address, ()) if each != fd)
        if rest:
            _GUARDS[address] = rest  # at once: a trigger may read it at any time
        else:
            _GUARDS.pop(address, None)


def announce_trigger(address: int) -> None:
    """Write for a guard condition that has been triggered; a signal handler may call this."""
    for fd in _GUARDS.get(address, ()):
        announce(fd)


def new_eventfd() -> int:
    """Return a new non-blocking eventfd."""
    return os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)


def announce(fd: int, count: int = 1) -> None:
    """Add to the count of an eventfd; a closed one is ignored."""
    _eventfd_write(fd, ctypes.c_uint64(count))


def read_count(fd: int) -> int:
    """Return the count of an eventfd, and set it to 0; 0 also if it is closed."""
    count = ctypes.c_uint64()
    return count.value if _eventfd_read(fd, ctypes.byref(count)) == 0 else 0


_IS_PACKED = platform.machine() == 'x86_64'


class _EpollEvent(ctypes.Structure):
    """The kernel's ``epoll_event``, which is packed on x86-64 only."""

    _pack_ = 4 if _IS_PACKED else 8
    _fields_ = (
        ('events', ctypes.c_uint32), *(() if _IS_PACKED else (('_', ctypes.c_uint32),)),
        ('fd', ctypes.c_int32), ('_rest', ctypes.c_uint32))


_MOST_EVENTS = 64
_EPOLL_CTL_MOD = 3


@cache
def _event(events: int, fd: int) -> Any:
    return ctypes.byref(_EpollEvent(events=events, fd=fd))


def change_events(epoll: int, fd: int, events: int) -> None:
    """Change the events that a descriptor is registered for; errors are ignored."""
    _quick.epoll_ctl(epoll, _EPOLL_CTL_MOD, fd, _event(events, fd))


class Poll:
    """
    Asks an epoll, without waiting, what is ready; not for several threads at once.

    :param epoll: its descriptor.
    """

    __slots__ = ('_epoll', '_found', '_reference')

    def __init__(self, epoll: int) -> None:
        self._epoll = epoll
        self._found = (_EpollEvent * _MOST_EVENTS)()
        self._reference = ctypes.byref(self._found)

    def __call__(self) -> list[tuple[int, int]]:
        """Return descriptors and events."""
        count = _quick.epoll_wait(self._epoll, self._reference, _MOST_EVENTS, 0)
        if count <= 0:
            return []
        return [(each.fd, each.events) for each in self._found[:count]]


class NextCall:
    """The time of the next call of the rcl timer at an address, on the timer's clock."""

    __slots__ = ('_value', '_read', '_until')

    def __init__(self, address: int) -> None:
        self._value = ctypes.c_int64()
        arguments = ctypes.c_void_p(address), ctypes.byref(self._value)
        self._read: Callable[[], int] = partial(_next_call_time, *arguments)
        self._until: Callable[[], int] = partial(_until_next_call, *arguments)

    def read(self) -> int | None:
        """Return the time in ns; None when the timer is cancelled."""
        return self._value.value if self._read() == 0 else None

    def until(self) -> int | None:
        """Return the time until then in ns, negative if it is due; None when it is cancelled."""
        return self._value.value if self._until() == 0 else None


def _nothing() -> int:
    return 0


class TimerFd:
    """
    A timerfd on the monotonic clock.

    :ivar fd: becomes readable at the set time.
    :ivar at: that time, monotonic ns; NEVER: none is set.
    """

    __slots__ = ('fd', 'at', '_time', '_set')

    def __init__(self) -> None:
        self.fd: int = _libc.timerfd_create(time.CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if self.fd < 0:
            error = ctypes.get_errno()
            raise OSError(error, os.strerror(error))
        self.at = NEVER
        self._time = array('q', (0, 0, 0, 0))  # interval, then time: seconds, nanoseconds
        # 1: TFD_TIMER_ABSTIME
        address = ctypes.c_void_p(self._time.buffer_info()[0])
        self._set: Callable[[], int] = partial(_timer_settime, self.fd, 1, address, None)

    def arm(self, at: int) -> None:
        """
        Set the time (monotonic ns); NEVER, or any later time: none.

        A time in the past, also one before the boot of the machine, expires at once.
        """
        self.at = at
        if at >= NEVER:
            at = 0  # which means that no time is set
        elif at <= 0:  # the system call accepts no negative time
            at = 1
        fields = self._time
        fields[2] = at // 1_000_000_000
        fields[3] = at % 1_000_000_000
        if self._set() != 0 and self.fd >= 0:
            raise OSError(f'timerfd_settime does not accept {self._time[2:].tolist()}')

    def close(self) -> None:
        """Close the descriptor, once."""
        fd, self.fd = self.fd, -1
        if fd >= 0:
            self._set = _nothing  # another descriptor may get its number
            os.close(fd)

    def __del__(self) -> None:
        """Close the descriptor of an executor that could not be made."""
        self.close()
