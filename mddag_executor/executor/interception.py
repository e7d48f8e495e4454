# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What rclpy does meanwhile when a hosted program asks it to run its nodes.

Theory of operation
-------------------
While installed, these parts of rclpy do something else, and nothing else is touched:

============================================  ====================================================
``rclpy.init``                                nothing for the default context, which exists already
``rclpy.shutdown``, ``try_shutdown``          from a program's own thread: ends that program;
                                              from anywhere else (a callback): ends the run
``rclpy.spin``                                hands the node over and waits for the end
``rclpy.spin_once``                           hands the node over and sleeps for the timeout (10 ms
                                              without): the workers execute the callbacks
``rclpy.spin_until_future_complete``          hands the node over and waits for the future
the same methods of any executor              the same for all of its nodes
``add_node``, ``remove_node`` of an executor  mean our executor as soon as it spins
``create_task``, ``shutdown`` of an executor  makes the task on ours; ends the executor's spin
``rclpy.experimental.EventsExecutor``         makes a stand-in that is treated like the others
``signal.signal`` in a program's thread       nothing: Python allows it in the main thread only
============================================  ====================================================

The methods are replaced in rclpy's classes, so a program that imported an executor's class before,
or derives from it, is served as well.  For the host's own executor they are the originals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
import signal
import threading
from typing import Any, TYPE_CHECKING
import weakref

from mddag_executor.executor.compat import events_executor_modules
from mddag_executor.executor.loading import LoadingError
from mddag_executor.replacements import instead, Replacements
import rclpy
from rclpy.executors import Executor, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
import rclpy.utilities

if TYPE_CHECKING:
    from mddag_executor.executor.hosting import Guest, Host

_STEP_S = 0.01


@dataclass(eq=False)
class Foreign:
    """What is kept for an executor that a program made."""

    guest: Guest | None
    spins: int = 0
    stopped: threading.Event = field(default_factory=threading.Event)


class Interception:
    """Replaces parts of rclpy for a host, and puts them back."""

    def __init__(self, host: Host) -> None:
        self._host = host
        self._lock = threading.Lock()
        # programs may make an executor for each of many calls
        self._foreign: weakref.WeakKeyDictionary[Executor, Foreign] = weakref.WeakKeyDictionary()
        self._replacements = Replacements()
        self._original_init = rclpy.init
        self._add_node = Executor.add_node
        self._remove_node = Executor.remove_node
        self._shutdown_executor = Executor.shutdown

    def install(self) -> None:
        """Put the replacements in place."""
        functions: list[tuple[Any, str, Callable[..., Any]]] = [
            (rclpy, 'init', self._init),
            (rclpy, 'shutdown', self._shutdown),
            (rclpy, 'try_shutdown', self._shutdown),
            (rclpy.utilities, 'shutdown', self._shutdown),
            (rclpy.utilities, 'try_shutdown', self._shutdown),
            (rclpy, 'spin', self._spin),
            (rclpy, 'spin_once', self._spin_once),
            (rclpy, 'spin_until_future_complete', self._spin_until),
            *((place, 'EventsExecutor', _stand_in) for place in events_executor_modules()),
        ]
        methods: dict[str, Callable[..., Any]] = {
            'spin': self._executor_spin,
            'spin_once': self._executor_spin_once,
            'spin_until_future_complete': self._executor_spin_until,
            'spin_once_until_future_complete': self._executor_spin_until,
            'add_node': self._executor_add_node,
            'remove_node': self._executor_remove_node,
            'create_task': self._executor_create_task,
            'shutdown': self._executor_shutdown,
        }
        for owner, name, replacement in functions:
            if hasattr(owner, name):
                self._replacements.replace(owner, name, instead(replacement))
        self._replacements.replace(signal, 'signal', self._signal)
        for owner in {
                Executor, SingleThreadedExecutor, MultiThreadedExecutor,
                type(self._host.executor)}:
            for name in methods.keys() & vars(owner).keys():
                self._replacements.replace(
                    owner, name, partial(self._method, replacement=methods[name]))

    def uninstall(self) -> None:
        """Put everything back."""
        self._replacements.close()

    def _method(self, original: Callable[..., Any], replacement: Callable[..., Any]) -> Any:
        """Make a method that is the original for our executor and the replacement for others."""
        ours = self._host.executor

        def method(executor: Executor, *args: Any, **kwargs: Any) -> Any:
            chosen = original if executor is ours else replacement
            return chosen(executor, *args, **kwargs)

        return method

    # --- rclpy's functions -----------------------------------------------------------------------

    def _init(
        self, args: Any = None, context: Any = None, domain_id: int | None = None, **more: Any
    ) -> Any:
        ours = self._host.executor.context
        if context is not None and context is not ours:
            return self._original_init(args=args, context=context, domain_id=domain_id, **more)
        if domain_id is not None and domain_id != ours.get_domain_id():
            guest = self._host.current_guest()
            raise LoadingError(
                guest.program.spec if guest else 'rclpy.init',
                f'it asks for ROS domain {domain_id}, and this process is in another',
                f'set ROS_DOMAIN_ID={domain_id}, or run it by itself')
        return _Nothing()

    def _shutdown(self, *args: Any, context: Any = None, **more: Any) -> None:
        context = args[0] if args else context
        if context is not None and context is not self._host.executor.context:
            context.try_shutdown()
            return
        guest = self._host.current_guest()
        if guest is None:
            self._host.end_run()
        else:
            self._host.program_ended(guest)

    def _spin(self, node: Node, executor: Executor | None = None) -> None:
        if executor is not None and executor is not self._host.executor:
            executor.add_node(node)
            executor.spin()
            return
        guest = self._host.current_guest()
        self._host.adopt(node, guest)
        self._host.wait(None, None, guest)

    def _spin_once(
        self, node: Node, *, executor: Any = None, timeout_sec: float | None = None
    ) -> None:
        self._host.adopt(node, self._host.current_guest())
        self._step(timeout_sec)

    def _spin_until(
        self, node: Node, future: Any, executor: Any = None, timeout_sec: float | None = None
    ) -> None:
        self._host.adopt(node, self._host.current_guest())
        self._until(future, timeout_sec)

    def _step(self, timeout_s: float | None) -> None:
        endless = timeout_s is None or timeout_s < 0
        guest = self._host.current_guest()
        self._host.wait(_STEP_S if endless else timeout_s, None, guest)

    def _until(self, future: Any, timeout_s: float | None) -> None:
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        self._host.wait(timeout_s, done, self._host.current_guest())

    def _signal(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def replacement(number: int, handler: Any) -> Any:
            if self._host.current_guest() is not None:
                return signal.getsignal(number)
            return original(number, handler)

        return replacement

    # --- methods of executors --------------------------------------------------------------------

    def _state(self, executor: Executor) -> Foreign:
        with self._lock:
            state = self._foreign.get(executor)
            if state is None:
                state = self._foreign[executor] = Foreign(self._host.current_guest())
            return state

    def _adopt_all(self, executor: Executor, state: Foreign) -> None:
        for node in executor.get_nodes():
            self._host.adopt(node, state.guest or self._host.current_guest())

    def _executor_spin(self, executor: Executor) -> None:
        state = self._state(executor)
        with self._lock:
            state.spins += 1
        try:
            self._adopt_all(executor, state)
            self._host.wait(None, state.stopped, state.guest or self._host.current_guest())
        finally:
            with self._lock:
                state.spins -= 1

    def _executor_spin_once(self, executor: Executor, timeout_sec: Any = None) -> None:
        self._adopt_all(executor, self._state(executor))
        self._step(getattr(timeout_sec, 'timeout', timeout_sec))

    def _executor_spin_until(
        self, executor: Executor, future: Any, timeout_sec: Any = None
    ) -> None:
        self._adopt_all(executor, self._state(executor))
        self._until(future, getattr(timeout_sec, 'timeout', timeout_sec))

    def _executor_add_node(self, executor: Executor, node: Node) -> Any:
        state = self._state(executor)
        if not state.spins:
            return self._add_node(executor, node)
        self._host.adopt(node, state.guest or self._host.current_guest())
        return True

    def _executor_remove_node(self, executor: Executor, node: Node) -> None:
        self._remove_node(executor, node)
        if not self._host.adopting:
            self._host.executor.remove_node(node)

    def _executor_create_task(
        self, executor: Executor, callback: Any, *args: Any, **kwargs: Any
    ) -> Any:
        return self._host.executor.create_task(callback, *args, **kwargs)

    def _executor_shutdown(
        self, executor: Executor, timeout_sec: float | None = None, **more: Any
    ) -> Any:
        self._state(executor).stopped.set()
        return self._shutdown_executor(executor, timeout_sec)


class _Nothing:
    """What ``rclpy.init`` returns: newer versions of rclpy return a context manager."""

    def __enter__(self) -> None:
        """Do nothing."""

    def __exit__(self, *args: object) -> None:
        """Do nothing."""


def _stand_in(*, context: Any = None) -> Executor:
    """Make an executor that hands its nodes over, in place of the events executor."""
    return SingleThreadedExecutor(context=context)
