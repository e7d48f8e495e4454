# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Run unmodified node programs in this process, with all of their nodes on one executor.

Theory of operation
-------------------
1. The first program runs in the main thread (``Host.run``), so all that Python allows there only
   is as without this package: signals (see ``signals``), KeyboardInterrupt, asyncio.  Each further
   program runs in its own thread.  A thread that a program starts belongs to the program.
2. While a ``Host`` is entered, these functions are replaced:

   =================================  ============================================================
   ``init`` of the default context    does nothing: the context is initialised already; after the
                                      program's ``shutdown`` its nodes run again
   ``init`` of another context        warns that what runs in it is not judged
   ``install_signal_handlers``        notes which signals end the run
   its ``shutdown``                   called by a program's thread, ends that program; called by
                                      any other thread (in a callback), ends the run
   its ``ok``                         is also False in the threads of a program that has ended
   ``Node.__init__``                  adds the program's own arguments for rclpy to the node's
   ``Node.create_timer``, …           note that the program uses the node
   ``Executor.__init__``              makes a ``GuestExecutor`` of the executor
   ``get_global_executor``            returns a ``GuestExecutor`` of the calling program
   ``EventsExecutor``                 makes a ``GuestExecutor``
   =================================  ============================================================

   Afterwards the working directory is the earlier one again, if that still exists: paths of
   results may be relative.

3. A program that spins passes its nodes to the host's executor and waits until the run or the
   program ends.  A program ends by ``rclpy.shutdown`` or when it returns.  Its nodes are then
   removed, unless it has returned them, or another program uses them (the node of a library).
   The run ends when the last main has returned.
   If a SIGINT ends the run, the spin of the program in the main thread raises KeyboardInterrupt
   when no callback runs any more, as do those in the threads of the other mains.
4. Callbacks of a program run only while it spins, and as many at a time as its own executor would
   run: see ``guest_executor``.  Nodes that it has returned have no spin, and no such bound.
5. An exception of a callback is raised by the spin of its program.  Nodes that a program has
   returned have no such spin: their exceptions end the run.

Differences from a separate process: the arguments and the domain that a program passes to
``rclpy.init`` are ignored; ``sys.argv`` is right only until the next program starts.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import nullcontext, suppress
from functools import partial
from importlib import import_module
import os
from queue import SimpleQueue
import signal
import sys
import threading
import time
from typing import Any, NoReturn, TypeVar
import weakref

from mddag_executor.executor import publishing
from mddag_executor.executor.compat import alive, executor_kept
from mddag_executor.executor.interrupts import handler_of
from mddag_executor.executor.registry import snapshot
from mddag_executor.executor.work import current
from mddag_executor.hosting.change import Change
from mddag_executor.hosting.guest import CONTEXT_HAS_ENDED, Guest
from mddag_executor.hosting.guest_executor import GuestExecutor, make_guest
from mddag_executor.hosting.loading import describe, LoadingError, Program, ProgramFailed, resolve
from mddag_executor.hosting.run_options import spec_of
from mddag_executor.hosting.signals import Signals
from mddag_executor.replacements import instead, Replacements
import rclpy
from rclpy.context import Context
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
import rclpy.utilities

START_TIMEOUT_S = 10.0
_INTERRUPT_S = 1.0
"""How long a program in the main thread that does not end may take after a KeyboardInterrupt."""
_SIGNALS_OF = {
    SignalHandlerOptions.ALL: (signal.SIGINT, signal.SIGTERM),
    SignalHandlerOptions.SIGINT: (signal.SIGINT,),
    SignalHandlerOptions.SIGTERM: (signal.SIGTERM,)}

_MAKE_CALLBACKS = (
    'create_subscription', 'create_timer', 'create_service', 'create_client', 'add_waitable')
Result = TypeVar('Result')


class Host:
    """
    Runs programs in the default context; a context manager.

    :param signals: decides what happens to signals; None: the host does not handle them.
    :param concurrent: the names of the nodes whose callbacks may overlap with each other, and with
        what their program does between its spins, whatever executor they have.
    :ivar executor: runs the nodes of all programs; None before ``start``.
    :ivar time_is_over: whether the run ends because its time is over: a program that rclpy
        interrupts then has not failed.
    """

    def __init__(self, signals: Signals | None = None, concurrent: Iterable[str] = ()) -> None:
        self.executor: Any = None
        self.time_is_over = False
        self.concurrent = {*concurrent}
        self.guests: list[Guest] = []
        self.global_executor: Any = None  # of callbacks: they belong to no program's thread
        self.end_run: Callable[[], None] = lambda: None
        self.guest_of: Any = weakref.WeakKeyDictionary()  # by thread
        self._is_ending: Callable[[], bool] = lambda: False
        self._lend: Callable[[], Any] = nullcontext
        self._all_started = self._ended = False
        # the SPEC whose module is being imported
        self._loading = ''
        self._lock = threading.RLock()  # reentrant: a signal handler may interrupt its owner
        self._node_of: Any = weakref.WeakKeyDictionary()  # by entity
        self._executors: Any = weakref.WeakSet()
        # outer groups by executor, or by node of a global one, and the executors by their number
        self._groups: Any = weakref.WeakKeyDictionary()
        self._executor_of_group: Any = weakref.WeakValueDictionary()
        self._opened: Any = weakref.WeakKeyDictionary()  # the program of each group
        self._of_callbacks: Any = weakref.WeakSet()  # threads
        # the programs that have made subscriptions, timers, … of a node
        self._users: Any = weakref.WeakKeyDictionary()
        # the node behind each object that a program has added as a node
        self._behind: Any = weakref.WeakKeyDictionary()
        self._signals = signals or Signals()
        self._signals.ends_run, self._signals.wake = self.ends_run, self.wake
        # the thread that the first program gets, and the way to it
        self._main: threading.Thread | None = None
        self._of_main: SimpleQueue[Guest | None] = SimpleQueue()
        self._replacements = Replacements()
        self._process = os.getpid()

    def __enter__(self) -> Host:
        publishing.install()  # it outlasts the run, unlike what is replaced below
        context = self.context = rclpy.utilities.get_default_context()
        replace = self._replacements.replace
        self._replacements.callback(_return_to, os.getcwd())
        self._replacements.callback(setattr, sys, 'argv', sys.argv)
        for name, function in (('init', self._init), ('ok', self._ok),
                               ('shutdown', self._shutdown), ('try_shutdown', self._shutdown)):
            setattr(context, name, function)
            self._replacements.callback(delattr, context, name)
        for module in (rclpy, rclpy.utilities):  # they would also make a new default context
            replace(module, 'shutdown', instead(self._shutdown))
            replace(module, 'try_shutdown', instead(self._shutdown))
        replace(rclpy, 'install_signal_handlers', instead(self._install_signal_handlers))
        replace(rclpy, 'uninstall_signal_handlers', instead(self._uninstall_signal_handlers))
        replace(rclpy, 'get_global_executor', instead(self._global_executor))
        replace(Executor, '__init__', self._executor_init)
        replace(Context, 'init', self._init_other)
        replace(threading.Thread, 'start', self._thread_start)
        replace(Node, '__init__', self._node_init)
        for name in _MAKE_CALLBACKS:
            replace(Node, name, self._of_user)
        for package in ('rclpy.experimental', 'rclpy.experimental.events_executor'):
            with suppress(ImportError, KeyError):  # some versions do not have it
                replace(import_module(package), 'EventsExecutor', instead(SingleThreadedExecutor))
        context.on_shutdown(self._context_ended)
        return self

    def __exit__(self, *args: object) -> None:
        self.end()
        self._replacements.close()
        for executor in (self.global_executor, *(g.global_executor for g in self.guests)):
            if executor is not None:
                Executor.shutdown(executor)

    # --- programs --------------------------------------------------------------------------------

    def load(self, specs: Iterable[Any], ros_arguments: Iterable[str] = ()) -> list[Program]:
        """Find programs; their modules are imported under the host's replacements as well."""
        programs = []
        try:
            for spec in specs:
                self._loading = spec if isinstance(spec, str) else spec_of(spec)
                programs.append(resolve(spec, ros_arguments))
        finally:
            self._loading = ''
        return programs

    def run(
        self, supervise: Callable[[], Result],
        leave: Callable[[Callable[[], Result]], NoReturn] | None = None,
    ) -> Result:
        """
        Call a function in a thread of its own, and run in this thread the program that it starts.

        :param supervise: calls ``start``; it returns when the run has ended.
        :param leave: is called by that thread, after the end, if the program keeps this thread;
            gets what returns the result of ``supervise`` or raises its exception.  None: this
            method waits for the program.
        :return: the result of ``supervise``.
        """
        outcome: Callable[[], Result]

        def body() -> None:
            nonlocal outcome
            try:
                outcome = partial(_same, supervise())
            except BaseException as error:
                outcome = partial(_raise, error)
            if self.end():
                self.interrupt()
            self._of_main.put(None)
            if leave is not None and self.guests and self._has_main(self.guests[0]) and (
                    not self.guests[0].done.is_set()):
                leave(outcome)

        if threading.current_thread() is threading.main_thread():
            self._main = threading.main_thread()
        else:  # each program gets a thread of its own
            self._of_main.put(None)
        supervisor = threading.Thread(target=body, name='mddag-run', daemon=True)
        supervisor.start()
        guest = self._of_main.get()
        if guest is not None:
            self._run(guest)
        supervisor.join()
        return outcome()

    def interrupt(self) -> None:
        """Raise KeyboardInterrupt in the main thread, if a program is there, and wait for it."""
        for guest in filter(self._has_main, self.guests):
            if not guest.done.is_set():
                self._signals.interrupt()
                guest.done.wait(_INTERRUPT_S)

    def _has_main(self, guest: Guest | None) -> bool:
        return guest is not None and guest.thread is self._main

    def start(
        self, executor: Any, programs: Iterable[Program], arguments: Iterable[str] = (),
        end_run: Callable[[], None] = lambda: None, is_ending: Callable[[], bool] = lambda: False,
    ) -> None:
        """
        Run programs, each as soon as the nodes of the previous one are on the executor.

        A program that takes longer than ``START_TIMEOUT_S`` is not waited for.

        :param executor: runs all nodes; the caller spins it.
        :param arguments: appended to each program's command line.
        :param end_run: called, from any thread, when a callback calls ``rclpy.shutdown``, or all
            programs have ended.
        :param is_ending: whether the run ends; no program or node is added then.
        :raises LoadingError: when a program fails during its start, or ends without any use of
            ROS.
        """
        self.executor, self.end_run, self._is_ending = executor, end_run, is_ending
        self._lend = getattr(executor, 'lend', nullcontext)
        if hasattr(executor, 'on_callback_ended'):
            executor.on_callback_ended(self._callback_ended)
        arguments = list(arguments)
        for program in programs:
            if is_ending():
                break
            guest = Guest(program)
            sys.argv = [program.argv0, *program.arguments, *arguments]
            if self._main is not None and not self.guests:
                guest.thread = self._main
                self.guests.append(guest)
                self._of_main.put(guest)
            else:
                guest.thread = threading.Thread(
                    target=self._run, args=(guest,), daemon=True, name=f'main of {program.spec}')
                self.guests.append(guest)
                guest.thread.start()
            self._wait_for_nodes(guest)
            if not guest.has_begun and is_ending():
                break
            self._check_start(guest)
            if isinstance(guest.error, KeyboardInterrupt):
                break
        self._all_started = True
        self._end_run_after_last()

    def _wait_for_nodes(self, guest: Guest) -> None:
        end = time.monotonic() + START_TIMEOUT_S
        while not guest.is_complete and time.monotonic() < end and not self._is_ending():
            time.sleep(0.01)

    def _check_start(self, guest: Guest) -> None:
        spec = guest.program.spec
        if isinstance(guest.error, LoadingError):
            raise guest.error
        if isinstance(guest.error, SystemExit) and not guest.uses_ros:
            code = guest.error.code
            failed = LoadingError(
                spec, f'it ended while starting ({describe(guest.error)})',
                'correct it, or see how it runs by itself')
            failed.status = code if isinstance(code, int) else 1
            raise failed from guest.error
        if guest.error is not None and not isinstance(
                guest.error, (SystemExit, KeyboardInterrupt)):
            raise ProgramFailed(
                spec, f'it failed while starting ({describe(guest.error)})',
                'correct it, or see how it runs by itself') from guest.error
        if guest.ended and not guest.nodes and not guest.uses_ros and guest.error is None:
            raise LoadingError(
                spec, 'it ended and neither returned a node nor initialised rclpy',
                'name what makes the node, or a main() that spins it')

    def _run(self, guest: Guest) -> None:
        """Run a program in its thread."""
        self.guest_of[guest.thread] = guest
        try:
            if self._has_main(guest):
                try:
                    with self._signals.of_program():
                        self._run_main(guest)
                except KeyboardInterrupt as error:  # before its first line, or after its last one
                    guest.error = guest.error or error
                    guest.finished = True
                    self.program_ended(guest)
            else:
                loop = asyncio.new_event_loop()  # as the main thread of a program has one
                asyncio.set_event_loop(loop)
                self._run_main(guest)
                loop.close()
        finally:
            self.guest_of.pop(guest.thread, None)
            guest.is_complete = True
            guest.done.set()

    def _run_main(self, guest: Guest) -> None:
        if self._is_ending():
            return
        guest.has_begun = True
        try:
            try:
                value = guest.program.run()
            finally:
                if self._has_main(guest):
                    self._signals.take_back()
            nodes = _nodes_in(value)
            if nodes is None:
                if not guest.uses_ros and not isinstance(value, int):
                    raise LoadingError(
                        guest.program.spec, f'it returned a {type(value).__name__}, which is not '
                        'an rclpy node', 'let it return a node, a list of nodes, or nothing')
                raise SystemExit(value)  # as a console script passes it to sys.exit
            guest.returned = bool(nodes)
            for node in nodes:
                if node.executor is None:
                    self._global_executor().add_node(node)
                executor: Any = node.executor
                executor.has_spun = True    # callbacks may add more nodes to it
                executor.is_pool = True     # no spin excludes anything
                self.put(node, None)
                self.adopt(node, guest)
        except SystemExit as error:
            if error.code not in (None, 0):
                guest.error = error
        except BaseException as error:
            # the end of the run may cut its start off; what it raises of its own is an error
            is_cut_off = self._ended and not guest.is_complete and (
                type(error).__module__.startswith('rclpy.'))
            if not is_cut_off and not (
                    self.time_is_over and isinstance(error, CONTEXT_HAS_ENDED)):
                guest.error = error
        guest.finished = True
        if guest.error is not None or not guest.returned:
            self.program_ended(guest)

    def program_ended(self, guest: Guest) -> None:
        """Remove a program's nodes and end its spins; end the run after the last program."""
        guest.ended = True
        if not self._ended:
            for node in list(guest.nodes):
                try:
                    self._leave_node(node, guest)
                except Exception as error:  # the program's own code, which must not keep the run
                    guest.error = guest.error or error
            self._end_run_after_last()
        self.wake()
        if guest.error is not None:
            self.program_failed(guest, guest.error)

    def _leave_node(self, node: Node, guest: Guest) -> None:
        """Remove a program's node; one that another program uses as well is that one's now."""
        heir = next((each for each in self._users.get(node, ()) if not each.ended), None)
        if heir is None:
            self.executor.remove_node(node)
            return
        self.put(node, None)  # no spin excludes anything any more
        guest.nodes.remove(node)
        heir.nodes.append(node)

    def program_failed(self, guest: Guest, error: BaseException) -> None:
        """Report a program's exception at once, if other programs continue."""
        if not all(each.ended for each in self.guests) and not (
                isinstance(error, KeyboardInterrupt) and self._is_ending()):
            get_logger('mddag_executor').error(
                f'--node {guest.program.spec}: its main has raised {describe(error)}: its nodes '
                'no longer run')

    def _end_run_after_last(self) -> None:
        if self._all_started and all(g.ended and g.finished for g in self.guests):
            self.end_run()

    def shut_down(self) -> None:
        """Shut the context down; all spins return."""
        Context.try_shutdown(self.context)

    def end(self, is_patient: Callable[[], bool] = lambda: False) -> list[Guest]:
        """
        Shut the context down; return the programs that do not end in time.

        :param is_patient: whether to wait any longer for what they do after their spins.
        """
        if self.guests:
            self.shut_down()
        for guest in self.guests:
            while not guest.done.is_set() and is_patient():
                guest.done.wait(0.02)
            guest.done.wait(0.1)
        return [guest for guest in self.guests if not guest.done.is_set()]

    # --- nodes and callbacks ---------------------------------------------------------------------

    def adopt(self, node: Node, guest: Guest | None) -> None:
        """
        Add a program's node to the executor, unless the program has ended.

        :raises LoadingError: when the node is in another context than the executor.
        """
        if node.context is not self.context:
            name = node.get_fully_qualified_name()
            raise LoadingError(
                guest.program.spec if guest else name, f'node {name} has a context of its own',
                'let it use the default context')
        if self.executor is None:
            raise LoadingError(
                self._loading, 'it spins a node while it is imported',
                "call what spins in a function, or below `if __name__ == '__main__':`")
        for each in [] if guest is None else list(guest.nodes):
            if not alive(each):
                self.release(each, guest)
        if self._is_ending() or self.is_over(guest):
            return
        if node not in self.executor.get_nodes():
            with executor_kept(node):
                self.executor.add_node(node)
        if guest is not None and node not in guest.nodes:
            guest.nodes.append(node)

    def itself(self, node: Any) -> Any:
        """Return the node behind an object that only passes on to one, as those of ros2cli do."""
        if isinstance(node, Node):
            return node
        if node not in self._behind:  # later it may refuse to pass on
            self._behind[node] = getattr(node.get_name, '__self__', node)
        return self._behind[node]

    def release(self, node: Node, guest: Guest | None) -> None:
        """Remove a program's node from the executor."""
        self.executor.remove_node(node)
        if guest is not None:
            with suppress(ValueError):
                guest.nodes.remove(node)

    def group_of(self, owner: Any, is_single: bool) -> Any:
        """
        Return the outer group of an executor's callbacks, or a node's; None: there are none.

        :param is_single: whether the program's own executor would run one callback at a time.
        """
        if not hasattr(self.executor, 'new_outer_group'):
            return None
        with self._lock:
            group = self._groups.get(owner)
            if group is None:
                group = self._groups[owner] = self.executor.new_outer_group(is_single)
        return group

    def note_group(self, group: Any, executor: Any) -> None:
        """Note whose spin has opened an outer group: it gets the ends of its callbacks."""
        self._executor_of_group[group.number] = executor
        if executor.guest is not None:
            self._opened[group] = executor.guest

    def note_waiting(self, groups: Iterable[Any]) -> None:
        """Count how long callbacks have waited for others in outer groups, which may be freed."""
        for group in groups:
            guest = self._opened.get(group)
            if guest is not None:
                guest.waited_ns += group.take_wait_ns()

    def exclusion(self) -> list[dict[str, Any]]:
        """Return how long callbacks of each program have waited for others of it."""
        self.note_waiting(list(self._opened))
        waited = Counter[str]()
        for guest in self.guests:
            waited[guest.program.spec] += guest.waited_ns
        return [{'program': spec, 'waited_ns': ns} for spec, ns in waited.items() if ns]

    def put(self, node: Node, group: Any) -> None:
        """Let the callbacks of a node belong to an outer group, unless they are concurrent."""
        if hasattr(self.executor, 'put'):
            is_concurrent = node.get_fully_qualified_name() in self.concurrent
            self.executor.put(node, None if is_concurrent else group)

    def _callback_ended(
        self, entity: Any, error: BaseException | None, outer: int = -1
    ) -> bool:
        """Note the end of a callback; return whether a spin of its program raises its error."""
        executor = self._executor_of_group.get(outer)
        if executor is not None:
            return bool(executor.callback_ended(error, outer))
        if entity is None:
            return False
        if entity not in self._node_of:
            self._node_of.update({
                each: weakref.ref(node)
                for node, lists in snapshot(self.executor.get_nodes()).items()
                for some in lists for each in some})
        node = self._node_of.get(entity, lambda: None)()
        executor = None if node is None else node.executor
        return isinstance(executor, GuestExecutor) and executor.callback_ended(error, outer)

    # --- waiting ---------------------------------------------------------------------------------

    def wait(
        self, changed: Change, until: Callable[[], bool], timeout_s: float | None,
        guest: Guest | None,
    ) -> None:
        """
        Wait until a condition is true, the run or the program ends, or the timeout is over.

        The worker of a waiting callback runs other callbacks.

        :param changed: is notified when ``until`` may have become true.
        """
        is_callback = self.current_guest() is None
        with self._lend():
            changed.wait_for(
                lambda: until() or self.is_over(guest) or is_callback and self._is_ending(),
                None if timeout_s is None or timeout_s < 0 else timeout_s)

    def is_over(self, guest: Guest | None) -> bool:
        """Return whether the run or the program has ended."""
        return self._ended or guest is not None and guest.ended

    def wake(self) -> None:
        """Let all waiting threads check their conditions again."""
        with self._lock:
            executors = list(self._executors)
        for executor in executors:
            executor.wake_waiting()

    def _context_ended(self) -> None:
        self._ended = True
        self.wake()

    # --- signals ---------------------------------------------------------------------------------

    def ends_run(self, number: int) -> bool:
        """
        Let programs note a signal; return whether it ends the run.

        It does so if rclpy would shut the context of a program down, or if no program is there
        that could get it.
        """
        running = [guest for guest in self.guests if not guest.done.is_set()]
        nodes_only = [guest for guest in self.guests if guest.returned and not guest.ended]
        ends = not running or bool(nodes_only) and number == signal.SIGINT or any(
            self._has_main(guest) and not guest.has_begun for guest in running)
        for guest in running:
            if self._has_main(guest):  # unless the program has replaced the handler meanwhile
                ends |= number in guest.signals and (
                    guest.signals[number] == handler_of(number))
            elif number == signal.SIGINT:
                guest.interrupted = True
                ends |= number in guest.signals
        return ends

    def raise_interrupt(self, guest: Guest | None) -> None:
        """Raise KeyboardInterrupt if a SIGINT has interrupted the main of the calling thread."""
        if guest is not None and guest.interrupted and (
                guest.thread is threading.current_thread()):
            guest.interrupted = False
            raise KeyboardInterrupt

    def note_interrupt(self) -> None:
        """Note a KeyboardInterrupt in the main thread."""
        if self._main is threading.current_thread():
            self._signals.interrupted()

    def is_ending(self) -> bool:
        """Return whether the run is to end."""
        return self._is_ending()

    def _install_signal_handlers(self, options: Any = SignalHandlerOptions.ALL) -> None:
        guest = self.current_guest()
        if guest is not None:
            for number in _SIGNALS_OF.get(options, ()):
                guest.signals[number] = handler_of(number)

    def _uninstall_signal_handlers(self) -> None:
        guest = self.current_guest()
        if guest is not None:
            guest.signals.clear()

    # --- replacements in rclpy and Python --------------------------------------------------------

    def current_guest(self) -> Guest | None:
        """Return the program that the calling thread belongs to, or None."""
        guest: Guest | None = self.guest_of.get(threading.current_thread())
        return guest

    def _of_user(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def make(node: Node, *args: Any, **more: Any) -> Any:
            guest = self.current_guest()
            if guest is not None:
                self._users.setdefault(node, {})[guest] = None
            return original(node, *args, **more)

        return make

    def _node_init(self, original: Callable[..., None]) -> Callable[..., None]:
        def init(
            node: Node, *args: Any, cli_args: list[str] | None = None,
            use_global_arguments: bool = True, **more: Any,
        ) -> None:
            guest = self.current_guest() or self._guest_of_callback()
            is_of_run = more.get('context') in (None, self.context)
            if guest is not None and is_of_run and use_global_arguments:
                # first those of the node's own: the first rule that fits remaps a name
                cli_args = [*(cli_args or ()), *guest.program.ros_arguments] or None
            original(node, *args, cli_args=cli_args, use_global_arguments=use_global_arguments,
                     **more)

        return init

    def _guest_of_callback(self) -> Guest | None:
        """Return the program whose callback the calling thread runs, or None."""
        running = current.running
        work = None if running is None else running.work
        executor = None if work is None else self._executor_of_group.get(work.entity.outer)
        return None if executor is None else executor.guest

    def _thread_start(self, original: Callable[..., None]) -> Callable[..., None]:
        def start(thread: threading.Thread) -> None:
            self.guest_of.setdefault(thread, self.current_guest())
            if self._is_of_callback():
                self._of_callbacks.add(thread)
            original(thread)

        return start

    def _init(self, args: Any = None, *, domain_id: int | None = None, **more: Any) -> None:
        guest = self.current_guest()
        if os.getpid() != self._process:
            raise LoadingError(
                guest.program.spec if guest else 'rclpy.init',
                'it has forked a process that uses rclpy, whose context is that of the run',
                "start it with subprocess, or multiprocessing.get_context('spawn')")
        if guest is not None:
            guest.uses_ros = True
            if not guest.finished and not self._is_ending():
                guest.ended = False  # as each rclpy.init after a shutdown makes a new context
        if domain_id is not None and domain_id != self.context.get_domain_id():
            raise LoadingError(
                guest.program.spec if guest else self._loading or 'rclpy.init',
                f'it asks for ROS domain {domain_id}, and this process is in another',
                f'set ROS_DOMAIN_ID={domain_id}, or run it by itself')

    def _init_other(self, original: Callable[..., None]) -> Callable[..., None]:
        def init(context: Context, *args: Any, **more: Any) -> None:
            original(context, *args, **more)
            guest = self.current_guest()
            if guest is not None:
                guest.uses_ros = True
                get_logger('mddag_executor').warning(
                    f'--node {guest.program.spec}: it has a context of its own: callbacks '
                    'in it are neither ordered nor judged here: let it use the default context')

        return init

    def _ok(self) -> bool:
        guest = self.current_guest()
        self.raise_interrupt(guest)  # it came between two spins; alone it would be raised there
        if self._is_ending() and (guest is not None or self._is_of_callback()):
            return False  # but for the executor's own threads it is until the very end
        return Context.ok(self.context) and not (guest is not None and guest.ended)

    def _is_of_callback(self) -> bool:
        """Return whether the calling thread runs a callback, or was started by one."""
        return current.running is not None or threading.current_thread() in self._of_callbacks

    def _shutdown(self, *, context: Context | None = None, **more: Any) -> None:
        guest = self.current_guest()
        if context is not None and context is not self.context:
            context.try_shutdown()
        elif guest is None:
            self.end_run()
        else:
            guest.signals.clear()
            self.program_ended(guest)

    def _executor_init(self, original: Callable[..., None]) -> Callable[..., None]:
        def init(executor: Executor, *args: Any, **more: Any) -> None:
            original(executor, *args, **more)
            # before that, the caller of ``start`` makes the executor that runs the nodes
            if (self.executor is not None or self._loading) and executor.context is self.context:
                make_guest(executor, self, self.current_guest())
                with self._lock:
                    self._executors.add(executor)

        return init

    def _global_executor(self) -> Any:
        """Return the executor of ``rclpy.spin`` and its variants."""
        owner: Any = self.current_guest() or self
        with self._lock:
            if owner.global_executor is None:
                owner.global_executor = SingleThreadedExecutor()
                owner.global_executor.is_global = True
            return owner.global_executor


def nodes_of(
    specs: Iterable[str], arguments: Iterable[str], then: Callable[[list[list[str]]], NoReturn],
    leave: Callable[[Callable[[], NoReturn]], NoReturn],
) -> NoReturn:
    """
    Run programs until their nodes exist.

    No callback runs.

    :param then: gets the names of the nodes of each program; it ends the process.
    :param leave: see ``Host.run``.
    :raises LoadingError: as ``Host.load`` and ``start``, or when a program makes no node in time.
    """
    arguments = list(arguments)

    def supervise() -> NoReturn:
        host.start(SingleThreadedExecutor(), programs, arguments)
        for guest in host.guests:
            if not guest.nodes:
                raise LoadingError(
                    guest.program.spec, f'it has spun no node in {START_TIMEOUT_S:g} s, so its '
                    'process is unknown', f'name the process: PROCESS={guest.program.spec}')
        then([[n.get_fully_qualified_name() for n in guest.nodes] for guest in host.guests])

    with Host() as host:
        programs = host.load(specs, arguments)
        host.run(supervise, leave)


def _same(value: Result) -> Result:
    return value


def _raise(error: BaseException) -> NoReturn:
    raise error


def _return_to(folder: str) -> None:
    with suppress(OSError):  # a program may have removed it
        os.chdir(folder)


def _nodes_in(value: Any) -> list[Node] | None:
    """Return the nodes that a program has returned; None: another value, its exit status."""
    nodes = list(value) if isinstance(value, (list, tuple, set)) else [value]
    if all(isinstance(node, Node) for node in nodes):
        return nodes
    return [] if value is None else None
