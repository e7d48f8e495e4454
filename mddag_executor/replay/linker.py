# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What belongs together in a recording of CARET or ros2_tracing: executions and their messages.

Theory of operation
-------------------
Two stages go through the events in the order of time.  The first keeps what each thread does; the
second, `LAG_NS` of recorded time later, calls its observer, also in the order of time: a
subscriber may run before the tracer has recorded the stamp of the message that it runs for.

1. *Executions*: `callback_start` to the next `callback_end` of the same callback in the same
   thread (CARET: of the same address; that is the same, except where a callback runs in several
   threads at once).  A callback may run inside another (one that spins); what ends before what
   began inside it shows that an end was lost.
2. *Publications*, within a thread: `rclcpp_publish`, then `rcl_publish` of the same publisher (in
   rclpy the only one; from Iron on the only one with the publisher's handle), then what writes it
   and what has the source timestamp.  `rclcpp_intra_publish` before `rclcpp_publish` of the same
   publisher is the same publication, as of then.  The source timestamp comes with

   * CARET and Cyclone DDS: `dds_write`, then `dds_bind_addr_to_stamp`, of the message's address,
   * CARET and Fast DDS, up to Galactic: `dds_write`, `dds_bind_addr_to_addr` from the message to
     what it became, then `dds_bind_addr_to_stamp` of that,
   * CARET and Fast DDS, from Humble on: `dds_bind_addr_to_stamp` of address 0, which stands for
     what the thread has published last,
   * CARET from Jazzy on: in `dds_write` already,
   * ros2_tracing from Jazzy on: `rmw_publish`; before, with an instrumented Cyclone DDS:
     `dds:write_pre` of the message's address, then `dds:write`.

   Until September 2021 CARET's events were called `ros2_hook`, some of their fields otherwise.
3. *Messages between processes*: `dispatch_subscription_callback` (Galactic, Humble) names the
   callback and the source timestamp; later formats have `rmw_take` in the same thread before the
   `callback_start`.  In August 2021 `dispatch` named the callback and the message's address, and
   `take_type_erased`, before it in the same thread, that address and the source timestamp.  The
   publication is the one on the same topic with that source timestamp.
4. *Messages within a process*: in Humble by the message's address, followed through the copies
   (`message_construct`) to `dispatch_intra_process_subscription_callback` (in August 2021
   `dispatch_intra_process`); from Iron on by buffer and index of the ring buffer that it went
   through (`rclcpp_ring_buffer_enqueue`, `_dequeue`).
5. `rmw_take` inside an execution is a message that the callback took itself (a queue edge).
6. What does not fit (an end without a start, a start without an end, a message whose publication
   is not in the recording, a publisher's that lacks a tracepoint) is counted by callback or topic,
   and the observer learns where it is not known what a callback ran for.

Publications are kept until `KEEP` newer ones of their topic have come.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable as Function
from collections.abc import Mapping
from typing import Any

from mddag_executor.recording.entities import Callback, Entities, Publisher
from mddag_executor.text import counted, listed
from mddag_executor.trace.channels import Layout

LAG_NS = 200_000_000
KEEP = 16_384
_DEEPEST = 32

Event = tuple[Any, ...]
Thread = tuple[int, int]        # process and thread
Handler = Function[[Event, Thread, '_Thread'], None]


class Execution:
    """
    An execution of a callback.

    :ivar thread: process and thread.
    :ivar end: -1 while it runs, or where its end was lost.
    :ivar stamp: source timestamp of the message that it runs for; 0: none is known.
    :ivar stated: the message's header stamp, where the recording has it; else 0.
    :ivar taken: when the message was taken, ns; 0: that is not recorded.
    :ivar inner: when another one last began in its thread while it ran, ns; 0: none did.
    :ivar ready: for those who use it: when it became ready, ns.
    :ivar of: for those who use it: DAG, vertex and job that it belongs to.
    :ivar leg: for those who use it: which leg of the vertex it is.
    :ivar number: for those who use it: identifies it.
    """

    __slots__ = ('callback', 'thread', 'start', 'end', 'stamp', 'stated', 'taken', 'message',
                 'inner', 'ready', 'of', 'leg', 'number')

    def __init__(self, callback: Callback, thread: Thread, start: int) -> None:
        self.callback = callback
        self.thread = thread
        self.start = start
        self.end = -1
        self.stamp = 0
        self.stated = 0
        self.taken = 0
        self.message: Publication | None = None
        self.inner = 0
        self.ready = start
        self.of: tuple[int, int, int] | None = None
        self.leg = 0
        self.number = -1


class Publication:
    """
    A message that was published; times in ns, 0 where they are not recorded.

    :ivar run: the execution that published it, None: none did.
    :ivar message: its address, and `written` that of what the middleware made of it.
    :ivar number: for those who use it: identifies it.
    """

    __slots__ = ('publisher', 'run', 'rclcpp', 'rcl', 'dds', 'stamp', 'message', 'written',
                 'within', 'number')

    def __init__(self, publisher: Publisher | None, run: Execution | None, message: int) -> None:
        self.publisher = publisher
        self.run = run
        self.rclcpp = 0
        self.rcl = 0
        self.dds = 0
        self.stamp = 0
        self.message = message
        self.written = 0
        self.within = False     # so far only within the process
        self.number = -1

    @property
    def time(self) -> int:
        """Return when it was published."""
        return self.rclcpp or self.rcl

    @property
    def topic(self) -> str:
        """Return its topic, empty where that is not known."""
        return self.publisher.topic if self.publisher is not None else ''


class LinkObserver:
    """Gets what the linker finds, in the order of time, and does nothing with it."""

    def began(self, run: Execution, message: Publication | None) -> None:
        """Note that an execution has begun, with the message that it runs for."""

    def sent(self, message: Publication) -> None:
        """Note that a message was published."""

    def took(self, run: Execution, message: Publication) -> None:
        """Note that a running callback took a message itself."""

    def over(self, run: Execution) -> None:
        """Note that an execution has ended."""

    def lost_sight(self, callback: Callback | None, run: Execution | None, time: int) -> None:
        """
        Note that something is not recorded.

        :param callback: it ran, it is not known for what; None: events were discarded.
        :param run: its execution, where only the end is not recorded.
        """


_SAID = {
    'ends': ('execution', 'without an end in it (the event was lost)'),
    'starts': ('execution', 'without a start in it (the event was lost): left out'),
    'messages': ('execution', 'for a message whose publication is not in it: of no job and no '
                 'path'),
    'unlinked': ('execution', 'for a message whose publication is not known (not all of its topic '
                 'have a source timestamp in it): of no job and no path'),
    'without_message': ('execution', 'of a subscription with no event in it that says which '
                        'message was taken: of no job and no path'),
    'partial': ('publication', 'without the tracepoint rclcpp_publish that others of the '
                'publisher have: counted from rcl_publish on'),
    'ambiguous': ('execution', 'for a message with the topic and source timestamp of another one: '
                  'of no job and no path'),
    'overwritten': ('message', 'overwritten in a ring buffer, never taken'),
    'unknown': ('execution', 'of a callback whose initialisation is not in it')}


class Losses:
    """
    What is lost or odd in a recording, counted by what it affects.

    :param said: by kind a noun, and what to say of so many.
    :param most: how many of the affected are named.
    """

    def __init__(self, said: Mapping[str, tuple[str, str]], most: int) -> None:
        self._said, self._most = said, most
        self._counts: dict[str, Counter[str]] = {kind: Counter() for kind in said}

    def count(self, kind: str, affected: str, number: int = 1) -> None:
        """Count something of a kind."""
        self._counts[kind][affected] += number

    def lines(self) -> list[str]:
        """Return what to say about it."""
        return [
            f'{counted(sum(counts.values()), noun)} {text}: '
            + listed([f'{name} ({n})' for name, n in counts.most_common()], self._most)
            for counts, (noun, text) in zip(self._counts.values(), self._said.values()) if counts]


class _Thread:
    """What a thread does."""

    __slots__ = ('stack', 'last', 'take', 'erased', 'fresh')

    def __init__(self) -> None:
        self.stack: list[Execution] = []
        self.last: Publication | None = None
        # (callback it names or None, its subscription's callbacks or None, stamp, stated, message,
        # time)
        self.take: tuple[Callback | None, list[Callback] | None, int, int, Publication | None,
                         int] | None = None
        # by `take_type_erased`: the message's address, its stamp and the time; zeros: none
        self.erased = 0, 0, 0
        self.fresh = True       # nothing has started in it so far


class Linker:
    """Links the events of a recording."""

    def __init__(self, entities: Entities, observer: LinkObserver) -> None:
        self.losses = Losses(_SAID, 3)
        #: What the tracer itself says that it discarded.
        self.discarded = 0
        self._entities = entities
        self._observer = observer
        self._threads: dict[Thread, _Thread] = {}
        self._queue: deque[tuple[int, Function[..., None], tuple[Any, ...]]] = deque()
        self._by_stamp: dict[str, dict[int, Publication | None]] = {}
        self._unstamped: set[str] = set()       # topics
        self._by_address: dict[tuple[int, int], Publication] = {}
        self._by_slot: dict[tuple[int, int, int], tuple[Publication, bool]] = {}
        self._by_rclcpp: set[Publisher] = set()
        self._by_rcl: Counter[Publisher] = Counter()        # publications by rcl alone
        # by the identity of a layout, which is kept so that no other gets it
        self._known: dict[int, tuple[Layout, Handler, dict[str, int]]] = {}
        self._fields: dict[str, int] = {}       # of the event that is being taken in
        caret: dict[str, Handler] = {
            'dds_write': self._dds_write,
            'dds_bind_addr_to_addr': self._became,
            'dds_bind_addr_to_stamp': self._bind,
        }
        self._handlers: dict[str, Handler] = {
            **{f'{provider}:{name}': handler for name, handler in caret.items()
               for provider in ('ros2_caret', 'ros2_hook')},
            'ros2:callback_start': self._start,
            'ros2:callback_end': self._end,
            'ros2:rclcpp_publish': self._rclcpp_publish,
            'ros2:rclcpp_intra_publish': self._intra_publish,
            'ros2:rcl_publish': self._rcl_publish,
            'ros2:rmw_publish': self._rmw_publish,
            'dds:write_pre': self._write_begins,
            'dds:write': self._written,
            'ros2:dispatch_subscription_callback': self._dispatch,
            'ros2_hook:take_type_erased': self._take_erased,
            'ros2:dispatch': self._dispatch_erased,
            'ros2:rmw_take': self._take,
            'ros2:dispatch_intra_process_subscription_callback': self._dispatch_within,
            'ros2:dispatch_intra_process': self._dispatch_within,
            'ros2:message_construct': self._copy,
            'ros2:rclcpp_ring_buffer_enqueue': self._enqueue,
            'ros2:rclcpp_ring_buffer_dequeue': self._dequeue,
            'mddag:lost': self._lost,
        }
        #: Full names of the events that it needs.
        self.events = frozenset(self._handlers)

    def take(self, event: Event) -> None:
        """Link an event as ``TraceReader.layout_events`` has it; times never decrease."""
        layout, now, pid, tid = event[:4]
        queue = self._queue
        while queue and queue[0][0] < now - LAG_NS:
            _, report, arguments = queue.popleft()
            report(*arguments)
        thread = (pid, tid)
        state = self._threads.get(thread)
        if state is None:
            state = self._threads[thread] = _Thread()
        known = self._known.get(id(layout))
        if known is None:
            fields = {name: place for place, name in enumerate(layout.fields, 4)}
            known = self._known[id(layout)] = layout, self._handlers[layout.name], fields
        self._fields = known[2]
        known[1](event, thread, state)

    def finish(self) -> None:
        """Report what is left; what runs has no end, unless others ran after it."""
        for run in self.running:
            if run.inner:
                self._without_end(run, run.inner)
        while self._queue:
            _, report, arguments = self._queue.popleft()
            report(*arguments)
        for publisher in self._by_rclcpp & set(self._by_rcl):
            self.losses.count('partial', publisher.topic, self._by_rcl.pop(publisher))

    @property
    def running(self) -> list[Execution]:
        """Return what runs now."""
        return [run for state in self._threads.values() for run in state.stack]

    def _get(self, event: Event, field: str) -> int:
        """Return a field of an event; 0 where it has none."""
        place = self._fields.get(field)
        value = None if place is None else event[place]
        return value if isinstance(value, int) else 0

    # --- executions ------------------------------------------------------------------------------

    def _start(self, event: Event, thread: Thread, state: _Thread) -> None:
        now = event[1]
        callback = self._entities.callback(thread[0], self._get(event, 'callback'), now)
        if callback.kind == 'unknown':
            self.losses.count('unknown', callback.label)
        if any(run.callback is callback for run in state.stack) or len(state.stack) > _DEEPEST:
            while state.stack:
                run = state.stack.pop()
                self._without_end(run, now)
                if run.callback is callback:
                    break
        run = Execution(callback, thread, now)
        take, state.take = state.take, None
        if take is not None:
            named, possible, run.stamp, run.stated, run.message, run.taken = take
            if (named is not None and named is not callback
                    or possible is not None and callback not in possible
                    or callback.kind in ('timer', 'service')):
                run.stamp = run.stated = run.taken = 0      # it was taken for something else
                run.message = None
        if state.stack:
            state.stack[-1].inner = now
        state.stack.append(run)
        state.fresh = False
        state.last = None
        self._queue.append((now, self._report_start, (run,)))

    def _report_start(self, run: Execution) -> None:
        message, run.message = run.message, None
        if message is None and run.stamp:
            topic = run.callback.start
            message = self._find(topic, run.stamp)
            if message is None:
                self._not_found(run, topic)
        elif message is None and run.callback.kind == 'subscription' and not run.taken:
            self.losses.count('without_message', run.callback.label)
        self._observer.began(run, message)

    def _not_found(self, run: Execution, topic: str) -> None:
        if run.stamp in self._by_stamp.get(topic, ()):
            self.losses.count('ambiguous', run.callback.label)
            self._observer.lost_sight(run.callback, None, run.start)
        elif self._unstamped.isdisjoint((topic, '')):
            self.losses.count('messages', run.callback.label)
        else:
            self.losses.count('unlinked', run.callback.label)

    def _find(self, topic: str, stamp: int) -> Publication | None:
        found = self._by_stamp.get(topic, {}).get(stamp)
        return found if found is not None else self._by_stamp.get('', {}).get(stamp)

    def _end(self, event: Event, thread: Thread, state: _Thread) -> None:
        now = event[1]
        callback = self._entities.callback(thread[0], self._get(event, 'callback'), now)
        state.last = None
        if not any(run.callback is callback for run in state.stack):
            # else it began before the recording did
            if not state.fresh or callback.made >= self._entities.begin:
                self.losses.count('starts', callback.label)
                self._queue.append((now, self._observer.lost_sight, (callback, None, now)))
            state.fresh = False
            return
        while True:
            run = state.stack.pop()
            if run.callback is callback:
                break
            self._without_end(run, now)
        run.end = now
        self._queue.append((now, self._observer.over, (run,)))

    def _without_end(self, run: Execution, now: int) -> None:
        self.losses.count('ends', run.callback.label)
        self._queue.append((now, self._observer.lost_sight, (run.callback, run, now)))

    # --- publications ----------------------------------------------------------------------------

    def _publication(self, event: Event, thread: Thread, state: _Thread) -> Publication:
        """Begin a publication."""
        handle = self._get(event, 'publisher_handle')
        publisher = None
        if handle:
            publisher = self._entities.publishers.latest(thread[0], handle, event[1])
        run = state.stack[-1] if state.stack else None
        message = Publication(publisher, run, self._get(event, 'message'))
        state.last = message
        self._queue.append((event[1], self._report_published, (message,)))
        return message

    def _report_published(self, message: Publication) -> None:
        if not message.stamp and not message.within:
            self._unstamped.add(message.topic)
        self._observer.sent(message)

    def _intra_publish(self, event: Event, thread: Thread, state: _Thread) -> None:
        message = self._publication(event, thread, state)
        message.rclcpp = event[1]
        message.within = True
        self._by_address[(thread[0], message.message)] = message

    def _rclcpp_publish(self, event: Event, thread: Thread, state: _Thread) -> None:
        last = state.last
        handle = self._get(event, 'publisher_handle')
        if last is not None and last.within and (not handle or (
                self._entities.publishers.latest(thread[0], handle, event[1]) is last.publisher)):
            last.within = False     # the same one, to other processes, too
            last.message = self._get(event, 'message')
            return
        self._publication(event, thread, state).rclcpp = event[1]

    def _rcl_publish(self, event: Event, thread: Thread, state: _Thread) -> None:
        last = state.last
        publisher = self._entities.publishers.latest(
            thread[0], self._get(event, 'publisher_handle'), event[1])
        if last is None or last.rcl or last.within or (
                last.publisher is not None and last.publisher is not publisher):
            last = self._publication(event, thread, state)
            if publisher is not None:
                self._by_rcl[publisher] += 1
        elif publisher is not None:
            self._by_rclcpp.add(publisher)
        last.publisher = publisher
        last.rcl = event[1]
        last.message = self._get(event, 'message')

    def _dds_write(self, event: Event, thread: Thread, state: _Thread) -> None:
        last = state.last
        message = self._get(event, 'message') or self._get(event, 'message_addr')
        if last is not None and not last.dds and not last.within and (
                not last.rcl or message == last.message):
            last.dds = event[1]
        self._stamp(state, message, self._get(event, 'timestamp_'))

    def _became(self, event: Event, thread: Thread, state: _Thread) -> None:
        last = state.last
        if last is not None and self._get(event, 'addr_from') == last.message:
            last.written = self._get(event, 'addr_to')

    def _bind(self, event: Event, thread: Thread, state: _Thread) -> None:
        address = self._get(event, 'addr') or self._get(event, 'addr_from')
        stamp = self._get(event, 'source_stamp') or self._get(event, 'stamp_to')
        self._stamp(state, address, stamp)

    def _rmw_publish(self, event: Event, thread: Thread, state: _Thread) -> None:
        stamp = self._get(event, 'timestamp_') or self._get(event, 'source_timestamp')
        self._stamp(state, self._get(event, 'message'), stamp)

    def _write_begins(self, event: Event, thread: Thread, state: _Thread) -> None:
        last = state.last
        if last is not None and self._get(event, 'data') == last.message:
            last.dds = event[1]
        else:
            state.last = None       # the stamp that follows is of something else

    def _written(self, event: Event, thread: Thread, state: _Thread) -> None:
        self._stamp(state, 0, self._get(event, 'timestamp_'))

    def _stamp(self, state: _Thread, address: int, stamp: int) -> None:
        last = state.last
        if last is None or last.stamp or last.within or not stamp or (
                last.rcl and address not in (0, last.message, last.written)):
            return
        last.stamp = stamp
        self._know(last.topic, stamp, last)

    def _know(self, topic: str, stamp: int, message: Publication | None) -> None:
        """Note of which publication a source timestamp is; None: of one of several."""
        known = self._by_stamp.setdefault(topic, {})
        known[stamp] = None if stamp in known else message
        if len(known) > KEEP:
            del known[next(iter(known))]

    # --- messages that arrive --------------------------------------------------------------------

    def _dispatch(self, event: Event, thread: Thread, state: _Thread) -> None:
        callback = self._entities.callback(thread[0], self._get(event, 'callback'), event[1])
        stamp, stated = self._get(event, 'source_stamp'), self._get(event, 'message_timestamp')
        state.take = callback, None, stamp, stated, None, event[1]

    def _take_erased(self, event: Event, thread: Thread, state: _Thread) -> None:
        state.erased = self._get(event, 'message'), self._get(event, 'source_stamp'), event[1]

    def _dispatch_erased(self, event: Event, thread: Thread, state: _Thread) -> None:
        callback = self._entities.callback(thread[0], self._get(event, 'callback'), event[1])
        (address, stamp, time), state.erased = state.erased, (0, 0, 0)
        if address == self._get(event, 'message'):      # else the event of its taking was lost
            state.take = callback, None, stamp, 0, None, time

    def _take(self, event: Event, thread: Thread, state: _Thread) -> None:
        stamp = self._get(event, 'source_timestamp')
        if not self._get(event, 'taken') or not stamp:
            return
        callbacks = self._entities.taken.latest(
            thread[0], self._get(event, 'rmw_subscription_handle'), event[1])
        if state.stack and callbacks:
            topic = callbacks[0].start
            self._queue.append((event[1], self._report_take, (state.stack[-1], topic, stamp)))
        state.take = None, callbacks, stamp, 0, None, event[1]

    def _report_take(self, run: Execution, topic: str, stamp: int) -> None:
        message = self._find(topic, stamp)
        if message is not None:
            self._observer.took(run, message)

    def _dispatch_within(self, event: Event, thread: Thread, state: _Thread) -> None:
        callback = self._entities.callback(thread[0], self._get(event, 'callback'), event[1])
        message = self._by_address.get((thread[0], self._get(event, 'message')))
        if message is None:
            self.losses.count('messages', callback.label)
        state.take = callback, None, 0, 0, message, event[1]

    def _copy(self, event: Event, thread: Thread, state: _Thread) -> None:
        pid = thread[0]
        message = self._by_address.get((pid, self._get(event, 'original_message')))
        if message is not None:
            self._by_address[(pid, self._get(event, 'constructed_message'))] = message

    def _enqueue(self, event: Event, thread: Thread, state: _Thread) -> None:
        place = thread[0], self._get(event, 'buffer'), self._get(event, 'index')
        if state.last is None:
            self._by_slot.pop(place, None)      # the publication was lost: never the older one
            return
        if self._get(event, 'overwritten'):
            before = self._by_slot.get(place)
            if before is not None and before[1]:
                self.losses.count('overwritten', before[0].topic or 'unknown topic')
        self._by_slot[place] = state.last, True

    def _dequeue(self, event: Event, thread: Thread, state: _Thread) -> None:
        place = thread[0], self._get(event, 'buffer'), self._get(event, 'index')
        found = self._by_slot.pop(place, None)
        state.take = None, None, 0, 0, None if found is None else found[0], event[1]
        if found is None and not state.fresh:
            self.losses.count('messages', 'a ring buffer')

    def _lost(self, event: Event, thread: Thread, state: _Thread) -> None:
        self.discarded += self._get(event, 'count')
        self._queue.append((event[1], self._observer.lost_sight, (None, None, event[1])))
