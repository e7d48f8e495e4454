# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Real rclpy nodes made from a declaration.

Theory of operation
-------------------
1. *Nodes.*  One rclpy node for each declared node, with exactly the declared callbacks and
   publishers.  A callback executes for its planned time and then publishes on all of its topics.
2. *Messages* are of type ``std_msgs/Header``.  The stamp is the *release* of the job, passed on
   unchanged from the source to the sinks.  ``frame_id`` is ``DAG#INDEX``: the DAG and the local
   index of the publishing vertex.  So a callback that several publishers start (OR) knows which of
   its vertices it runs as.  A sync callback (AND) has one subscription for each topic; it executes
   in the leg that receives the last of the messages with equal stamps.  Incomplete joins of the
   last ``JOIN_LIMIT`` jobs are kept.
3. *Releases.*  Under this package's executor a source gets its release from ``current_job``.
   Under another executor it is the nominal due time of the timer: rcl's next call time at the
   previous call.  A late call does not make a release later.
4. *Sensors.*  Sources that are not timers get a stand-in sensor.  One thread (node
   ``/mddag_sensors``, with publishers and clients only, not on any executor, so it occupies no
   worker) publishes on their topics or calls their services at the nominal releases.  A service's
   request is a ``rcl_interfaces/ListParameters``, whose ``depth`` carries the release (ns).
5. *Settings.*  Queue edges (``reads:``) start no callback and are not subscribed.  QoS is
   reliable, keep last 10: no message is lost unless a callback is ten periods late.  Callbacks
   without a declared group may overlap themselves (one ``ReentrantCallbackGroup`` for each node),
   as jobs do in the paper; each declared group is a ``MutuallyExclusiveCallbackGroup`` of its
   node.  The nodes have no services for parameters and types and no rosout publisher, so a hundred
   of them start within a second.
6. *Start.*  All timers start together, when every publisher has discovered its subscribers, so
   that no release is lost to discovery.  The DAGs' first releases are one period after that
   instant.  The measured window begins ``WARM_UP_S`` later.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
import math
import threading
import time
from typing import Any, NamedTuple

from mddag_executor.child import Tick
from mddag_executor.core import legs_of
from mddag_executor.executor.attribution import header_stamp
from mddag_executor.executor.listeners import NextCall
from mddag_executor.executor.quiet_nodes import quiet_node
from mddag_executor.executor.session import Session
from mddag_executor.synthetic.bodies import Emulate, native, sleeper, spin, typical_oversleep_ns
from mddag_executor.synthetic.measure import (
    Body,
    ExecutionPlan,
    Ledger,
    MOST_MEASURED_S,
    WARM_UP_S,
)
from msg_graph import Callback, Dag, TaskSet, Vertex
from rcl_interfaces.srv import ListParameters
from rclpy.callback_groups import (
    CallbackGroup,
    MutuallyExclusiveCallbackGroup,
    ReentrantCallbackGroup,
)
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.timer import Timer
from std_msgs.msg import Header

QOS = QoSProfile(
    reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=10)
SENSORS_NODE = '/mddag_sensors'
JOIN_LIMIT = 64
"""How many incomplete joins a sync vertex keeps."""
SENSOR = '#sensor '
"""The prefix of ``frame_id`` of a stand-in sensor's message; its topic follows."""
_LEAD_NS = 20_000_000
_CLOCKS_NS = 1_000_000
"""Well above the difference between the clocks of two processes, and below any period."""

CurrentJob = Callable[[], Any]
"""Returns None, or an object with the ``release_ns`` of the job that the calling thread runs."""


def no_job() -> None:
    """Replace ``current_job`` under executors that have no jobs."""


def stamped(release: int, sender: str = '') -> Header:
    """Make a message that carries a release (ns since the epoch)."""
    message = Header(frame_id=sender)
    message.stamp.sec, message.stamp.nanosec = divmod(release, 1_000_000_000)
    return message


class Role:
    """
    A callback as one vertex, and its actions for a message of that DAG.

    :ivar senders: the ``frame_id`` of the messages that it waits for.
    """

    def __init__(
        self, vertex: Vertex, dag: Dag, execution_ns: int, emulate: Emulate,
        publishers: list[Publisher], ledger: Ledger,
    ) -> None:
        self.vertex = vertex
        self.senders = [f'{dag.name}#{index}' for index in vertex.predecessors] or [
            SENSOR + topic for topic in vertex.callback.topics]
        self._sender = f'{dag.name}#{vertex.index}'
        self._execution_ns, self._emulate = execution_ns, emulate
        self._publishers = publishers
        self._ledger = ledger
        self._n_legs = len(legs_of(vertex, dag.vertices))
        # incomplete joins of a sync: the received messages (topic and sender), by release
        self._waiting: dict[int, set[tuple[str, str]]] = {}
        self._lock = threading.Lock()

    def is_whole(self, release: int, leg: tuple[str, str]) -> bool:
        """Note a message of a sync; return whether it was the last one of its job."""
        with self._lock:
            seen = self._waiting.setdefault(release, set())
            seen.add(leg)
            if len(seen) == self._n_legs:
                del self._waiting[release]
                return True
            if len(self._waiting) > JOIN_LIMIT:
                del self._waiting[next(iter(self._waiting))]
            return False

    def execute(self, message: Header, release: int) -> None:
        """Execute the body, publish, and note the completion of a sink."""
        ledger, name = self._ledger, self.vertex.name
        start = time.monotonic_ns()
        self._emulate(self._execution_ns)
        ledger.note(ledger.durations[name], time.monotonic_ns() - start)
        message.frame_id = self._sender
        for publisher in self._publishers:
            publisher.publish(message)
        if name in ledger.completions:
            ledger.note(ledger.completions[name], (release, ledger.now()))


class Grid:
    """Nominal due times of a timer, ns since the epoch."""

    def __init__(self, timer: Timer, clock_offset_ns: int) -> None:
        self._timer = timer
        self._offset = clock_offset_ns
        with timer.handle:
            self._next_call = NextCall(timer.handle.pointer)
        self._next = 0
        self._lock = threading.Lock()

    def start(self) -> int:
        """Start the timer; return its first due time, one period from now."""
        self._timer.reset()
        self._advance()
        return self._next + self._offset

    def release(self) -> int:
        """Return the due time of a call of the timer; to be called once in each of them."""
        with self._lock:
            release = self._next
            self._advance()
        return release + self._offset

    def _advance(self) -> None:
        with self._timer.handle:
            self._next = self._next_call.read() or self._next  # it may be cancelled meanwhile


def callback_of(
    topic: str, roles: list[Role], ledger: Ledger, current_job: CurrentJob
) -> Callable[[Header], None]:
    """
    Make the callback of a subscription: the sender of a message selects the vertex.

    For a sync, it executes the body in the last leg of a job.
    """
    by_sender = {sender: role for role in roles for sender in role.senders}
    is_sync = bool(roles) and roles[0].vertex.callback.kind == 'sync'

    def on_message(message: Header) -> None:
        role = by_sender.get(message.frame_id)
        if role is None:
            return  # published from outside of the declaration
        release = header_stamp(message)
        if is_sync and not role.is_whole(release, (topic, message.frame_id)):
            return
        job = current_job()
        if job is None:
            if current_job is not no_job:
                ledger.note(ledger.unattributed, role.vertex.name)
        elif not role.vertex.predecessors:
            release = job.release_ns  # of a source the executor's
            message = stamped(release)
        elif abs(job.release_ns - release) > ledger.tolerance_ns:
            ledger.note(ledger.misattributed, (role.vertex.name, release, job.release_ns))
        role.execute(message, release)

    return on_message


class Sensor(NamedTuple):
    """Stand-in for the senders of messages and requests to sources that are not timers."""

    dags: list[str]
    period_ns: int
    send: Callable[[int], None]


class SyntheticWorkload:
    """
    The nodes of a declaration, their timers, stand-in sensors and ledger.

    Use: add ``nodes`` to an executor, ``run``, ``destroy``; then ``measure`` judges the ledger.

    :param task_set: the declaration.
    :param plan: the execution time of each vertex.
    :param current_job: ``mddag_executor.executor.current_job`` under this package's executor;
        leave it out under others.
    :param context: of the nodes; None is rclpy's default context.
    :param process: make only the nodes that the declaration assigns to this process.
    :ivar timers: by the DAG that they release.
    """

    def __init__(
        self, task_set: TaskSet, plan: ExecutionPlan, *, current_job: CurrentJob = no_job,
        context: Context | None = None, process: str | None = None,
    ) -> None:
        self.task_set = task_set
        self.plan = plan
        self.ledger = Ledger(task_set)
        if process is not None:
            self.ledger.tolerance_ns = _CLOCKS_NS
        self._process = process
        self._current_job = current_job
        self._context = context
        self._emulate: dict[Body, Emulate] = {'spin': spin}
        bodies = {plan.body(v) for v in task_set.vertices if self._is_here(v.callback.node)}
        if 'sleep' in bodies:
            self.ledger.busy_below_ns = typical_oversleep_ns()  # takes 30 ms
            self._emulate['sleep'] = sleeper(self.ledger.busy_below_ns)
        if 'native' in bodies:
            self._emulate['native'] = native()
        # Timers on the steady clock: steps of the system clock move no release.
        self._clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._nodes: dict[str, Node] = {}
        self._n_subscribers = Counter(t for c in task_set.callbacks for t in c.topics)
        self._n_publishers = Counter(
            t for _, t in {(c.node, t) for c in task_set.callbacks for t in c.publishes})
        self._vertices: dict[str, list[Vertex]] = {}
        for vertex in task_set.vertices:
            self._vertices.setdefault(vertex.callback.key, []).append(vertex)
        self.timers: dict[str, Timer] = {}
        self._grids: dict[str, Grid] = {}
        self._sensor_nodes: list[Node] = []
        self._sensor_thread = threading.Thread(
            target=self._run_sensors, name='mddag_sensors', daemon=True)
        self._stop = threading.Event()
        for name in dict.fromkeys(callback.node for callback in task_set.callbacks):
            if self._is_here(name):
                self.make(name)
        self._sensors = self._make_sensors()

    @property
    def nodes(self) -> list[Node]:
        """Return the nodes to add to an executor."""
        return list(self._nodes.values())

    def run(
        self, session: Session, duration_s: float | None, tick: Tick | None = None,
        begin: Callable[[Session, Callable[[], list[str]]], object] = Session.wait_until_matched,
    ) -> bool:
        """
        Run in a session that spins already, and end the session.

        :param duration_s: how long after ``WARM_UP_S``; None: until the session is stopped.  The
            measured window ends after ``MOST_MEASURED_S`` at the latest.
        :param begin: waits until publishers and subscriptions have discovered each other, and for
            other processes.
        :return: whether there is a window: the run was not stopped before it began.
        :raises mddag_executor.executor.session.SessionError: when discovery fails.
        """
        self.ledger.is_open = True
        try:
            executors: Callable[[], list[str]] = getattr(session.executor, 'unmatched', list)
            begin(session, lambda: self.unmatched() + executors())
            if session.stopped:
                return False
            self.start(session.executor.wake)
            if session.wait(WARM_UP_S):
                return False
            self._measure(session, math.inf if duration_s is None else duration_s, tick)
            return True
        finally:
            self.stop()
            session.end()

    def _measure(self, session: Session, seconds: float, tick: Tick | None) -> None:
        ledger = self.ledger
        start = ledger.reading()
        is_over = session.wait(min(seconds, MOST_MEASURED_S), tick)
        ledger.window = start, ledger.reading()
        if seconds > MOST_MEASURED_S and not is_over:
            ledger.is_open = False
            session.wait(seconds - MOST_MEASURED_S,
                         tick and (lambda passed: tick(MOST_MEASURED_S + passed)))

    def unmatched(self) -> list[str]:
        """Return the topics whose publishers and subscriptions have not discovered each other."""
        found: set[str] = set()
        for node in self._all_nodes():
            found.update(
                each.topic_name for each in node.publishers
                if each.get_subscription_count() < self._n_subscribers[each.topic_name])
            found.update(
                each.topic_name for each in node.subscriptions
                if each.get_publisher_count() < self._n_publishers[each.topic_name])
        return sorted(found)

    def _all_nodes(self) -> list[Node]:
        return [*self.nodes, *self._sensor_nodes]

    def start(self, wake: Callable[[], None]) -> None:
        """
        Start all timers and sensors together.

        :param wake: wakes the executor: a wait set that already waits does not notice a timer's
            start.
        """
        for dag in self.timers:
            self.start_timer(dag)
        wake()
        begin = self.ledger.now() + _LEAD_NS
        for sensor in self._sensors:
            self.ledger.first_release.update(dict.fromkeys(sensor.dags, begin + sensor.period_ns))
        if self._sensors:
            self._sensor_thread.start()

    def start_timer(self, dag: str) -> None:
        """Start the timer that releases a DAG, one period from now."""
        self.ledger.first_release[dag] = self._grids[dag].start()

    def stop(self) -> None:
        """
        Stop the sensors.

        Timers continue: rclpy's executors raise when a timer is cancelled that they are about to
        call.  They end with the executor.
        """
        self._stop.set()
        if self._sensor_thread.is_alive():
            self._sensor_thread.join()

    def destroy(self) -> None:
        """Destroy the nodes."""
        for node in self._all_nodes():
            node.destroy_node()

    def _run_sensors(self) -> None:
        due = [(self.ledger.first_release[sensor.dags[0]], index)
               for index, sensor in enumerate(self._sensors)]
        while True:
            release, index = min(due)
            if self._stop.wait(max(0, release - self.ledger.now()) / 1e9):
                return
            self._sensors[index].send(release)
            due[index] = (release + self._sensors[index].period_ns, index)

    def make(self, name: str) -> Node:
        """Make a declared node with its entities, perhaps again; its timers have not started."""
        node = self._nodes[name] = quiet_node(name, self._context)
        callbacks = [each for each in self.task_set.callbacks if each.node == name]
        by_topic = {topic: node.create_publisher(Header, topic, QOS)
                    for topic in dict.fromkeys(t for each in callbacks for t in each.publishes)}
        groups: dict[str, CallbackGroup] = {}
        for callback in callbacks:
            kind = MutuallyExclusiveCallbackGroup if callback.group else ReentrantCallbackGroup
            group = groups.setdefault(callback.group or '', kind())
            publishers = [by_topic[topic] for topic in callback.publishes]
            roles = [
                Role(vertex, self.task_set.dags[vertex.dag], self.plan.execution_ns(vertex),
                     self._emulate[self.plan.body(vertex)], publishers, self.ledger)
                for vertex in self._vertices.get(callback.key, ())]
            if callback.kind == 'timer':
                self._add_timer(node, group, callback, roles[0])
            elif callback.kind == 'service':
                self._add_service(node, group, callback, roles[0])
            else:
                for topic in callback.topics:
                    on_message = callback_of(topic, roles, self.ledger, self._current_job)
                    node.create_subscription(Header, topic, on_message, QOS, callback_group=group)
        return node

    def _dag(self, vertex: Vertex) -> str:
        return self.task_set.dags[vertex.dag].name

    def _add_timer(
        self, node: Node, group: CallbackGroup, callback: Callback, role: Role
    ) -> None:
        dag, ledger, current_job = self._dag(role.vertex), self.ledger, self._current_job

        def on_timer() -> None:
            if callback.once:
                timer.cancel()
            start = ledger.now()
            job = current_job()
            release = grid.release() if job is None else job.release_ns
            ledger.note(ledger.delays[dag], (start, start - release))
            role.execute(stamped(release), release)

        timer = node.create_timer(
            (callback.timer_period_ns or 0) / 1e9, on_timer, callback_group=group,
            clock=self._clock, autostart=False)
        # Once more, exactly: seconds as a float may lose a nanosecond.
        timer.timer_period_ns = callback.timer_period_ns or 0
        self.timers[dag] = timer
        grid = self._grids[dag] = Grid(timer, ledger.clock_offset_ns)

    def _add_service(
        self, node: Node, group: CallbackGroup, callback: Callback, role: Role
    ) -> None:
        def on_request(
            request: ListParameters.Request, response: ListParameters.Response
        ) -> ListParameters.Response:
            job = self._current_job()
            release = request.depth if job is None else job.release_ns
            role.execute(stamped(release), release)
            return response

        node.create_service(
            ListParameters, callback.service or '', on_request, callback_group=group)

    def _is_here(self, node: str) -> bool:
        return self._process in (None, self.task_set.process_of(node))

    def _make_sensors(self) -> list[Sensor]:
        """Make the senders for DAGs whose sources are not timers."""
        sources: dict[str, list[Vertex]] = {}
        for vertex in self.task_set.vertices:
            if not vertex.predecessors and vertex.callback.kind != 'timer':
                start = vertex.callback.service or vertex.callback.topics[0]
                sources.setdefault(start, []).append(vertex)
        sensors = []
        for start, vertices in sources.items():
            self._n_publishers[start] += 1
            # One message on a topic releases all DAGs with a source on it, even in other
            # processes.
            callback = vertices[0].callback
            if self._is_here(callback.node):
                if not self._sensor_nodes:
                    self._sensor_nodes.append(quiet_node(SENSORS_NODE, self._context))
                make = requests_to if callback.service else messages_to
                sensors.append(Sensor(
                    [self._dag(vertex) for vertex in vertices],
                    min(vertex.callback.period_ns or 0 for vertex in vertices),
                    make(self._sensor_nodes[0], start)))
        return sensors


def messages_to(node: Node, topic: str) -> Callable[[int], None]:
    """Return what publishes a release as a sensor does."""
    publisher = node.create_publisher(Header, topic, QOS)
    return lambda release: publisher.publish(stamped(release, SENSOR + topic))


def requests_to(node: Node, service: str) -> Callable[[int], None]:
    """Return what calls a service with a release."""
    client = node.create_client(ListParameters, service)

    def send(release: int) -> None:
        future = client.call_async(ListParameters.Request(depth=release))
        client.remove_pending_request(future)  # the answer is not used

    return send
