# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Links the events of a CARET or ros2_tracing recording to executions and messages.

Theory of operation
-------------------
Events are processed in two stages, each in the order of time.  The first tracks each thread.  The
second calls the observer `LAG_NS` of recorded time later: a subscriber may run before the tracer
has recorded the source timestamp of its message.

1. *Executions* last from `callback_start` to the next `callback_end` of the same callback in the
   same thread (CARET: the same address; this differs only if a callback runs in several threads at
   once).  Callbacks may nest (one spins).  If the outer one ends first, an end was lost.
2. *Publications*, within a thread: `rclcpp_publish`, then `rcl_publish` of the same publisher (the
   only event of rclpy; from Iron on the only one with the publisher's handle), then the
   middleware's write and the source timestamp.  `rclcpp_intra_publish` before `rclcpp_publish` of
   the same publisher is the same publication, at its own time.  Sources of the source timestamp:

   * CARET, Cyclone DDS: `dds_write`, then `dds_bind_addr_to_stamp` of the message's address,
   * CARET, Fast DDS up to Galactic: `dds_write`, `dds_bind_addr_to_addr` from the message to
     its serialised form, then `dds_bind_addr_to_stamp` of that form,
   * CARET, Fast DDS from Humble on: `dds_bind_addr_to_stamp` of address 0, which means the
     thread's last publication,
   * CARET from Jazzy on: `dds_write`,
   * ros2_tracing from Jazzy on: `rmw_publish`; before, with an instrumented Cyclone DDS:
     `dds:write_pre` of the message's address, then `dds:write`.

   Until September 2021 CARET's events were named `ros2_hook`, with other names of some fields.
3. *Messages between processes*: `dispatch_subscription_callback` (Galactic, Humble) has the
   callback and the source timestamp; later formats have `rmw_take` before the `callback_start` in
   the same thread.  In August 2021 `dispatch` had the callback and the message's address, and
   `take_type_erased`, before it in the same thread, the address and the source timestamp.  The
   publication is the one on the same topic with the same source timestamp.
4. *Messages within a process*: in Humble by the message's address, followed through copies
   (`message_construct`) to `dispatch_intra_process_subscription_callback` (August 2021:
   `dispatch_intra_process`); from Iron on by buffer and index of the ring buffer
   (`rclcpp_ring_buffer_enqueue`, `_dequeue`).
5. `rmw_take` inside an execution: the callback itself took the message (a queue edge).
6. Events that don't match (ends without starts, starts without ends, messages without publication,
   publishers without tracepoint) are counted by callback or topic.  The observer is notified if
   the cause of an execution is unknown.

Of each topic the `KEEP` newest publications are kept.
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
    :ivar end: -1 while it runs, or if its end was lost.
    :ivar stamp: source timestamp of the message that started it; 0: unknown.
    :ivar stated: header stamp of the message; 0: not recorded.
    :ivar taken: when the message was taken, ns; 0: not recorded.
    :ivar inner: last start of another execution nested in this one, ns; 0: none.
    :ivar ready: set by observers: when it became ready, ns.
    :ivar of: set by observers: its DAG, vertex and job.
    :ivar leg: set by observers: its leg of the vertex.
    :ivar number: set by observers: its number.
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
    A published message; times in ns, 0: not recorded.

    :ivar run: the execution that published it; None: none.
    :ivar message: address of the message; `written`: address of its serialised form.
    :ivar number: set by observers: its number.
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
        """Return the time of the publication."""
        return self.rclcpp or self.rcl

    @property
    def topic(self) -> str:
        """Return the topic; empty if unknown."""
        return self.publisher.topic if self.publisher is not None else ''


class LinkObserver:
    """Base of observers: receives executions and messages in the order of time."""

    def began(self, run: Execution, message: Publication | None) -> None:
        """Note the begin of an execution, and the message that started it."""

    def sent(self, message: Publication) -> None:
        """Note that a message was published."""

    def took(self, run: Execution, message: Publication) -> None:
        """Note that a running callback took a message itself."""

    def over(self, run: Execution) -> None:
        """Note that an execution has ended."""

    def lost_sight(self, callback: Callback | None, run: Execution | None, time: int) -> None:
        """
        Note that events are missing.

        :param callback: the callback that ran for an unknown reason; None: events were discarded.
        :param run: its execution, if only the end is missing.
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
    Counts missing or odd events, by what they affect.

    :param said: by kind a noun, and the text for a number of them.
    :param most: how many of the affected callbacks or topics are named.
    """

    def __init__(self, said: Mapping[str, tuple[str, str]], most: int) -> None:
        self._said, self._most = said, most
        self._counts: dict[str, Counter[str]] = {kind: Counter() for kind in said}

    def count(self, kind: str, affected: str, number: int = 1) -> None:
        """Count events of a kind."""
        self._counts[kind][affected] += number

    def lines(self) -> list[str]:
        """Return the counts as text."""
        return [
            f'{counted(sum(counts.values()), noun)} {text}: '
            + listed([f'{name} ({n})' for name, n in counts.most_common()], self._most)
            for counts, (noun, text) in zip(self._counts.values(), self._said.values()) if counts]


class _Thread:
    """The state of a thread."""

    __slots__ = ('stack', 'last', 'take', 'erased', 'fresh')

    def __init__(self) -> None:
        self.stack: list[Execution] = []
        self.last: Publication | None = None
        # (named callback or None, callbacks of the subscription or None, stamp, stated, message,
        # time)
        self.take: tuple[Callback | None, list[Callback] | None, int, int, Publication | None,
                         int] | None = None
        # from `take_type_erased`: address of the message, stamp, time; zeros: none
        self.erased = 0, 0, 0
        self.fresh = True       # no execution has started yet


class Linker:
    """Links the events of a recording."""

    def __init__(self, entities: Entities, observer: LinkObserver) -> None:
        self.losses = Losses(_SAID, 3)
        #: Number of events that the tracer discarded, as it reports.
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
        self._by_rcl: Counter[Publisher] = Counter()        # publications by rcl only
        # by id of a layout; the layout is kept so that its id is not reused
        self._known: dict[int, tuple[Layout, Handler, dict[str, int]]] = {}
        self._fields: dict[str, int] = {}       # fields of the current event
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
        #: Full names of the events that the linker needs.
        self.events = frozenset(self._handlers)

    def take(self, event: Event) -> None:
        """Link an event of ``TraceReader.layout_events``; times never decrease."""
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
        """Process the remaining events; the last running executions of threads have no end."""
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
        """Return the running executions."""
        return [run for state in self._threads.values() for run in state.stack]

    def _get(self, event: Event, field: str) -> int:
        """Return a field of an event; 0 if it is missing."""
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
                # the message belongs to another execution
                run.stamp = run.stated = run.taken = 0
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
            # otherwise it began before the recording
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
            last.within = False     # the same publication, now to other processes
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
            state.last = None       # the following stamp belongs to another publication

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
        """Note the publication of a source timestamp; None: ambiguous."""
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
        if address == self._get(event, 'message'):      # otherwise its `take_type_erased` was lost
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
            self._by_slot.pop(place, None)      # the publication was lost: don't use the older one
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
