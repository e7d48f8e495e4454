# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A rerun: real nodes, a recording, virtual time.

``Rerun`` puts the parts together: the recording (``inputs``), the engine of live runs, the loop
that drives it (``loop``), the ways of messages (``messages``, ``requests``), and the
time that nodes see (``clocks``, ``timers``). The nodes are rclpy's own, in a context that
discovers no others: for the middleware they do nothing at all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass, field, replace
import gc
import os
import sys
import time
from typing import Any, BinaryIO

from mddag_executor import defaults
from mddag_executor.clocks import TraceClock
from mddag_executor.core import DEFAULT_DEADLINE_NS, EXPIRE_AFTER_NS, MAX_ACTIVE_JOBS
from mddag_executor.executor import publishing
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.other_processes import OtherProcesses
from mddag_executor.executor.outside import Outside
from mddag_executor.executor.recorder import Recorder
from mddag_executor.executor.registry import Registry, snapshot
from mddag_executor.executor.shutdown import is_over
from mddag_executor.executor.sources import SubscriptionEntity
from mddag_executor.executor.timers import TimerEntity
from mddag_executor.executor.waitables import WaitableEntity
from mddag_executor.executor.work import Work
from mddag_executor.hosting.guest import CONTEXT_HAS_ENDED
from mddag_executor.hosting.initialised import initialised
from mddag_executor.hosting.loading import describe, Program, ros_arguments
from mddag_executor.replacements import Replacements
from mddag_executor.rerun.clocks import VirtualTime
from mddag_executor.rerun.compare import Difference, differences
from mddag_executor.rerun.durations import Durations
from mddag_executor.rerun.errors import CallbackFailed, RerunError
from mddag_executor.rerun.executor import NodeHolder, RerunHost
from mddag_executor.rerun.inputs import MessageBag
from mddag_executor.rerun.loop import ENDED, Loop
from mddag_executor.rerun.messages import CLOCK, Messages
from mddag_executor.rerun.outputs import Output, Outputs, VirtualTraceWriter
from mddag_executor.rerun.requests import Requests
from mddag_executor.rerun.run_threads import Stalled
from mddag_executor.rerun.timers import Timers
from mddag_executor.results.comparisons import RerunResult, RerunResultRare, RerunVerdicts
from mddag_executor.text import counted
from msg_graph import TaskSet
from rclpy.guard_condition import GuardCondition
from rclpy.node import Node
from rclpy.utilities import get_default_context

PATIENCE_S = 30.0
_OF_ALL_NODES = {'/parameter_events'}
_ENDS = (*CONTEXT_HAS_ENDED, KeyboardInterrupt)
_NO_DISCOVERY = 'ROS_AUTOMATIC_DISCOVERY_RANGE'


@dataclass
class Result:
    """
    The result of a rerun.

    :ivar digest: that of all outputs, see ``outputs``.
    :ivar outputs: what was published, in order.
    :ivar counts: how many messages were published, by topic.
    :ivar elapsed_s: how long it really took.
    :ivar start_ns: the virtual time at which it began.
    :ivar recorded_topics: published topics that are also in the recording; ``recorded``: how these
        differ.
    :ivar warnings: what is not the same in each run, or doubtful, one line each.
    """

    digest: str
    outputs: list[Output]
    counts: dict[str, int]
    callbacks: int
    start_ns: int
    virtual_ns: int
    elapsed_s: float
    verdicts: RerunVerdicts
    recorded_topics: list[str] = field(default_factory=list)
    recorded: list[Difference] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def result(self, differences: Sequence[Difference] | None = None) -> RerunResult:
        """
        Return the result format of ``rerun --json``.

        :param differences: from expected outputs; None: nothing was expected.
        """
        more: RerunResultRare = {}
        if differences is not None:
            more['differences'] = [each.result() for each in differences]
        return {
            'digest': self.digest, 'messages': sum(self.counts.values()),
            'callbacks': self.callbacks, 'virtual_s': self.virtual_ns / 1e9,
            'elapsed_s': self.elapsed_s,
            'topics': dict(sorted(self.counts.items())), **self.verdicts,
            'recorded_topics': self.recorded_topics,
            'recorded': [each.result() for each in self.recorded],
            'warnings': self.warnings, **more}


@dataclass
class Rerun:
    """
    One run; ``run`` runs it. Other arguments are those of ``rerun``.

    :ivar output: gets the outputs as a bag.
    :ivar trace: the file that the run is recorded to.
    :ivar keep: whether the result has the outputs.
    """

    recording: MessageBag
    times: Durations
    task_set: TaskSet
    workers: int | None = None
    cpus: int | None = None
    policy: str = 'rad'
    seed: int = 0
    all_clocks: bool = False
    patience_s: float = PATIENCE_S
    ros_args: Sequence[str] = ()
    output: BinaryIO | None = None
    trace: str | None = None
    keep: bool = True

    def __post_init__(self) -> None:
        self._workers = defaults.workers(self.workers, self.task_set)
        self.task_set = replace(self.task_set, processes=())  # all nodes run in one
        self._outputs = Outputs(self.output, None if self.keep else self.recording.topics)
        self._hosted: set[str] = set()
        self._triggered: list[GuardCondition] = []  # whose nodes are not known yet

    # --- parts -----------------------------------------------------------------------------------

    def _make(self, context: Any) -> None:
        recording, task_set = self.recording, self.task_set
        writer = None if self.trace is None else VirtualTraceWriter(
            self.trace, overwrite=True)  # checked before the run
        self._engine = engine = Engine(
            task_set, self._workers, self.policy, default_deadline=DEFAULT_DEADLINE_NS,
            max_active_jobs=MAX_ACTIVE_JOBS, expire_after=EXPIRE_AFTER_NS,
            record=None if writer is None else writer.record)
        engine.other_processes = OtherProcesses(
            task_set, engine.tables, engine.scheduler, engine.attribution, engine.release_job,
            task_set.dags)
        # the callbacks that hold the interpreter, declared or else recorded
        self._holders = {
            vertex.callback.key for place, vertex in enumerate(task_set.vertices)
            if (self.times.holds(place) if vertex.callback.holds_interpreter is None
                else vertex.callback.holds_interpreter)}
        self._loop = loop = Loop(
            engine, self.times, self.cpus, bool(self._holders) and self.times.python,
            recording.start, recording.end, recording.pauses,
            self._refresh, self._begin, self._over)
        clock = _TraceTime(loop)
        self._recorder = None
        if writer is not None:
            self._recorder = Recorder(
                writer.path, task_set, self.policy, self._workers, DEFAULT_DEADLINE_NS,
                MAX_ACTIVE_JOBS, clock, writer, self.cpus or 0,
                on_late=engine.on_late)
            engine.recorder = self._recorder
        self._holder = NodeHolder(context, loop, self._recorder)
        self._registry = Registry(task_set, engine, engine.leave_group, self._recorder)
        self._messages = Messages(
            loop, recording, self.times, self._outputs, clock,
            Outside(task_set, self._holder.ordered_nodes, loop.warn))
        self._requests = Requests(loop, self._holder, self._registry)
        self._timers = Timers(loop, self.times.first_release, recording.spins)
        self._host = RerunHost(loop)

    def _install(self, replacements: Replacements) -> None:
        virtual = VirtualTime(
            self._loop, self.all_clocks, CLOCK in self.recording.topics,
            self.seed)
        for each in (virtual, self._timers, self._requests, self._messages):
            each.install(replacements)
        replacements.replace(GuardCondition, 'trigger', self._trigger)

    def _trigger(self, original: Callable[[GuardCondition], None]) -> Callable[..., None]:
        def trigger(guard: GuardCondition) -> None:
            original(guard)
            if guard.callback is None:  # of an executor: entities have come or gone
                self._loop.changed = True
            else:
                self._loop.call_in_run(lambda: run_callback(guard))

        def run_callback(guard: GuardCondition) -> None:
            entity = self._registry.by_id.get(id(guard))
            if entity is None:  # it has just been made
                self._triggered.append(guard)
                self._loop.changed = True
            else:
                self._engine.ready(Work(entity, guard.callback), self._loop.now)

        return trigger

    def _refresh(self) -> None:
        nodes = self._holder.ordered_nodes()
        registry, engine, now = self._registry, self._engine, self._loop.now
        added = registry.refresh(snapshot(nodes), now).added
        self._hosted |= registry.hosted()
        for entity in added:
            if entity.rclpy_object in self._triggered:
                self._triggered.remove(entity.rclpy_object)
                engine.ready(Work(entity, entity.rclpy_object.callback), now)
            if entity.callback is not None and entity.callback.key in self._holders:
                entity.habit.holds = 1
            if isinstance(entity, WaitableEntity) and not self._requests.knows(
                    entity.rclpy_object):
                self._loop.warn(
                    f'{entity.name}: a waitable of a kind that a rerun does not know: it never '
                    'becomes ready')
        self._timers.refresh(registry.of_kind(TimerEntity))
        self._messages.refresh(nodes, added, registry.of_kind(SubscriptionEntity))

    # --- the run ---------------------------------------------------------------------------------

    def run(
        self, programs: Callable[[], Sequence[Program]], tick: Callable[[int], None] | None = None
    ) -> Result:
        """
        Run the programs from the start of the recording to its end.

        :param programs: finds them, with virtual time in place.
        :param tick: gets now and then how far the run is, ns.
        :raises RerunError: on whatever keeps it from going on.
        """
        begun = time.monotonic()
        self._programs = programs
        arguments = sys.argv  # each program has its own
        with _context(self.ros_args) as context:
            publishing.install()
            self._make(context)
            loop = self._loop
            try:
                with Replacements() as replacements:
                    self._install(replacements)
                    with self._host:
                        loop.run_threads.run(
                            self.patience_s,
                            lambda: (loop.now, loop.callbacks, len(self._host.guests)),
                            lambda: tick(self._passed_ns()) if tick is not None else None)
            except Stalled as stuck:
                raise RerunError(
                    f'{loop.here()}: {stuck}, at {self._passed_ns() / 1e9:.6f} s of the run: let '
                    'it wait with rclpy or threading, give --all-clocks if it sleeps, or correct '
                    'it') from None
            finally:
                gc.unfreeze()
                sys.argv = arguments
                if self._recorder is not None:
                    self._recorder.close(loop.now)
        for guest in self._host.guests:
            if guest.error is not None and not isinstance(guest.error, _ENDS):
                loop.warn(
                    f'--node {guest.program.spec}: after the end of the run its main raised '
                    f'{describe(guest.error)}')
        if not self._hosted:
            loop.warn(self._none_hosted())
        self._outputs.finish()
        result = self._result(time.monotonic() - begun)
        for node in self._holder.ordered_nodes():   # they would keep the context in use
            Node.destroy_node(node)
        return result

    def _passed_ns(self) -> int:
        return self._loop.now - self._loop.start

    def _begin(self) -> None:
        """Start the programs, one after the other; each runs until it waits for something."""
        self._host.start(
            self._holder, self._programs(), ros_arguments(self.ros_args),
            self._loop.stop)
        self._loop.at(self._loop.start, ENDED, self._started)

    def _started(self) -> None:
        """Begin to deliver, when each program waits for something."""
        gc.freeze()  # else each full collection visits all objects of the nodes
        if all(guest.is_complete for guest in self._host.guests) and not self._hosted:
            raise RerunError(self._none_hosted())
        name, pauses = self.recording.name, self.recording.pauses
        here = {n.get_fully_qualified_name() for guest in self._host.guests for n in guest.nodes}
        # a lifecycle node makes its publishers later
        known = {*self.recording.topics, *self._messages.offered, CLOCK, *(
            topic for each in self.task_set.callbacks if each.node in here
            for topic in each.publishes)}
        for callback in self.task_set.callbacks:
            for topic in callback.topics:
                if callback.key in self._hosted and topic not in known:
                    raise RerunError(
                        f'{name}: {topic}, which {callback.key} needs, is not '
                        'recorded: record it, or run the node that publishes it with --node')
        if pauses:
            self._loop.warn(f'{name}: timers do not fire in {counted(len(pauses), "pause")} of '
                            'over a minute without any message')
        self._messages.begin()

    def _none_hosted(self) -> str:
        text = self._registry.bindings.unbound_text(self._registry.by_id.values())
        return f'{text}: give the nodes that it declares, with the same names'

    # --- the end ---------------------------------------------------------------------------------

    def _over(self) -> None:
        """Judge what is open; then let programs end, whose context has ended."""
        failed = [(guest.program.spec, guest.error) for guest in self._host.guests
                  if guest.error is not None]
        self._loop.warn_of_waiting()
        self._engine.finish(self._loop.now)
        self._host.shut_down()
        for spec, error in failed:
            raise CallbackFailed(f'--node {spec}', error, self._passed_ns()) from error

    def _result(self, elapsed_s: float) -> Result:
        loop, recording, outputs = self._loop, self.recording, self._outputs
        both = set(recording.topics & outputs.counts.keys() - _OF_ALL_NODES)
        recorded = differences(
            [each for each in outputs.messages if each.topic in both],
            recording.messages(both), loop.start)
        recording.close()
        verdicts: RerunVerdicts = {
            'policy': self.policy, 'workers': self._workers,
            'preemptive': False, 'duration_ns': self._passed_ns(),
            **self._engine.verdicts.tally.result()}
        return Result(
            outputs.digest, outputs.messages, outputs.counts, loop.callbacks, loop.start,
            self._passed_ns(), elapsed_s, verdicts, sorted(both), recorded,
            [*recording.warnings, *loop.warnings])


class _TraceTime(TraceClock):
    """The clock of a trace: virtual time."""

    def __init__(self, loop: Loop) -> None:
        self.offset_ns = 0
        self._loop = loop

    def now(self) -> int:
        return self._loop.now

    def of_system(self, at: int) -> int:
        return at


@contextmanager
def _context(ros_args: Sequence[str]) -> Iterator[Any]:
    """Initialise rclpy, without discovery, and end it."""
    context = get_default_context()
    if not is_over(context):
        raise RerunError(
            'rclpy: it is initialised already: call rclpy.shutdown before, a rerun has a context '
            'of its own')
    before = os.environ.get(_NO_DISCOVERY)
    os.environ[_NO_DISCOVERY] = 'OFF'
    with ExitStack() as stack:
        try:
            context = stack.enter_context(initialised(ros_args))
        finally:
            del os.environ[_NO_DISCOVERY]
            if before is not None:
                os.environ[_NO_DISCOVERY] = before
        yield context
