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
the run publishes on the topic: then the node's messages count. Loaded from the recording are
the topics that nodes subscribe to, and the topics that they publish, to be compared. If a node
subscribes to another topic later, its later messages are loaded and arrive. If a node
subscribes to ``/clock``, and it is neither recorded nor published by a node, it gives virtual
time.

Which job does a message belong to?  That of the execution that has sent it, or that has started
the code that sends it. A recorded one starts
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
import re
from typing import Any

from mddag_executor.clocks import TraceClock
from mddag_executor.executor.attribution import header_stamp, NO_ORIGIN, Origin
from mddag_executor.executor.compat import alive, callback_type, WITH_INFO
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.outside import Outside
from mddag_executor.executor.publishing import state_of
from mddag_executor.executor.sources import SubscriptionEntity
from mddag_executor.executor.stamps import StampedReleases
from mddag_executor.executor.starters import Claim, starter_outside
from mddag_executor.executor.work import Work
from mddag_executor.replacements import instead, Replacements
from mddag_executor.rerun.durations import Durations
from mddag_executor.rerun.errors import RerunError
from mddag_executor.rerun.inputs import MessageBag, RecordedMessage
from mddag_executor.rerun.loop import ARRIVED, Loop, RECORDED
from mddag_executor.rerun.message_types import canonical, type_name
from mddag_executor.rerun.outputs import Outputs
from mddag_executor.trace.groups import PUBLICATION
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
_ASK_MIDDLEWARE = re.compile(r'get_.*(_names.*|_info_by_topic)|count_(clients|services)')


class Outlet:
    """
    A publisher of a node of the run.

    :ivar state: its topic and address in a trace, and how many messages it has sent.
    :ivar subscriptions: those whose QoS fits; None: to be found out.
    :ivar kept: what later subscriptions get, with the times of publication.
    """

    def __init__(self, publisher: Any) -> None:
        self.publisher = publisher
        self.kind = publisher.msg_type
        self.state = state_of(publisher)
        self.subscriptions: list[Entity] | None = None
        qos = publisher.qos_profile
        self.kept: deque[tuple[int, bytes]] = deque(
            maxlen=max(1, qos.depth) if _is_latched(qos) else 0)

    def fits(self, subscription: Any) -> bool:
        """Return whether a subscription gets what is published."""
        found, _ = qos_check_compatible(self.publisher.qos_profile, subscription.qos_profile)
        return bool(found != QoSCompatibility.ERROR) and subscription.msg_type is self.kind


def _is_latched(qos: Any) -> bool:
    return bool(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL)


class Messages:
    """Carries messages; ``offered`` has by topic the publishers of nodes of the run."""

    def __init__(
        self, loop: Loop, recording: MessageBag, times: Durations, outputs: Outputs,
        clock: TraceClock, outside: Outside,
    ) -> None:
        self._loop = loop
        self._outside = outside
        self._subscriptions: dict[str, list[Entity]] = {}
        self.offered: dict[str, list[Outlet]] = {}
        self._engine = loop.engine
        self._recording = recording
        self._releases = StampedReleases(clock, loop.warn)
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
        for name in filter(_ASK_MIDDLEWARE.fullmatch, list(vars(Node))):
            replace(Node, name, self._ask_middleware)

    # --- publishers and subscriptions ------------------------------------------------------------

    def refresh(
        self, nodes: Sequence[Node], added: Iterable[Entity], subscriptions: Iterable[Entity],
    ) -> None:
        """Update which subscriptions and publishers there are."""
        self._subscriptions = {}
        for entity in subscriptions:
            self._subscriptions.setdefault(entity.label, []).append(entity)
        for publisher in (each for node in nodes for each in node.publishers):
            if alive(publisher):
                self._outlet(publisher)
        # a destroyed publisher serves no late subscription
        self._outlets = {p: outlet for p, outlet in self._outlets.items() if alive(p)}
        self.offered = {}
        for outlet in self._outlets.values():
            outlet.subscriptions = None
            self.offered.setdefault(outlet.state.topic, []).append(outlet)
        for entity in added:
            if isinstance(entity, SubscriptionEntity) and _is_latched(
                    entity.rclpy_object.qos_profile):
                self._deliver_kept(entity)
        if not self._gives_clock and CLOCK in self._subscriptions and (
                CLOCK not in self._recording.topics and CLOCK not in self.offered):
            self._gives_clock = True
            self._publish_time()
        if self._has_begun:
            self._load()

    def _deliver_kept(self, entity: Entity) -> None:
        """Give a subscription what was published before it was there, as far as that is kept."""
        topic = entity.label
        for outlet in self.offered.get(topic, ()):
            if outlet.kept and outlet.fits(entity.rclpy_object):
                for stamp, data in outlet.kept:
                    self._arrive(entity, data, stamp, None)
        if topic in self._last and topic not in self.offered:
            stamp, data = self._last[topic]
            self._arrive(entity, data, stamp, None)

    def _outlet(self, publisher: Any) -> Outlet:
        outlet = self._outlets.get(publisher)
        if outlet is None:
            outlet = self._outlets[publisher] = Outlet(publisher)
            self._loop.changed = True   # it may be new: it is recorded with its node
            if self._engine.recorder is not None:   # or at once, as it may be destroyed before
                self._engine.recorder.publisher(publisher, outlet.state)
        return outlet

    # --- questions about the ROS graph -----------------------------------------------------------

    def _ask_middleware(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def ask(node: Node, *args: Any, **more: Any) -> Any:
            self._loop.warn(
                f'{node.get_fully_qualified_name()}: {original.__name__} asks the middleware, '
                'whose answer is not the same in each run')
            return original(node, *args, **more)

        return ask

    def _count_publishers(self, topic: str) -> int:
        """Count those of nodes of the run, or else the recording."""
        self._loop.refresh_now()
        return len(self.offered.get(topic, ())) or int(topic in self._recording.topics)

    def _count_subscribers(self, topic: str) -> int:
        """Count those of nodes of the run, and the rerun itself, which keeps all messages."""
        self._loop.refresh_now()
        return 1 + len(self._subscriptions.get(topic, ()))

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
        if not self._loop.in_run:
            self._loop.warn(
                f'{outlet.state.topic}: a thread publishes on it that is not of the run: when '
                'that happens depends on the machine')
        claim = self._claim(outlet, msg) if self._loop.in_run else None
        # a live run records what callbacks publish, and all on the topics of declared ones
        is_recorded = self._loop.current is not None or (
            outlet.state.topic in self._engine.attribution.topics)
        self._loop.send(
            partial(self._leave, outlet, data),
            partial(self._record, outlet, max(0, header_stamp(msg)), claim)
            if is_recorded else lambda thread: None, claim)

    def _claim(self, outlet: Outlet, msg: Any) -> Claim | None:
        """
        Note that code of the run publishes a message.

        :return: on behalf of which execution; None: of the callback that runs, or of none.
        """
        execution, topic, engine = self._loop.current, outlet.state.topic, self._engine
        work = None if execution is None else execution.work
        if work is not None:
            work.entity.publishes.add(topic)
            engine.answers.note_published(work, topic, msg)
            origin = engine.origin_of(work)
            engine.attribution.note_optional(topic, origin or NO_ORIGIN)
            if origin is not None:
                return None
        if topic not in engine.attribution.topics:
            return None
        starter = starter_outside() if work is None else work.starter
        claim = None if starter is None else starter.claim(topic, msg)
        if claim is not None:
            claim.work.entity.publishes.add(topic)
        elif work is None or work.entity.callback is None:
            self._outside.note(outlet.publisher, outlet.state,
                               '' if work is None else work.entity.name, engine.is_judging)
        return claim

    def _record(self, outlet: Outlet, header: int, claim: Claim | None, thread: int) -> None:
        if self._engine.record is not None:
            if claim is not None:
                self._engine.record_on_behalf(claim.work, self._loop.now, thread)
            self._sequence += 1
            self._engine.record(
                PUBLICATION, self._loop.now, thread, outlet.state.address, self._sequence,
                header)

    def _leave(self, outlet: Outlet, data: bytes, origin: Origin | None, release: int) -> None:
        """Send a message to the outputs and to the subscriptions."""
        now, state = self._loop.now, outlet.state
        self._outputs.add(now, state.topic, outlet.kind, data, outlet.publisher)
        state.count += 1
        if outlet.kept.maxlen:
            outlet.kept.append((now, data))
        if outlet.subscriptions is None:
            outlet.subscriptions = [
                entity for entity in self._subscriptions.get(state.topic, ())
                if outlet.fits(entity.rclpy_object)]
        for entity in outlet.subscriptions:
            arrive = partial(self._arrive, entity, data, now, origin, state.count)
            target = None if origin is None else entity.targets.get(origin.vertex)
            delay = 0 if origin is None or target is None else self._times.transport(
                origin.vertex, target[0], release)
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
        new = recording.load({*self._subscriptions, *self.offered})
        for topic, entities in self._subscriptions.items():
            recorded = recording.kinds.get(topic)
            wanted = type_name(entities[0].rclpy_object.msg_type)
            if recorded not in (None, wanted) and topic not in self.offered:
                raise RerunError(
                    f'{recording.name}: {topic} was recorded as {recorded}, and the node '
                    f'subscribes to it as {wanted}: record it again, or correct the node')
        if new:
            self._deliver_next(recording.messages(new, self._loop.now))

    def _deliver_next(
        self, coming: Iterator[RecordedMessage], message: RecordedMessage | None = None
    ) -> None:
        if message is not None:
            self._recorded(message.topic, message.data, message.published)
        for following in coming:
            self._loop.at(following.time, RECORDED, self._deliver_next, coming, following)
            break

    def _recorded(self, topic: str, data: bytes, published: int) -> None:
        if topic in self.offered:
            return  # the node's count
        self._last[topic] = published, data
        for entity in self._subscriptions.get(topic, ()):
            self._arrive(entity, data, published, None)

    def _publish_time(self) -> None:
        now = self._loop.now
        stamp = Time(nanoseconds=now).to_msg()
        self._recorded(CLOCK, serialize_message(Clock(clock=stamp)), now)
        if now + CLOCK_EVERY_NS < self._loop.end:
            self._loop.at(now + CLOCK_EVERY_NS, RECORDED, self._publish_time)

    # --- what arrives ----------------------------------------------------------------------------

    def _arrive(
        self, entity: Entity, data: bytes, source_stamp: int, origin: Origin | None,
        number: int = 0,
    ) -> None:
        """Have a subscription's callback run with a message."""
        now, engine = self._loop.now, self._engine
        if entity.removed:
            return
        message = self._message(entity, data)
        if entity.at_once:
            entity.rclpy_object.callback(message)
            engine.ran_at_once(entity)
            self._loop.on_ended(entity.rclpy_object)
            return
        args: tuple[Any, ...] = (message,)
        if callback_type(entity.rclpy_object) is WITH_INFO:
            args = message, {
                'source_timestamp': source_stamp, 'received_timestamp': now,
                'publication_sequence_number': number,
                'reception_sequence_number': entity.ready + 1}
        release = stamp = -1
        if entity.source >= 0:
            release, _ = engine.attribution.release_of(
                engine.tables.dag_of[entity.source], entity.topic, message, source_stamp, now,
                self._releases)
            stamp = header_stamp(message)
        elif origin is None and entity.remote_publishers:
            release, stamp = now, header_stamp(message)
            if stamp < 0:
                stamp = now  # a job of its own
        if engine.record is not None:
            engine.message_taken(entity, message, source_stamp, number, now)
        work = Work(entity, entity.rclpy_object.callback, args)
        engine.arrived(work, origin, release, stamp, now)

    def _message(self, entity: Entity, data: bytes) -> Any:
        kind = entity.rclpy_object.msg_type
        if entity.rclpy_object.raw:
            return data
        try:
            return deserialize_message(data, kind)
        except Exception as error:
            raise RerunError(
                f'{entity.label}: a message of it does not decode as '
                f'{type_name(kind)}, at {(self._loop.now - self._loop.start) / 1e9:.6f} s '
                f'({" ".join(str(error).split())[:120]}): record it with the type that the node '
                'has') from None
