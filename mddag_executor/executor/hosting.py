# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Run unmodified node programs in this process, their nodes on one executor.

Theory of operation
-------------------
Each program runs in a thread of its own, and while a ``Host`` is entered, what it calls of rclpy
to have its nodes run is answered by the host (``interception`` has the list).  A spin gives the
nodes to the host's executor and waits.  It returns when the run ends, or when the program itself
ends: with ``rclpy.shutdown`` or by returning.  A program that ends takes its nodes along, as a
process does; one that returns nodes leaves them to the executor.  When the last program has ended,
the run ends.

What differs from a process of its own: callbacks also run while the program does something else
between two ``spin_once``; arguments and a domain that a program itself gives to ``rclpy.init`` are
not used; ``sys.argv`` is right only until the next program starts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
import sys
import threading
import time
from types import TracebackType
from typing import Any

from mddag_executor.executor.snapshot import alive
from mddag_executor.executor.interception import Interception
from mddag_executor.executor.loading import describe, LoadingError, Program
from mddag_executor.executor.shutdown import is_over
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node

START_TIMEOUT_S = 10.0


@dataclass(eq=False)
class Guest:
    """
    A program that runs.

    :ivar settled: its nodes are handed over, or it ended.
    :ivar ended: it wants nothing to run any more.
    :ivar error: what it raised.
    """

    program: Program
    nodes: list[Node] = field(default_factory=list)
    settled: threading.Event = field(default_factory=threading.Event)
    ended: threading.Event = field(default_factory=threading.Event)
    error: BaseException | None = None
    thread: threading.Thread | None = None


class Host:
    """
    Runs programs; a context manager.

    :param executor: gets all nodes; somebody else spins it.
    :param end_run: called, from any thread, when the run is to end: a callback called
        ``rclpy.shutdown``, or all programs have ended.
    """

    def __init__(self, executor: Executor, end_run: Callable[[], None]) -> None:
        self.executor = executor
        self.guests: list[Guest] = []
        self.end_run = end_run
        self._all_started = False
        self._closed = False
        self._ending = threading.Event()
        self._local = threading.local()
        self._lock = threading.Lock()
        self._interception = Interception(self)

    def __enter__(self) -> Host:
        self._interception.install()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.end(0.0)
        self._interception.uninstall()

    def start(self, programs: Iterable[Program], arguments: Iterable[str] = ()) -> None:
        """
        Run programs, one after the other, each until its nodes are handed over.

        A program that takes longer than ``START_TIMEOUT_S`` is left to go on by itself.

        :param arguments: what the programs see in their command lines after their own.
        :raises LoadingError: when one fails before, or ends without having brought a node.
        """
        arguments = list(arguments)
        for program in programs:
            self._start(program, arguments)
        self._all_started = True
        self._end_run_after_last()

    def _start(self, program: Program, arguments: list[str]) -> None:
        guest = Guest(program)
        self.guests.append(guest)
        sys.argv = [program.argv0, *program.arguments, *arguments]
        guest.thread = threading.Thread(
            target=self._run, args=(guest,), daemon=True, name=f'main of {program.spec}')
        guest.thread.start()
        self.wait(START_TIMEOUT_S, guest.settled)
        if isinstance(guest.error, LoadingError):
            raise guest.error
        if guest.error is not None:
            raise LoadingError(
                program.spec, f'it failed while starting ({describe(guest.error)})',
                'correct it, or see how it runs by itself') from guest.error
        if guest.ended.is_set() and not guest.nodes:
            raise LoadingError(
                program.spec, 'it ended and neither returned a node nor let one spin',
                'name what makes the node, or a main() that spins it')

    def close(self) -> None:
        """Take no more nodes; to be called before the executor is shut down."""
        self._closed = True

    def end(self, timeout_s: float = 0.5) -> list[Guest]:
        """
        Shut the context down and let all spins return; ``rclpy.ok()`` is False then.

        :return: the programs that do not end in time.
        """
        self._closed = True
        if self.guests:
            self.executor.context.try_shutdown()
        self._ending.set()
        end = time.monotonic() + timeout_s
        left = []
        for guest in self.guests:
            if guest.thread is not None:
                guest.thread.join(max(0.0, end - time.monotonic()))
                if guest.thread.is_alive():
                    left.append(guest)
        return left

    def _run(self, guest: Guest) -> None:
        """Run a program in this thread."""
        self._local.guest = guest
        stays = False
        try:
            returned = _nodes_in(guest.program, guest.program.run())
            for node in returned:
                self.adopt(node, guest)
            stays = bool(returned)
        except SystemExit as error:
            if error.code not in (None, 0):
                guest.error = error
        except BaseException as error:
            guest.error = error
        if not stays:
            self.program_ended(guest)
        guest.settled.set()

    def program_ended(self, guest: Guest) -> None:
        """Take a program's nodes away and let its spins return; end the run after the last."""
        guest.ended.set()
        if not self._ending.is_set():
            with self._lock:
                nodes = list(guest.nodes)
            for node in nodes:
                self.executor.remove_node(node)
            self._end_run_after_last()

    def _end_run_after_last(self) -> None:
        if self._all_started and all(guest.ended.is_set() for guest in self.guests):
            self.end_run()

    def current_guest(self) -> Guest | None:
        """Return the program whose own thread calls, or None."""
        guest: Guest | None = getattr(self._local, 'guest', None)
        return guest

    @property
    def adopting(self) -> bool:
        """Return whether the calling thread just hands a node over."""
        return bool(getattr(self._local, 'adopting', False))

    def adopt(self, node: Node, guest: Guest | None) -> None:
        """
        Give a node to the executor.

        :raises LoadingError: when it lives in another context, where the executor cannot reach it.
        """
        if node.context is not self.executor.context:
            name = node.get_fully_qualified_name()
            raise LoadingError(
                guest.program.spec if guest else name, f'node {name} has a context of its own',
                'let it use the default context')
        self._forget_destroyed(guest)
        if not self._closed and node not in self.executor.get_nodes():
            self._local.adopting = True
            try:
                self.executor.add_node(node)
            finally:
                self._local.adopting = False
        if guest is not None:
            with self._lock:
                if node not in guest.nodes:
                    guest.nodes.append(node)
            guest.settled.set()

    def _forget_destroyed(self, guest: Guest | None) -> None:
        """Let go of nodes that a program has made for a while only and destroyed since."""
        if guest is None:
            return
        with self._lock:
            gone = [node for node in guest.nodes if not alive(node)]
            for node in gone:
                guest.nodes.remove(node)
        for node in gone:
            self.executor.remove_node(node)

    def wait(
        self, timeout_s: float | None, event: threading.Event | None = None,
        guest: Guest | None = None,
    ) -> None:
        """Wait for an event, the end of the run, of the context or of a program, or for a time."""
        end = None if timeout_s is None or timeout_s < 0 else time.monotonic() + timeout_s
        waits_for = self._ending if event is None else event
        while not self._ending.is_set() and not is_over(self.executor.context):
            left = 0.05 if end is None else min(0.05, end - time.monotonic())
            if left <= 0 or guest is not None and guest.ended.is_set() or waits_for.wait(left):
                return


def nodes_of(programs: Iterable[Program], arguments: Iterable[str] = ()) -> list[list[str]]:
    """
    Run programs until their nodes are there, and no further; return the names of these.

    Nothing of the nodes runs; the process is to be ended after that.

    :raises LoadingError: as ``Host.start``, or when a program hands no node over in time.
    """
    host = Host(SingleThreadedExecutor(), lambda: None)
    with host:
        host.start(programs, arguments)
        for guest in host.guests:
            if not guest.nodes:
                raise LoadingError(
                    guest.program.spec, f'it has made no node in {START_TIMEOUT_S:g} s, so nobody '
                    'knows its process', f'name that: PROCESS={guest.program.spec}')
        return [[node.get_fully_qualified_name() for node in guest.nodes]
                for guest in host.guests]


def _nodes_in(program: Program, value: Any) -> list[Node]:
    """Return the nodes that a program returned; a main() returns None or its exit status."""
    if isinstance(value, Node):
        return [value]
    if value is None or isinstance(value, int):
        return []
    if isinstance(value, (list, tuple, set)) and all(isinstance(n, Node) for n in value):
        return list(value)
    raise LoadingError(
        program.spec, f'it returned a {type(value).__name__}, which is no rclpy node',
        'let it return a node, a list of nodes, or nothing')
