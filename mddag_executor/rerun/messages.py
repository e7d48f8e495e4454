# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Messages from publishers to subscriptions, without a middleware.

Theory of operation
-------------------
``publish`` serialises the message, so that nothing changes it any more, and passes it to the loop,
which lets it *leave* later. Then it is an output of the run, and goes to all subscriptions of its
topic whose QoS fits: each gets a message of its own, after the transport time.

A recorded message goes to the subscriptions of its topic at its recorded time, unless a node of
the run publishes on the topic: then the node's messages count.

Which job does a message belong to?  That of the execution that has sent it. A recorded one starts
a job if its subscription is its DAG's source. Otherwise it enters the job
that its header's stamp names, or one of its own (see ``executor.other_processes``).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from mddag_executor.executor.compat import alive, callback_type, WITH_INFO
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.jobs import header_stamp, Origin
from mddag_executor.executor.work import Work
from mddag_executor.rerun.durations import Durations
from mddag_executor.rerun.errors import RerunError
from mddag_executor.rerun.loop import ARRIVED, Loop, Sent
from mddag_executor.rerun.message_types import canonical, type_name
from mddag_executor.rerun.outputs import Outputs
from mddag_executor.trace.groups import PUBLICATION
from msg_graph import TaskSet
from rclpy.exceptions import InvalidHandle
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, qos_check_compatible, QoSCompatibility
from rclpy.serialization import deserialize_message, serialize_message


class Inlet:
    """A subscription of a node of the run."""

    __slots__ = ('entity', 'topic', 'kind', 'raw', 'with_info', 'received')

    def __init__(self, entity: Entity) -> None:
        subscription = entity.rclpy
        self.entity = entity
        self.topic = entity.label
        self.kind = subscription.msg_type
        self.raw = subscription.raw
        self.with_info = callback_type(subscription) is WITH_INFO
        self.received = 0

    @property
    def latched(self) -> bool:
        """Return whether it wants messages from before it was there."""
        return bool(self.entity.rclpy.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL)


class Outlet:
    """A publisher of a node of the run."""

    __slots__ = ('publisher', 'topic', 'kind', 'inlets', 'count', 'kept', 'channel')

    def __init__(self, publisher: Any) -> None:
        self.publisher = publisher
        self.topic: str = publisher.topic_name
        self.kind = publisher.msg_type
        # those whose QoS fits; None: to be found out
        self.inlets: list[Inlet] | None = None
        self.count = 0
        qos = publisher.qos_profile
        latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
        # for later subscriptions
        self.kept: deque[tuple[int, bytes]] = deque(maxlen=max(1, qos.depth) if latched else 0)

    def fits(self, inlet: Inlet) -> bool:
        """Return whether a subscription gets what is published."""
        found, _ = qos_check_compatible(
            self.publisher.qos_profile, inlet.entity.rclpy.qos_profile)
        return bool(found != QoSCompatibility.ERROR) and inlet.kind is self.kind


class Messages:
    """
    Carries messages.

    :ivar offered: the topics on which nodes of the run publish.
    """

    def __init__(
        self, loop: Loop, times: Durations, outputs: Outputs, task_set: TaskSet,
        warn: Callable[[str], None],
    ) -> None:
        self._loop = loop
        self._engine = loop.engine
        self._release_from = [dag.release_from for dag in task_set.dags]
        self._times = times
        self._outputs = outputs
        self._warn = warn
        self._outlets: dict[Any, Outlet] = {}
        self._inlets: dict[str, list[Inlet]] = {}
        self._known: dict[int, Inlet] = {}
        self._last: dict[str, tuple[int, bytes]] = {}
        self.offered: dict[str, Any] = {}
        self._publishers: dict[str, int] = {}
        self._sequence = 0

    # --- publishers and subscriptions ------------------------------------------------------------

    def refresh(self, nodes: Iterable[Any], subscriptions: Iterable[Entity]) -> None:
        """Update which subscriptions and publishers there are."""
        known, self._known = self._known, {}
        new = []
        self._inlets = {}
        for entity in subscriptions:
            inlet = known.get(id(entity))
            if inlet is None or inlet.entity is not entity:
                inlet = Inlet(entity)
                new.append(inlet)
            self._known[id(entity)] = inlet
            self._inlets.setdefault(inlet.topic, []).append(inlet)
        # a destroyed publisher serves no late subscription
        self._outlets = {p: outlet for p, outlet in self._outlets.items() if alive(p)}
        for outlet in self._outlets.values():
            outlet.inlets = None
        self.offered, self._publishers = {}, {}
        for node in nodes:
            for publisher in node.publishers:
                try:
                    topic = publisher.topic_name
                except InvalidHandle:
                    continue  # destroyed meanwhile
                self.offered.setdefault(topic, publisher.msg_type)
                self._publishers[topic] = self._publishers.get(topic, 0) + 1
        for inlet in new:
            if inlet.latched:
                self._deliver_kept(inlet)

    def _deliver_kept(self, inlet: Inlet) -> None:
        """Give a subscription what was published before it was there, as far as that is kept."""
        for outlet in self._outlets.values():
            if outlet.topic == inlet.topic and outlet.kept and outlet.fits(inlet):
                for stamp, data in outlet.kept:
                    self._arrive(inlet, data, stamp, None)
        recorded = self._last.get(inlet.topic)
        if recorded is not None and inlet.topic not in self.offered:
            self._arrive(inlet, recorded[1], recorded[0], None)

    def inlets(self, topic: str) -> list[Inlet]:
        """Return the subscriptions of a topic."""
        return self._inlets.get(topic, [])

    def topics(self) -> dict[str, Any]:
        """Return the topics that nodes of the run subscribe to, with their types."""
        return {topic: inlets[0].kind for topic, inlets in self._inlets.items()}

    def _outlet(self, publisher: Any) -> Outlet:
        outlet = self._outlets.get(publisher)
        if outlet is None:
            outlet = self._outlets[publisher] = Outlet(publisher)
        return outlet

    def _inlets_of(self, outlet: Outlet) -> list[Inlet]:
        if outlet.inlets is None:
            outlet.inlets = [i for i in self.inlets(outlet.topic) if outlet.fits(i)]
        return outlet.inlets

    # --- what nodes publish ----------------------------------------------------------------------

    def publish(self, publisher: Any, msg: Any) -> None:
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
            self._warn(
                f'{outlet.topic}: a thread publishes on it that is not of the run: when '
                'that happens depends on the machine')
        current = self._loop.current
        if current is not None:
            current.work.entity.publishes.add(outlet.topic)
        self._loop.send(Sent(
            partial(self._leave, outlet, data), partial(self._record, outlet),
            partial(self._earliest, outlet)))

    def subscription_count(self, publisher: Publisher) -> int:
        """Return how many subscribe to a publisher's topic: nodes, and the rerun itself."""
        self._loop.refresh_now()
        return 1 + len(self._inlets_of(self._outlet(publisher)))

    def publisher_count(self, subscription: Any) -> int:
        """Return how many publish to a subscription: nodes of the run, or the recording."""
        self._loop.refresh_now()
        topic = subscription.topic_name
        return self.publishers(topic) or int(topic in self._last)

    def publishers(self, topic: str) -> int:
        """Return how many publishers nodes of the run have on a topic."""
        return self._publishers.get(topic, 0)

    def _record(self, outlet: Outlet, thread: int) -> None:
        """Record a publication."""
        if self._engine.record is not None:
            self._sequence += 1
            self._engine.record(
                PUBLICATION, self._loop.now, thread, id(outlet.publisher), self._sequence)

    def _earliest(self, outlet: Outlet, origin: Origin, release: int) -> int:
        """Return when the first subscription gets a message, after its execution's end."""
        if not self._times.recorded:
            return 0
        return min((self._delay(inlet, origin, release) for inlet in self._inlets_of(outlet)),
                   default=0)

    def _delay(self, inlet: Inlet, origin: Origin | None, release: int) -> int:
        target = None if origin is None else inlet.entity.targets.get(origin.vertex)
        if origin is None or target is None:
            return 0
        return self._times.transport(origin.dag, origin.vertex, target[0], release)

    def _leave(
        self, outlet: Outlet, data: bytes, origin: Origin | None, release: int, end: int
    ) -> None:
        """Send a message to the outputs and to the subscriptions."""
        now = self._loop.now
        self._outputs.add(now, outlet.topic, outlet.kind, data, outlet.publisher)
        outlet.count += 1
        if outlet.kept.maxlen:
            outlet.kept.append((now, data))
        for inlet in self._inlets_of(outlet):
            time = end + self._delay(inlet, origin, release)
            if time <= now:
                self._arrive(inlet, data, now, origin, outlet.count)
            else:
                self._loop.at(
                    time, ARRIVED, self._arrive, inlet, data, now, origin, outlet.count)

    # --- what arrives ----------------------------------------------------------------------------

    def recorded(self, topic: str, data: bytes, published: int) -> None:
        """Deliver a message of the recording."""
        if topic in self.offered:
            return  # the node's count
        self._last[topic] = published, data
        for inlet in self.inlets(topic):
            self._arrive(inlet, data, published, None)

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
        work = Work(entity, entity.rclpy.callback, args)
        release = stamp = -1
        if entity.source >= 0:
            release, stamp = self._release(entity, message, source_stamp)
        elif origin is None and entity.remote_publishers:
            stamp = header_stamp(message)
            release = now
            if stamp < 0:
                stamp = now  # a job of its own
        if engine.record is not None:
            engine.taken(entity, message, source_stamp, now)
        engine.arrived(work, origin, release, stamp, now)

    def _release(self, entity: Entity, message: Any, source_stamp: int) -> tuple[int, int]:
        """Return the release of the job that a message starts, and the stamp that names it."""
        engine, now = self._engine, self._loop.now
        kind = self._release_from[engine.tables.dag_of[entity.source]]
        stamp = header_stamp(message)
        if kind == 'header_stamp' and stamp >= 0:
            return stamp, stamp
        return source_stamp if kind == 'source_timestamp' else now, stamp

    def _message(self, inlet: Inlet, data: bytes) -> Any:
        if inlet.raw:
            return data
        try:
            return deserialize_message(data, inlet.kind)
        except Exception as error:
            raise RerunError(
                f'{inlet.topic}: a message of it does not decode as {type_name(inlet.kind)}, at '
                f'{(self._loop.now - self._loop.start) / 1e9:.6f} s '
                f'({" ".join(str(error).split())[:120]}): record it with the type that the node '
                'has') from None
