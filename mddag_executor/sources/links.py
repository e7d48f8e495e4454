# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Links the events of a CARET or ros2_tracing recording to executions and messages.

Theory of operation
-------------------
All events are rows of one table (``imported_events``), in the order of time.  Executions are found
by a stack for each thread; all other links are joins of columns: the last event of some kinds
before another one in the same thread.

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
   * ros2_tracing from Jazzy on: `rmw_publish`.

3. *Messages between processes*: `dispatch_subscription_callback` (Galactic, Humble) has the
   callback and the source timestamp; later formats have `rmw_take` before the `callback_start` in
   the same thread.  The publication is the one on the same topic with the same source timestamp.
4. *Messages within a process*: in Humble by the message's address, followed through copies
   (`message_construct`) to `dispatch_intra_process_subscription_callback`; from Iron on by buffer
   and index of the ring buffer (`rclcpp_ring_buffer_enqueue`, `_dequeue`).
5. `rmw_take` inside an execution: the callback itself took the message (a queue edge).
6. Events that don't match (ends without starts, starts without ends, messages without publication,
   publishers without tracepoint or initialisation) are counted by callback, topic or process.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable as Function
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from mddag_executor.recording.columns import Ints, Mask, Places, rows, Table
from mddag_executor.recording.joins import (
    as_of,
    different,
    distinct,
    equal_pairs,
    last_of,
    sort_by,
)
from mddag_executor.recording.losses import Kind, Loss
from mddag_executor.sources.entities import Addresses, Entities
from mddag_executor.sources.imported_events import (
    ADDRESSES,
    BECAME,
    BIND,
    COPY,
    DDS_WRITE,
    DEQUEUE,
    DISPATCH,
    END,
    ENQUEUE,
    Events,
    INTRA,
    LAST_KIND,
    LOST,
    RCL,
    RCLCPP,
    RMW_PUBLISH,
    START,
    TAKE,
    WITHIN,
)
from mddag_executor.text import counted, listed
import numpy as np

_DEEPEST = 32
_NONE, _SEVERAL = -1, -2      # instead of a publication
_PUBLISHES = (INTRA, RCLCPP, RCL)
_STAMPS = (DDS_WRITE, BIND, RMW_PUBLISH)
_ARRIVALS = (DISPATCH, TAKE, WITHIN, DEQUEUE)

_SAID = {
    'ends': ('execution', 'without an end in it (the event was lost)'),
    'starts': ('execution', 'without a start in it (the event was lost): left out'),
    'messages': ('execution', 'for a message whose publication is not known: of no job and no '
                 'path'),
    'partial': ('publication', 'without the tracepoint rclcpp_publish that others of the '
                'publisher have: counted from rcl_publish on'),
    'overwritten': ('message', 'overwritten in a ring buffer, never taken'),
    'unknown': ('execution', 'of a callback whose initialisation is not in it'),
    'publishers': ('publication', 'of a publisher whose initialisation is not in it, so of no '
                   'topic')}


class Oddities:
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
        if number:
            self._counts[kind][affected] += number

    def forget(self, kind: str, affected: str) -> None:
        """Do not report events of a kind that affected a callback or topic."""
        self._counts[kind].pop(affected, None)

    def found(self, name: str, kind: Kind) -> Iterator[Loss]:
        """Yield what was counted in a recording."""
        for counts, (noun, text) in zip(self._counts.values(), self._said.values()):
            if counts:
                affected = sorted(counts.items(), key=lambda each: (-each[1], each[0]))
                yield Loss(kind, counts.total(), (
                    f'{name}: {counted(counts.total(), noun)} {text}: '
                    + listed([f'{each} ({n})' for each, n in affected], self._most)))


class Lost(NamedTuple):
    """
    A sign that events are missing.

    :ivar at: the event at which they are missing; of a gap, the first one in it.
    :ivar time: the latest time of a release of jobs that may have had them.
    :ivar callback: index of the callback that ran for an unknown reason; -1: events were lost.
    :ivar run: its execution if only the end is missing; -1: none.
    """

    at: int
    callback: int
    run: int
    time: int


_RUN = np.dtype([
    ('callback', 'i8'), ('at', 'i8'), ('end_at', 'i8'), ('thread', 'i8'), ('start', 'i8'),
    ('end', 'i8'), ('ready', 'i8'), ('due', 'i8'), ('stamp', 'i8'), ('stated', 'i8'),
    ('taken', 'i8'), ('message', 'i8')])
_MESSAGE = np.dtype([
    ('at', 'i8'), ('publisher', 'i8'), ('run', 'i8'), ('time', 'i8'), ('stamp', 'i8'),
    ('message', 'i8'), ('header', 'i8'), ('within', '?')])


class Links:
    """
    The executions and messages of a recording.

    Events are named by their row in the table.

    :ivar runs: executions in the order of their starts: ``callback`` (index of ``callbacks``),
        ``at`` and ``end_at`` (events; -1: no end), ``thread``, ``start``, ``end``, ``ready`` (-1:
        not recorded), ``due`` (of a timer; 0: not recorded), ``stamp`` and ``stated`` (source and
        header stamp of its message, 0: unknown), ``taken`` (when the message was taken; 0:
        unknown), ``message`` (-1: unknown).
    :ivar messages: publications: ``at`` (event), ``publisher`` (index of ``publishers``, -1:
        unknown), ``run`` (-1: none), ``time``, ``stamp`` and ``header`` (source and header stamp,
        0: unknown), ``within`` (only within the process).
    :ivar topics: numbers of topics by name; ``topic_of``: by message the number of its topic.
    :ivar takes: executions with messages that they took themselves.
    :ivar threads: process and thread id, by index; ``is_own``: whether this executor ran it.
    :ivar shift: by thread what was added to its times, ns.
    :ivar lost: signs of missing events, in the order of time: the fields of ``Lost``.
    """

    def __init__(self, events: Events, who: Entities) -> None:
        self.events, self.who, self.losses = events.table, who, Oddities(_SAID, 3)
        self.threads, self.shift = events.threads, events.of_threads(events.shift)
        self.is_own: Mask = events.of_threads(dict.fromkeys(events.own, 1)) > 0
        self._pid = np.array([pid for pid, _ in events.threads], dtype=np.int64)
        kind = self.events['kind']
        gaps = self.events[kind == LOST]
        #: How much is lost, by cause (``schema.DISCARDED``, …; 0: not said).
        self.gaps = Counter[int]()
        for cause, count in zip(gaps['c'].tolist(), gaps['a'].tolist()):
            self.gaps[cause] += count
        self._lost = self._gaps()
        # by thread, then by time
        self._order = sort_by(self.events['thread'])
        self.callbacks, self._callback = self._objects(
            self._are(START, END, DISPATCH, WITHIN), who.callbacks, who.callback)
        self.publishers, self._publisher = self._objects(
            self._are(*_PUBLISHES) & (self.events['a'] != 0), who.publishers)
        self.taken, self._subscription = self._objects(kind == TAKE, who.taken)
        names = ['', *(each.topic for each in self.publishers)]
        self.topics = {name: number for number, name in enumerate(dict.fromkeys(names))}
        self.runs = self._runs()
        self.messages = self._publications()
        self.topic_of = self._numbers([*names[1:], ''])[self.messages['publisher']]
        nameless = self.messages['at'][self.messages['publisher'] < 0]
        for pid, number in zip(*np.unique(
                self._pid[self.events['thread'][nameless]], return_counts=True)):
            self.losses.count('publishers', f'process {pid}', int(number))
        several = self._stamp_messages()
        #: Topics and source timestamps of publications; several possible ones are there twice.
        known = np.flatnonzero(self.messages['stamp'] != 0)
        self._stamped = np.append(known, np.full(2 * len(several) + 1, _NONE))
        topic, stamp = np.concatenate([
            np.column_stack((self.topic_of, self.messages['stamp']))[known], several, several]).T
        self._pairs = topic, stamp
        self._started_by(self._arrivals())
        self._find_messages()
        self.takes = self._takes()
        self.lost = np.array(sorted(self._lost), dtype=np.int64).reshape(-1, len(Lost._fields))

    def _gaps(self) -> list[Lost]:
        """Return the gaps in which events were lost, at their begins."""
        time, begin = self.events['time'], self.events['b']
        gaps = np.flatnonzero(self.events['kind'] == LOST)
        since = np.searchsorted(time, np.where(begin[gaps] != 0, begin[gaps], time[gaps]))
        return [Lost(min(at, gap), -1, -1, now) for at, gap, now in zip(
            since.tolist(), gaps.tolist(), time[gaps].tolist())]

    def _are(self, *kinds: int) -> Mask:
        """Return which events are of some kinds."""
        asked = np.zeros(LAST_KIND + 1, dtype=np.bool_)
        asked[[*kinds]] = True
        found: Mask = asked.take(self.events['kind'])
        return found

    def _objects(
        self, events: Mask, known: Addresses[Any],
        find: Function[[int, int, int], Any] | None = None,
    ) -> tuple[list[Any], Places]:
        """Return the objects that column ``a`` of events means, and by event their index."""
        find = find or known.latest
        at = np.flatnonzero(events)
        table = self.events
        pids, process = different(self._pid)
        addresses, key = different(table['a'][at])
        if len(pids) > 1:
            key += process[table['thread'][at]] * np.int32(max(1, len(addresses)))
        #: By key its first event.
        first = np.full(len(pids) * len(addresses), -1)
        first[key[::-1]] = at[::-1]
        objects: dict[int, int] = {}
        found: list[Any] = []
        index_of = np.full(len(first), -1, dtype=np.int32)
        index = np.full(len(table), -1, dtype=np.int32)
        several: list[tuple[Ints, int]] = []
        for number in sort_by(first)[int((first < 0).sum()):].tolist():
            place, which = divmod(number, len(addresses))
            where = int(pids[place]), int(addresses[which]) % ADDRESSES
            since = np.array(known.times(*where), dtype=np.int64)
            mine, pieces = at[:0], [0]
            if len(since) > 1:      # the address was used again
                mine = at[key == number]
                piece = np.maximum(0, as_of(since, table['time'][mine]))
                pieces = distinct(piece).tolist()
            for each in pieces:
                thing = find(*where, int(
                    since[each] if len(since) else table['time'][first[number]]))
                if thing is None:
                    continue
                if id(thing) not in objects:
                    objects[id(thing)] = len(found)
                    found.append(thing)
                if len(since) > 1:
                    several.append((mine[piece == each], objects[id(thing)]))
                else:
                    index_of[number] = objects[id(thing)]
        index[at] = index_of[key]
        for mine, each in several:
            index[mine] = each
        return found, index

    def _last(self, of: Mask, before: Mask) -> Ints:
        """
        Return for each event of ``before`` the last one of ``of`` before it in its thread; or -1.

        The result is in the order of the events.
        """
        asked = (of | before)[self._order]
        order = self._order[asked]
        latest = last_of(of[order], self.events['thread'][order], before=True)
        found = np.full(len(asked), -1)
        found[order] = np.where(latest >= 0, order[latest], -1)
        return found[before]

    # --- executions ------------------------------------------------------------------------------

    def _runs(self) -> Table:
        """Return the executions (rule 1)."""
        table = self.events
        begin, end_at = self._stack()
        runs = rows(_RUN, len(begin))
        runs['callback'], runs['at'], runs['end_at'] = self._callback[begin], begin, end_at
        runs['thread'], runs['start'] = table['thread'][begin], table['time'][begin]
        runs['end'] = np.where(end_at >= 0, table['time'][end_at], -1)
        runs['ready'] = runs['message'] = -1
        for callback, times in zip(self.callbacks, np.bincount(
                runs['callback'], minlength=len(self.callbacks)).tolist()):
            if times and callback.kind == 'unknown':
                self.losses.count('unknown', callback.label, times)
        return runs

    def _stack(self) -> tuple[Ints, Ints]:
        """Return the first and last event of executions."""
        table, kind = self.events, self.events['kind']
        is_start = kind == START
        begin = np.flatnonzero(is_start)
        run = np.cumsum(is_start, dtype=np.int32) - np.int32(1)     # the last one that began
        end_at = np.full(len(begin), -1)
        #: By event of a start or end the execution that runs after it in the thread, or -1.
        self._top = np.full(len(table), -1, dtype=np.int32)
        # in most threads each start is followed by the end of the same callback
        at = self._order[(kind <= END)[self._order]]
        thread, number, starts = (each[at] for each in (table['thread'], self._callback, is_start))
        follows = np.append(False, (thread[1:] == thread[:-1]) & starts[:-1])[:len(at)]   # a start
        fits = np.where(starts, ~follows, follows & np.append(
            False, number[1:] == number[:-1])[:len(at)])
        simple = np.ones(len(self._pid), dtype=np.bool_)
        simple[thread[~fits]] = False
        is_simple = simple[thread]
        ends = np.flatnonzero(~starts & is_simple)
        end_at[run[at[ends - 1]]] = at[ends]
        begins = at[starts & is_simple]
        self._top[begins] = run[begins]
        others = at[~is_simple]
        self._nest(others, run[others], end_at)
        return begin, end_at

    def _nest(self, at: Ints, runs: Ints, end_at: Ints) -> None:
        """
        Find the ends of executions in threads with nested executions, or with events missing.

        Most starts are followed by their ends.  Rows of such pairs change nothing for what runs
        around them, unless that is one of the same callbacks.

        :param at: starts and ends, by thread; ``runs``: of each the last execution that started.
        """
        table = self.events
        thread, kind, number, time = (each[at] for each in (
            table['thread'], table['kind'], self._callback, table['time']))
        starts, same = kind == START, thread[1:] == thread[:-1]
        begins_pair = np.append(
            same & starts[:-1] & ~starts[1:] & (number[1:] == number[:-1]), False)[:len(at)]
        ends_pair = np.append(False, begins_pair[:-1])[:len(at)]
        end_at[runs[begins_pair]] = at[ends_pair]
        top = np.where(begins_pair, runs, -1)
        in_pair = begins_pair | ends_pair
        borders = 1 + np.flatnonzero(~same | (in_pair[1:] != in_pair[:-1]))
        stacks: dict[int, list[int]] = {}
        callback: dict[int, int] = {}
        inner: dict[int, int] = {}      # last start of a nested execution
        for begin, end in zip([0, *borders.tolist()], [*borders.tolist(), len(at)]):
            part = slice(begin, end)
            if begin < end and in_pair[begin]:
                stack = stacks.setdefault(int(thread[begin]), [])
                if len(stack) <= _DEEPEST and not any(
                        (number[part] == callback[run]).any() for run in stack):
                    if stack:
                        inner[stack[-1]] = int(time[part][starts[part]][-1])
                        top[part][ends_pair[part]] = stack[-1]
                    continue
            top[part] = list(self._follow(
                zip(*(each[part].tolist() for each in (at, thread, kind, number, time, runs))),
                stacks, callback, inner, end_at))
        self._top[at] = top
        for stack in stacks.values():
            for run in stack:
                if run in inner:
                    self._without_end(len(table), callback[run], run, inner[run])

    def _follow(
        self, events: Iterable[tuple[int, ...]], stacks: dict[int, list[int]],
        callback: dict[int, int], inner: dict[int, int], end_at: Ints,
    ) -> Iterator[int]:
        """
        Follow starts and ends one by one; yield the execution that runs after each, or -1.

        :param events: event, thread, kind, callback, time, last execution that started.
        :param stacks: by thread what runs; ``callback``: by execution its callback; ``inner``: the
            last start of an execution in it.
        """
        for here, thread, kind, number, now, new in events:
            fresh = thread not in stacks
            stack = stacks.setdefault(thread, [])
            known = any(callback[run] == number for run in stack)
            if kind == START:
                if known or len(stack) > _DEEPEST:
                    while stack:
                        run = stack.pop()
                        self._without_end(here, callback[run], run, now)
                        if callback[run] == number:
                            break
                if stack:
                    inner[stack[-1]] = now
                stack.append(new)
                callback[new] = number
            elif known:
                while callback[run := stack.pop()] != number:
                    self._without_end(here, callback[run], run, now)
                end_at[run] = here
            elif not fresh or self.callbacks[number].made >= self.who.begin:
                # otherwise it began before the recording
                self.losses.count('starts', self.callbacks[number].label)
                self._lost.append(Lost(here, number, -1, now))
            yield stack[-1] if stack else -1

    def _without_end(self, at: int, callback: int, run: int, now: int) -> None:
        self.losses.count('ends', self.callbacks[callback].label)
        self._lost.append(Lost(at, callback, run, now))

    def _running(self, events: Mask) -> Ints:
        """Return the executions that run at events, or -1."""
        last = self._last(self.events['kind'] <= END, events)
        found: Ints = np.where(last >= 0, self._top[np.maximum(last, 0)], -1)
        return found

    # --- publications ----------------------------------------------------------------------------

    def _publications(self) -> Table:
        """Return the publications (rule 2), without their source timestamps."""
        table, kinds = self.events, self.events['kind']
        publishes = self._are(*_PUBLISHES)
        at = np.flatnonzero(publishes)
        kind, handle, message = (table[name][at] for name in ('kind', 'a', 'b'))
        publisher = self._publisher[at]
        #: By event of a publication: its row, or -1.
        self._row = np.full(len(table), -1, dtype=np.int32)
        self._row[at] = np.arange(len(at))
        previous = np.full(len(at), -1) if (kind == RCLCPP).all() else self._last(
            publishes | (kinds <= END), publishes)
        before = np.where(previous >= 0, self._row[previous], -1)   # -1: a start or end
        after = np.maximum(before, 0)
        after_intra = (kind == RCLCPP) & (before >= 0) & (kind[after] == INTRA) & (
            (handle == 0) | (publisher == publisher[after]))
        # the publisher so far
        so_far = np.where(after_intra, publisher[after], publisher)
        after_rclcpp = (kind == RCL) & (before >= 0) & (kind[after] == RCLCPP) & (
            (so_far[after] < 0) | (so_far[after] == publisher))
        begins = ~(after_intra | after_rclcpp)
        row = np.cumsum(begins) - 1
        for again in (after_intra, after_rclcpp):
            row[again] = row[after[again]]
        self._row[at] = row
        found = rows(_MESSAGE, int(begins.sum()))
        found['at'], found['publisher'], found['message'] = (
            each[begins] for each in (at, so_far, message))
        found['time'], found['within'] = table['time'][found['at']], kind[begins] == INTRA
        rclcpp = kind == RCLCPP
        found['header'][row[rclcpp]] = table['c'][at[rclcpp]]
        found['run'] = self._running(publishes)[begins]
        found['within'][row[after_intra]] = False
        for again in (after_intra, after_rclcpp):
            found['message'][row[again]] = message[again]
        found['publisher'][row[after_rclcpp]] = publisher[after_rclcpp]
        self._count_partial(found['publisher'][kind[begins] == RCL], publisher[after_rclcpp])
        return found

    def _count_partial(self, only_rcl: Ints, by_both: Ints) -> None:
        numbers, counts = np.unique(
            only_rcl[np.isin(only_rcl, by_both[by_both >= 0])], return_counts=True)
        for number, count in zip(numbers.tolist(), counts.tolist()):
            self.losses.count('partial', self.publishers[number].topic, count)

    def _numbers(self, topics: Iterable[str]) -> Ints:
        """Return the numbers of topics; ``len(self.topics)``: without publisher."""
        return np.array([self.topics.get(topic, len(self.topics)) for topic in topics],
                        dtype=np.int64)

    def _stamp_messages(self) -> Ints:
        """
        Find the source timestamps of publications.

        :return: pairs of topic and source timestamp of several possible publications; here none.
        """
        table, found = self.events, self.messages
        about = self._are(*_STAMPS, BECAME)
        before = self._are(*_PUBLISHES, START, END)
        at = np.flatnonzero(about)
        kind, a, stamp = (table[name][at] for name in ('kind', 'a', 'b'))
        # the last event of a publication, unless a callback began or ended after it
        last = self._last(before, about)
        of, message = (table[name][np.maximum(last, 0)] for name in ('kind', 'b'))
        known = (last >= 0) & (of > END)
        became = known & (kind == BECAME) & (a == message)
        form = np.zeros(len(at), dtype=np.int64)
        if became.any():
            becomes = np.zeros(len(table), dtype=np.bool_)
            becomes[at[became]] = True
            newest = self._last(before | becomes, about)
            has_form = (newest >= 0) & becomes[np.maximum(newest, 0)]
            form[has_form] = table['b'][newest[has_form]]
        good = np.isin(kind, _STAMPS) & known & (of != INTRA) & (stamp != 0) & (
            (of != RCL) | (a == 0) | (a == message) | (a == form))
        mine = np.flatnonzero(good)[::-1]     # the first one is assigned last
        found['stamp'][self._row[last[mine]]] = stamp[mine]
        return np.empty((0, 2), dtype=np.int64)

    def _find(self, topic: Ints, stamp: Ints) -> Ints:
        """Return the publications of source timestamps; ``_NONE`` or ``_SEVERAL`` without one."""
        which, count = equal_pairs(self._pairs, (topic, stamp))
        found: Ints = np.where(count > 1, _SEVERAL, self._stamped[which])
        rest = np.flatnonzero(count != 1)
        unnamed, count = equal_pairs(self._pairs, (np.zeros_like(rest), stamp[rest]))
        found[rest[count == 1]] = self._stamped[unnamed[count == 1]]
        return found

    # --- messages that arrive --------------------------------------------------------------------

    def _arrivals(self) -> Ints:
        """Return by execution the event that says which message it processes, or -1."""
        kind = self.events['kind']
        arrives = self._are(*_ARRIVALS)
        taken = (kind == TAKE) & (self.events['c'] != 0) & (self.events['b'] != 0)
        arrives &= (kind != TAKE) | taken
        starts = kind == START
        last = self._last(arrives | starts, starts)
        found: Ints = np.where((last >= 0) & arrives[np.maximum(last, 0)], last, -1)
        return found

    def _takes(self) -> tuple[Ints, Ints]:
        """Return executions, and the messages that they took themselves (rule 5)."""
        table = self.events
        takes = (table['kind'] == TAKE) & (table['c'] != 0) & (self._subscription >= 0)
        runs = self._running(takes)
        at, runs = np.flatnonzero(takes)[runs >= 0], runs[runs >= 0]
        topic = self._numbers(each[0].start for each in self.taken)[self._subscription[at]]
        found = self._find(topic, table['b'][at])
        return runs[found >= 0], found[found >= 0]

    def _started_by(self, arrived: Ints) -> None:
        """Find the message of each execution."""
        within = self._within()
        table, runs = self.events, self.runs
        rows = np.flatnonzero(arrived >= 0)
        at, number = arrived[rows], runs['callback'][rows]
        kind = table['kind'][at]
        plain = np.array([each.kind not in ('timer', 'service') for each in self.callbacks], bool)
        # otherwise the message belongs to another execution
        fits = plain[number] & np.where(
            kind == TAKE, self._may_take(at, number),
            (kind == DEQUEUE) | (self._callback[at] == number))
        rows, at, kind = rows[fits], at[fits], kind[fits]
        runs['taken'][rows] = table['time'][at]
        by_stamp = np.isin(kind, (DISPATCH, TAKE))
        runs['stamp'][rows[by_stamp]] = table['b'][at[by_stamp]]
        stated = kind == DISPATCH
        runs['stated'][rows[stated]] = table['c'][at[stated]]
        runs['message'][rows[~by_stamp]] = [within.get(e, -1) for e in at[~by_stamp].tolist()]

    def _may_take(self, at: Ints, callback: Ints) -> Mask:
        """Return whether callbacks are those of the subscriptions of `rmw_take` events."""
        subscription = self._subscription[at].astype(np.int64)
        pairs, which = different(subscription * len(self.callbacks) + callback)
        fits = [number < 0 or self.callbacks[each] in self.taken[number] for number, each in (
            divmod(pair, len(self.callbacks)) for pair in pairs.tolist())]
        return np.array(fits, dtype=np.bool_)[which]

    def _find_messages(self) -> None:
        """Find messages by their source timestamps; count executions without one."""
        rows = np.flatnonzero(self.runs['message'] < 0)
        runs = self.runs[['at', 'callback', 'start', 'stamp', 'taken']][rows]
        number, stamped = runs['callback'], runs['stamp'] != 0
        message = np.full(len(rows), _NONE)
        topic = self._numbers(each.start for each in self.callbacks)[number[stamped]]
        message[stamped] = self._find(topic, runs['stamp'][stamped])
        self.runs['message'][rows] = np.maximum(message, -1)
        several = message == _SEVERAL
        subscribes = np.array([each.kind == 'subscription' for each in self.callbacks], bool)
        missing = (stamped & (message < 0)) | (
            ~stamped & (runs['taken'] == 0) & subscribes[number])
        for each, n in zip(*(c.tolist() for c in np.unique(number[missing], return_counts=True))):
            self.losses.count('messages', self.callbacks[each].label, n)
        self._lost += [Lost(at, callback, -1, start) for at, callback, start in zip(*(
            runs[name][several].tolist() for name in ('at', 'callback', 'start')))]

    def _within(self) -> dict[int, int]:
        """Return the message by event that dispatches or dequeues it in its process (rule 4)."""
        table = self.events
        kind = table['kind']
        at = np.flatnonzero(self._are(INTRA, COPY, WITHIN, ENQUEUE, DEQUEUE))
        found: dict[int, int] = {}
        if not len(at):
            return found
        enqueues = kind == ENQUEUE
        last = np.full(len(table), -1)
        last[enqueues] = self._last(self._are(*_PUBLISHES, START, END), enqueues)
        started = self._last(kind <= END, kind == DEQUEUE)
        fresh = dict(zip(np.flatnonzero(kind == DEQUEUE).tolist(), (started < 0).tolist()))
        by_address: dict[tuple[int, int], int] = {}
        by_slot: dict[tuple[int, int, int], int] = {}
        for here, thread in zip(at.tolist(), table['thread'][at].tolist()):
            pid, (_, _, _, what, a, b, c, _) = self._pid[thread], table[here].item()
            if what == INTRA:
                by_address[pid, b] = int(self._row[here])
            elif what == COPY:
                if (pid, a) in by_address:
                    by_address[pid, b] = by_address[pid, a]
            elif what == WITHIN:
                if (pid, b) in by_address:
                    found[here] = by_address[pid, b]
                else:
                    self.losses.count('messages', self.callbacks[self._callback[here]].label)
            elif what == ENQUEUE:
                before = by_slot.pop((pid, a, b), -1)
                if c and before >= 0 and last[here] >= 0 and kind[last[here]] > END:
                    publisher = self.messages['publisher'][before]
                    self.losses.count('overwritten', self.publishers[publisher].topic
                                      if publisher >= 0 else 'unknown topic')
                if last[here] >= 0 and kind[last[here]] > END:
                    by_slot[pid, a, b] = int(self._row[last[here]])
            elif (pid, a, b) in by_slot:
                found[here] = by_slot.pop((pid, a, b))
            elif not fresh[here]:
                self.losses.count('messages', 'a ring buffer')
        return found
