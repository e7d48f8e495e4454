# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Messages from publishers, and from the recording, to subscriptions, without a middleware.

Theory of operation
-------------------
``publish`` serialises the message, so that nothing changes it any more, and passes it to the loop,
which lets it *leave* later. Then it is an output of the run, and goes to all subscriptions of its
topic whose QoS fits: each gets a message of its own, after the transport time.

A recorded message goes to the subscriptions of its topic at its recorded time, unless a node of
the run publishes on the topic: then the node's messages count. What is loaded of the recording are
the topics that nodes subscribe to, and those that they publish, to be compared. If a node
subscribes to another topic later, its messages are loaded then and arrive from then on. If a node
subscribes to ``/clock``, and it is neither recorded nor published by a node, it gives virtual
time.

Which job does a message belong to?  That of the execution that has sent it. A recorded one starts
a job if its subscription is its DAG's source. Otherwise it enters the job
that its header's stamp names, or one of its own (see ``executor.other_processes``).

Nodes that count the publishers or subscribers of a topic find those of the run, and the recording,
at once. Other questions about the ROS graph go to the middleware, which knows no recording, and a
warning says that the answer is not the same in each run.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any

from mddag_executor.executor.compat import alive, callback_type, WITH_INFO
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.jobs import header_stamp, Origin
from mddag_executor.executor.work import Work
from mddag_executor.replacements import instead, Replacements
from mddag_executor.rerun.durations import Durations
from mddag_executor.rerun.errors import RerunError
from mddag_executor.rerun.inputs import MessageBag, RecordedMessage
from mddag_executor.rerun.loop import ARRIVED, Loop, RECORDED, Sent
from mddag_executor.rerun.message_types import canonical, type_name
from mddag_executor.rerun.outputs import Outputs
from mddag_executor.trace.groups import PUBLICATION
from msg_graph import TaskSet
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, qos_check_compatible, QoSCompatibility
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.subscription import Subscription
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

CLOCK = '/clock'
CLOCK_EVERY_NS = 10_000_000
"""How often ``/clock`` gives the time."""
_ASK_MIDDLEWARE = (
    'get_topic_names_and_types', 'get_node_names', 'get_node_names_and_namespaces',
    'get_publisher_names_and_types_by_node', 'get_subscriber_names_and_types_by_node',
    'get_service_names_and_types_by_node', 'get_client_names_and_types_by_node',
    'get_service_names_and_types', 'get_publishers_info_by_topic',
    'get_subscriptions_info_by_topic', 'count_clients', 'count_services')


class Inlet:
    """A subscription of a node of the run."""

    __slots__ = ('entity', 'kind', 'raw', 'with_info', 'received')

    def __init__(self, entity: Entity) -> None:
        subscription = entity.rclpy
        self.entity = entity
        self.kind = subscription.msg_type
        self.raw = subscription.raw
        self.with_info = callback_type(subscription) is WITH_INFO
        self.received = 0


class Outlet:
    """
    A publisher of a node of the run.

    :ivar inlets: those whose QoS fits; None: to be found out.
    :ivar kept: what later subscriptions get, with the times of publication.
    """

    __slots__ = ('publisher', 'topic', 'kind', 'inlets', 'count', 'kept')

    def __init__(self, publisher: Any) -> None:
        self.publisher = publisher
        self.topic: str = publisher.topic_name
        self.kind = publisher.msg_type
        self.inlets: list[Inlet] | None = None
        self.count = 0
        qos = publisher.qos_profile
        self.kept: deque[tuple[int, bytes]] = deque(
            maxlen=max(1, qos.depth) if _is_latched(qos) else 0)

    def fits(self, inlet: Inlet) -> bool:
        """Return whether a subscription gets what is published."""
        found, _ = qos_check_compatible(
            self.publisher.qos_profile, inlet.entity.rclpy.qos_profile)
        return bool(found != QoSCompatibility.ERROR) and inlet.kind is self.kind


def _is_latched(qos: Any) -> bool:
    return bool(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL)


class Messages:
    """Carries messages; ``offered`` has by topic the publishers of nodes of the run."""

    def __init__(
        self, loop: Loop, recording: MessageBag, times: Durations, outputs: Outputs,
        task_set: TaskSet,
    ) -> None:
        self._loop = loop
        self._inlets: dict[str, list[Inlet]] = {}
        self.offered: dict[str, list[Outlet]] = {}
        self._engine = loop.engine
        self._recording = recording
        self._release_from = [dag.release_from for dag in task_set.dags]
        self._times = times
        self._outputs = outputs
        self._outlets: dict[Any, Outlet] = {}
        # the last recorded message of each topic, with its publication
        self._last: dict[str, tuple[int, bytes]] = {}
        self._has_begun = self._gives_clock = False
        self._sequence = 0

    def install(self, replacements: Replacements) -> None:
        """Have publishers and subscriptions use this."""
        replace = replacements.replace
        replace(Publisher, 'publish', instead(self._publish))
        replace(Publisher, 'get_subscription_count',
                instead(lambda publisher: self._count_subscribers(publisher.topic_name)))
        replace(Publisher, 'wait_for_all_acked', instead(lambda *args, **more: True))
        replace(Subscription, 'get_publisher_count',
                instead(lambda subscription: self._count_publishers(subscription.topic_name)))
        replace(Node, 'count_publishers', instead(
            lambda node, topic_name: self._count_publishers(node.resolve_topic_name(topic_name))))
        replace(Node, 'count_subscribers', instead(
            lambda node, topic_name: self._count_subscribers(node.resolve_topic_name(topic_name))))
        for name in _ASK_MIDDLEWARE:
            if name in vars(Node):
                replace(Node, name, self._asking)

    # --- publishers and subscriptions ------------------------------------------------------------

    def refresh(self, nodes: Sequence[Node], subscriptions: Iterable[Entity]) -> None:
        """Update which subscriptions and publishers there are."""
        known = {inlet.entity: inlet for inlets in self._inlets.values() for inlet in inlets}
        new = []
        self._inlets = {}
        for entity in subscriptions:
            inlet = known.get(entity)
            if inlet is None:
                inlet = Inlet(entity)
                new.append(inlet)
            self._inlets.setdefault(entity.label, []).append(inlet)
        for publisher in (each for node in nodes for each in node.publishers):
            if alive(publisher):
                self._outlet(publisher)
        # a destroyed publisher serves no late subscription
        self._outlets = {p: outlet for p, outlet in self._outlets.items() if alive(p)}
        self.offered = {}
        for outlet in self._outlets.values():
            outlet.inlets = None
            self.offered.setdefault(outlet.topic, []).append(outlet)
        for inlet in new:
            if _is_latched(inlet.entity.rclpy.qos_profile):
                self._deliver_kept(inlet)
        if not self._gives_clock and CLOCK in self._inlets and (
                CLOCK not in self._recording.topics and CLOCK not in self.offered):
            self._gives_clock = True
            self._publish_time()
        if self._has_begun:
            self._load()

    def _deliver_kept(self, inlet: Inlet) -> None:
        """Give a subscription what was published before it was there, as far as that is kept."""
        topic = inlet.entity.label
        for outlet in self.offered.get(topic, ()):
            if outlet.kept and outlet.fits(inlet):
                for stamp, data in outlet.kept:
                    self._arrive(inlet, data, stamp, None)
        if topic in self._last and topic not in self.offered:
            stamp, data = self._last[topic]
            self._arrive(inlet, data, stamp, None)

    def _outlet(self, publisher: Any) -> Outlet:
        outlet = self._outlets.get(publisher)
        if outlet is None:
            outlet = self._outlets[publisher] = Outlet(publisher)
        return outlet

    def _inlets_of(self, outlet: Outlet) -> list[Inlet]:
        if outlet.inlets is None:
            outlet.inlets = [i for i in self._inlets.get(outlet.topic, ()) if outlet.fits(i)]
        return outlet.inlets

    # --- questions about the ROS graph -----------------------------------------------------------

    def _asking(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def ask(node: Node, *args: Any, **more: Any) -> Any:
            self._loop.warn(
                f'{node.get_fully_qualified_name()}: {original.__name__} asks the middleware, '
                'which does not find the same in each run')
            return original(node, *args, **more)

        return ask

    def _count_publishers(self, topic: str) -> int:
        """Count those of nodes of the run, or else the recording."""
        self._loop.refresh_now()
        return len(self.offered.get(topic, ())) or int(topic in self._recording.topics)

    def _count_subscribers(self, topic: str) -> int:
        """Count those of nodes of the run, and the rerun itself, which keeps all messages."""
        self._loop.refresh_now()
        return 1 + len(self._inlets.get(topic, ()))

    # --- what nodes publish ----------------------------------------------------------------------

    def _publish(self, publisher: Any, msg: Any) -> None:
        """Publish a message, in place of ``Publisher.publish``."""
        with publisher.handle:  # else it has been destroyed
            outlet = self._outlet(publisher)
        if isinstance(msg, publisher.msg_type):
            data = canonical(serialize_message(msg), publisher.msg_type)
        elif isinstance(msg, bytes):
            data = msg
        else:
            raise TypeError(f'Expected {publisher.msg_type}, got {type(msg)}')
        if self._loop.run_threads.current() is None:
            self._loop.warn(
                f'{outlet.topic}: a thread publishes on it that is not of the run: when '
                'that happens depends on the machine')
        current = self._loop.current
        if current is not None:
            current.work.entity.publishes.add(outlet.topic)
        self._loop.send(Sent(partial(self._leave, outlet, data), partial(self._record, outlet)))

    def _record(self, outlet: Outlet, thread: int) -> None:
        """Record a publication."""
        if self._engine.record is not None:
            self._sequence += 1
            self._engine.record(
                PUBLICATION, self._loop.now, thread, id(outlet.publisher), self._sequence)

    def _delay(self, inlet: Inlet, origin: Origin | None, release: int) -> int:
        target = None if origin is None else inlet.entity.targets.get(origin.vertex)
        if origin is None or target is None:
            return 0
        return self._times.transport(origin.dag, origin.vertex, target[0], release)

    def _leave(self, outlet: Outlet, data: bytes, origin: Origin | None, release: int) -> None:
        """Send a message to the outputs and to the subscriptions."""
        now = self._loop.now
        self._outputs.add(now, outlet.topic, outlet.kind, data, outlet.publisher)
        outlet.count += 1
        if outlet.kept.maxlen:
            outlet.kept.append((now, data))
        for inlet in self._inlets_of(outlet):
            arrive = partial(self._arrive, inlet, data, now, origin, outlet.count)
            delay = self._delay(inlet, origin, release)
            if delay:
                self._loop.at(now + delay, ARRIVED, arrive)
            else:
                arrive()

    # --- what is recorded ------------------------------------------------------------------------

    def begin(self) -> None:
        """Deliver what is recorded, from now on."""
        self._has_begun = True
        self._load()

    def _load(self) -> None:
        """Load the messages that nodes need by now, and begin to deliver them."""
        recording = self._recording
        new = recording.load({*self._inlets, *self.offered})
        for topic, inlets in self._inlets.items():
            recorded, wanted = recording.kinds.get(topic), type_name(inlets[0].kind)
            if recorded not in (None, wanted) and topic not in self.offered:
                raise RerunError(
                    f'{recording.name}: {topic} was recorded as {recorded}, and the node '
                    f'subscribes to it as {wanted}: record it again, or correct the node')
        if new:
            self._deliver_next(recording.messages(new, self._loop.now))

    def _deliver_next(self, coming: Iterator[RecordedMessage]) -> None:
        def deliver(message: RecordedMessage) -> None:
            self._recorded(message.topic, message.data, message.published)
            self._deliver_next(coming)

        for message in coming:
            self._loop.at(message.time, RECORDED, deliver, message)
            break

    def _recorded(self, topic: str, data: bytes, published: int) -> None:
        if topic in self.offered:
            return  # the node's count
        self._last[topic] = published, data
        for inlet in self._inlets.get(topic, ()):
            self._arrive(inlet, data, published, None)

    def _publish_time(self) -> None:
        now = self._loop.now
        stamp = Time(nanoseconds=now).to_msg()
        self._recorded(CLOCK, serialize_message(Clock(clock=stamp)), now)
        if now + CLOCK_EVERY_NS < self._loop.end:
            self._loop.at(now + CLOCK_EVERY_NS, RECORDED, self._publish_time)

    # --- what arrives ----------------------------------------------------------------------------

    def _arrive(
        self, inlet: Inlet, data: bytes, source_stamp: int, origin: Origin | None, number: int = 0
    ) -> None:
        """Have a subscription's callback run with a message."""
        entity, now, engine = inlet.entity, self._loop.now, self._engine
        if entity.removed:
            return
        message = self._message(inlet, data)
        inlet.received += 1
        if entity.at_once:
            entity.rclpy.callback(message)
            engine.ran_at_once(entity)
            return
        args: tuple[Any, ...] = (message,)
        if inlet.with_info:
            args = message, {
                'source_timestamp': source_stamp, 'received_timestamp': now,
                'publication_sequence_number': number,
                'reception_sequence_number': inlet.received}
        release = stamp = -1
        if entity.source >= 0:
            release, stamp = self._release(entity, message, source_stamp)
        elif origin is None and entity.remote_publishers:
            release, stamp = now, header_stamp(message)
            if stamp < 0:
                stamp = now  # a job of its own
        if engine.record is not None:
            engine.taken(entity, message, source_stamp, now)
        engine.arrived(Work(entity, entity.rclpy.callback, args), origin, release, stamp, now)

    def _release(self, entity: Entity, message: Any, source_stamp: int) -> tuple[int, int]:
        """Return the release of the job that a message starts, and the stamp that names it."""
        kind = self._release_from[self._engine.tables.dag_of[entity.source]]
        stamp = header_stamp(message)
        if kind == 'header_stamp' and stamp >= 0:
            return stamp, stamp
        return source_stamp if kind == 'source_timestamp' else self._loop.now, stamp

    def _message(self, inlet: Inlet, data: bytes) -> Any:
        if inlet.raw:
            return data
        try:
            return deserialize_message(data, inlet.kind)
        except Exception as error:
            raise RerunError(
                f'{inlet.entity.label}: a message of it does not decode as '
                f'{type_name(inlet.kind)}, at {(self._loop.now - self._loop.start) / 1e9:.6f} s '
                f'({" ".join(str(error).split())[:120]}): record it with the type that the node '
                'has') from None
