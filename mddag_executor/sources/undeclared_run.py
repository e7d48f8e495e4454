# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A trace of this executor without declaration, judged by a declaration that is given later.

Theory of operation
-------------------
Such a trace names no jobs, so jobs are made as for imported recordings (``imported_run``), from
the causes of executions.  Differences:

1. *Messages to executions.*  ``rmw_take`` is recorded when any thread takes a message;
   ``dispatch`` has the ready time, which is right after it.  So an execution belongs to the last
   message that its subscription took until then.
2. *Publications to messages.*  A publication is recorded just before sending; its source timestamp
   is not recorded.  A timestamp belongs to a publication of its topic that was being sent then: it
   had begun, and its thread had neither published again nor ended its callback.  If several
   publications fit, the number of the message decides (``stamps``).  If the system clock was set
   during the run, the timestamps are moved back to the clock of the trace (``_without_steps``).
3. *Ready* is recorded, and so is the due time of a timer, which is its release.  Version 2 did
   not record the due time.  In its traces a timer's release is the last time on its period's grid,
   whose origin is found as follows.  When a timer was noticed, the periods that had passed were
   skipped.  So a due time lies between two successive moments at which it was noticed, which
   excludes an origin if they are closer than a period.  Of the origins that (nearly) no moment
   excludes, that of the least total lateness is chosen.  If every origin is excluded, or none is
   and few releases were noticed soon, the timer kept no grid: a release is the time at which it
   was noticed.
   If the next due time is more than a period later, the due times in between up to the start of
   the execution were skipped, as in a run with a declaration: the timer could not wait a second
   time.  Those after the last execution of a timer are not known: it may have been cancelled.
4. The pieces of a coroutine became ready at the same time.  They are one execution, which
   completes at the end of the last piece.
5. ``dispatch`` is recorded when the execution has ended, with its CPU time and whether its
   callback holds the interpreter.  Version 2 did not record that.
6. The start of an execution is recorded when it ends.  That of one that has not ended is in
   ``unfinished``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from mddag_executor.core.tables import MOST_SKIPPED
from mddag_executor.recording.columns import concatenate, Ints, Mask, rows, Table
from mddag_executor.recording.joins import as_of, distinct, rows_by, sort_by
from mddag_executor.recording.losses import Loss
from mddag_executor.recording.recording import Recording
from mddag_executor.recording.tables import DROPS, LOSSES, NOTHING, SPIN_GAPS, UNKNOWN
from mddag_executor.sources.entities import Entities, INIT_EVENTS, signed
from mddag_executor.sources.executions import number_pieces
from mddag_executor.sources.head import no_end, steps
from mddag_executor.sources.imported_events import (
    computed,
    DISPATCH,
    END,
    Events,
    OWN_KINDS,
    RCLCPP,
    SHUTDOWN,
    START,
    TAKE,
)
from mddag_executor.sources.imported_jobs import ImportedJobs, SKIPPED
from mddag_executor.sources.imported_run import ImportedRun, OFF_THE_GRID
from mddag_executor.sources.links import Links
from mddag_executor.sources.progress import Progress
from mddag_executor.sources.stamps import find_stamps, Sent
from mddag_executor.trace.times import NEVER
import numpy as np

_DROP, _MESSAGES_LOST, _UNFINISHED, CLOCK_STEP, _SPIN_GAP = (
    'mddag:drop', 'mddag:messages_lost', 'mddag:unfinished', 'mddag:clock_step',
    'mddag:spin_gap')
# A timer is noticed shortly after its release within both: a time, and a part of its period.
_SOON_NS, _SOON_PART = 1_000_000, 10
# One in this many releases may exclude the origin of the grid, and one has to exclude others.
_ONE_OF = 20
# A step of the system clock is noticed within this time.
_NOTICED_NS = 100_000_000
# Due times are on the grid if they differ from it by at most this part of the period.
_A_LITTLE = 100


class OwnLinks(Links):
    """
    The executions and messages of this executor (rules 1 and 2); those of others as in ``Links``.

    :ivar own_runs: by execution whether this executor ran it.
    """

    def __init__(self, events: Events, who: Entities) -> None:
        #: The steps of the system clock: time and process, and by how much forward, ns.
        self._steps = sorted(
            (event[1], event[2], event[4]) for event in events.others
            if event[0].name == CLOCK_STEP and isinstance(event[4], int))
        super().__init__(events, who)

    def _stamp_messages(self) -> Ints:
        """Find the source timestamps of publications (rule 2)."""
        everything = self.is_own.all()
        others = super()._stamp_messages() if not everything else np.empty((0, 2), dtype=np.int64)
        table, found = self.events, self.messages
        kind = table['kind']
        # a publication is being sent until the next one, or until the callback ends
        ends = np.full(len(found), NEVER)
        at = self._order[self._are(RCLCPP, START, END)[self._order]]
        thread, row = table['thread'][at], self._row[at]
        followed = np.flatnonzero((row[:-1] >= 0) & (thread[1:] == thread[:-1]))
        ends[row[followed]] = table['time'][at[followed + 1]]
        begins = found['time']
        if self.shift.any():    # the middleware stamps by the clock of the system
            shift = self.shift[table['thread'][found['at']]]
            begins = begins - shift
            ends[ends < NEVER] -= shift[ends < NEVER]
        takes, topics = self._stamped_takes()
        # several subscriptions may take a message: its first take counts
        order = sort_by(topics, table['b'][takes])
        stamps = table['b'][takes[order]]
        new = np.append(True, (np.diff(topics[order]) != 0) | (np.diff(stamps) != 0))[:len(takes)]
        first = np.sort(order[new])
        takes, topics = takes[first], topics[first]
        numbers = np.where(kind[takes] == TAKE, table['d'][takes], 0)
        sent_at = self._without_steps(takes)
        is_own = self.is_own[table['thread'][found['at']]]
        several: list[tuple[int, int]] = []
        for topic, (mine, asked) in enumerate(zip(*(
                rows_by(each, len(self.topics) + 1) for each in (self.topic_of, topics)))):
            if not everything:      # publications of others have recorded their timestamps
                known = found['stamp'][mine[~is_own[mine]]]
                mine = mine[is_own[mine]]
                mine = mine[sort_by(begins[mine])]
                asked = asked[~np.isin(table['b'][takes[asked]], known)]
            stamps, doubtful = find_stamps(
                Sent(begins[mine], ends[mine], found['publisher'][mine]),
                sent_at[asked], numbers[asked])
            if self._steps:
                stated = dict(zip(sent_at[asked].tolist(), table['b'][takes[asked]].tolist()))
                stamps = np.array([stated.get(each, 0) for each in stamps.tolist()])
                doubtful = [stated[each] for each in doubtful]
            found['stamp'][mine] = stamps
            several += [(topic, stamp) for stamp in doubtful]
        return np.concatenate([
            others, np.array(several, dtype=np.int64).reshape(-1, 2)])

    def _without_steps(self, takes: Ints) -> Ints:
        """
        Return the source timestamps of taken messages by the clock of the trace (rule 2).

        A message was sent after a step of the clock if its timestamp without the step is not
        earlier than the step, nor later than when it was taken.  This holds on one machine only:
        the messages of another one have its clock.
        """
        table = self.events
        stamps, taken_at = table['b'][takes], table['time'][takes]
        pid = self._pid[table['thread'][takes]]
        shift = dict(zip(self._pid.tolist(), self.shift.tolist()))
        moved_by: dict[int, int] = {}
        found = stamps
        for time, of, step in self._steps if len({*shift.values()}) < 2 else ():
            moved_by[of] = moved_by.get(of, 0) + step
            sent = stamps - moved_by[of]
            moved = shift.get(of, 0)
            after = (pid == of) & (sent >= time - moved - _NOTICED_NS) & (sent <= taken_at - moved)
            found = np.where(after, sent, found)
        return found

    def _stamped_takes(self) -> tuple[Ints, Ints]:
        """Return the events that say which messages were taken, and the topics of each."""
        kind = self.events['kind']
        takes = np.flatnonzero((kind == TAKE) & (self._subscription >= 0))
        topics = self._numbers(each[0].start for each in self.taken)[self._subscription[takes]]
        dispatched = np.flatnonzero((kind == DISPATCH) & (self.events['b'] != 0))
        if not len(dispatched):
            return takes, topics
        found = np.concatenate([takes, dispatched])
        order = sort_by(found)
        return found[order], np.concatenate([topics, self._numbers(
            each.start for each in self.callbacks)[self._callback[dispatched]]])[order]

    def _takes(self) -> tuple[Ints, Ints]:
        """Return what executions of others took themselves; this executor takes in any thread."""
        if self.is_own.all():
            none = np.empty(0, dtype=np.int64)
            return none, none
        runs, messages = super()._takes()
        others = ~self.own_runs[runs]
        return runs[others], messages[others]

    def _arrivals(self) -> Ints:
        """Find the taken message of each execution (rule 1)."""
        table = self.events
        runs, time = self.runs, table['time']
        self.own_runs: Mask = self.is_own[runs['thread']]
        own = np.flatnonzero(self.own_runs)
        taken_at = np.full(len(runs), -1)
        if len(own) < len(runs):
            taken_at = np.where(self.own_runs, -1, super()._arrivals())
        began, start = runs['at'][own], runs['start'][own]
        ready, due = np.full(len(runs), -1), np.zeros(len(runs), dtype=np.int64)
        ready[own], due[own] = table['b'][began], table['c'][began]
        taken = np.flatnonzero(table['kind'] == TAKE)
        takes_by = rows_by(self._subscription[taken], len(self.taken))
        runs_by = rows_by(runs['callback'][own], len(self.callbacks))
        subscriptions: dict[int, list[int]] = {}
        for number, callbacks in enumerate(self.taken):
            for one in {id(callback) for callback in callbacks}:
                subscriptions.setdefault(one, []).append(number)
        for callback, these in zip(self.callbacks, runs_by):
            if id(callback) not in subscriptions:
                continue
            mine = np.concatenate([taken[takes_by[each]] for each in subscriptions[id(callback)]])
            mine.sort(kind='stable')
            these = own[these]
            place = as_of(time[mine], ready[these])
            these, place = these[place >= 0], place[place >= 0]
            if not (place[1:] > place[:-1]).all():
                # a message starts one execution; its pieces have the same ready time
                _, first, which = np.unique(place, return_index=True, return_inverse=True)
                same = ready[these] == ready[these[first[which]]]
                these, place = these[same], place[same]
            taken_at[these] = mine[place]
        runs['ready'][own] = np.clip(ready[own], 0, start)
        due = np.where((due > 0) & (due <= runs['ready']), due, 0)
        is_timer = np.array([each.kind == 'timer' for each in self.callbacks], dtype=np.bool_)[
            runs['callback']]
        runs['due'] = np.where(is_timer, due, 0)
        runs['stated'] = np.where(is_timer, 0, due)     # a header stamp
        return taken_at


class UndeclaredRun(ImportedRun):
    """A run of this executor that was recorded without a declaration."""

    kinds = OWN_KINDS
    others = (*INIT_EVENTS, _DROP, _MESSAGES_LOST, _UNFINISHED, CLOCK_STEP, _SPIN_GAP)
    links_type: type[OwnLinks] = OwnLinks
    links: OwnLinks
    lost = '{} lost while recording', 'event'
    odd = {**OFF_THE_GRID, 'off': (
        'execution', 'of timers whose due times are not recorded and that kept to no period '
        '(reset, or by another clock): released when they were noticed'), 'skipped': (
        'release', 'of undeclared timers skipped, as the one before began later than they were '
        'due')}

    def _read(self, progress: Progress | None) -> Events:
        events = super()._read(progress)
        return events._replace(own=frozenset([
            *(pid for pid, _ in events.threads), *(event[2] for event in events.others)]))

    def _with_unfinished(self, events: Events) -> Events:
        """Add the starts of executions that have not ended (rule 6)."""
        found: dict[tuple[int, int, int], tuple[int, int, str]] = {}
        #: By thread, address and start of an unfinished execution: ready, worker, where it was.
        self._found = found
        several = []
        for layout, _, pid, tid, *values in events.others:
            fields = dict(zip(layout.fields, values))
            if layout.name == _UNFINISHED and 0 < fields.get('start', 0) < NEVER:
                several.append((pid, tid, fields))
        if not several:
            return events
        table = events.table
        addresses = np.array([signed(fields.get('callback', 0)) for _, _, fields in several])
        starts = table[(table['kind'] == START) & np.isin(table['a'], addresses)]
        begun = set(starts[['thread', 'a', 'time']].tolist())
        resumed = {(callback, ready): time for time, callback, ready in starts[
            ['time', 'a', 'b']].tolist()}   # by callback and ready time the last dispatch
        threads = {each: number for number, each in enumerate(events.threads)}
        for (pid, tid, fields), address in zip(several, addresses.tolist()):
            thread = threads.setdefault((pid, tid), len(threads))
            key = thread, address, fields['start']
            if key not in begun and (tid or resumed.get(
                    (address, fields.get('ready', 0)), 0) < fields['start']):
                found[key] = (fields.get('ready', 0), fields.get('worker', UNKNOWN),
                              str(fields.get('where', '')))
        table = concatenate([table, *(
            rows(table.dtype, 1, time=start, place=0, thread=thread, kind=START, a=callback,
                 b=ready)
            for (thread, callback, start), (ready, *_) in found.items())])
        return events._replace(
            table=table[sort_by(table['time'], table['place'])], threads=[*threads])

    def _last_times(self) -> Iterator[int]:
        yield from super()._last_times()
        yield from (event[1] for event in self._events.others if event[0].name == _UNFINISHED)

    def _unfinished(self, mine: Ints) -> list[tuple[int, int, str]]:
        runs, table = self.links.runs, self._events.table
        start = runs['start'][mine] - self._moved[runs['thread'][mine]]
        keys = zip(runs['thread'][mine].tolist(), table['a'][runs['at'][mine]].tolist(),
                   start.tolist())
        return [self._found.get(key, (0, UNKNOWN, '')) for key in keys]

    @property
    def _moved(self) -> Ints:
        """Return by thread what was added to its times after they were read, ns."""
        return self._events.of_threads(self._clocks.shift)

    def _have_workers(self, mine: Ints) -> list[bool]:
        own = self.links.own_runs[mine].tolist()
        return [worker >= 0 or not is_own
                for (_, worker, _), is_own in zip(self._unfinished(mine), own)]

    def _places(self, mine: Ints) -> list[str]:
        return [where for _, _, where in self._unfinished(mine)]

    def _executions(self) -> Table:
        table = super()._executions()
        table['cpu'], table['holds_gil'] = computed(self._events.table['d'][self.links.runs['at']])
        return table

    def _number_pieces(self, table: Table) -> None:
        own = np.flatnonzero(self.links.own_runs)
        number_pieces(table, own, 'callback', table['completes'][own] == NOTHING)

    def _missing(self, found: Recording) -> Iterator[Loss]:
        yield from super()._missing(found)
        yield from self._missing_end(found)

    def _missing_end(self, found: Recording) -> Iterator[Loss]:
        """Yield steps of the clock, and whether the end is missing."""
        yield from steps(self.name, [
            event[4] for event in self._events.others
            if event[0].name == CLOCK_STEP and isinstance(event[4], int)])
        if not found.run.shut_down:
            yield no_end(self.name)

    def _completed(self, found: Recording) -> Recording:
        drops, reasons, losses = [], dict[str, int](), []
        process = self._process
        for event in self._events.others:
            if event[0].name not in (_DROP, _MESSAGES_LOST):
                continue
            _, time, pid, _, *values = event
            fields = dict(zip(event[0].fields, values))
            callback = self.who.callbacks.latest(pid, fields.get('callback', 0), time)
            number = UNKNOWN if callback is None else callback.number
            if 'reason' in fields:
                drops.append((
                    process.get(pid, UNKNOWN), number, self._vertex.get(number, UNKNOWN), time,
                    reasons.setdefault(str(fields['reason']), len(reasons))))
            elif isinstance(fields.get('count'), int):
                losses.append((process.get(pid, UNKNOWN), number, time, fields['count']))
        of, callbacks, vertex, times, reason = zip(*drops) if drops else ((),) * 5
        dropped = rows(
            DROPS, len(drops), process=of, callback=callbacks, vertex=vertex, job=UNKNOWN,
            time=times, reason=reason)
        of, callbacks, times, count = zip(*losses) if losses else ((), (), (), ())
        lost = rows(LOSSES, len(losses), process=of, callback=callbacks, time=times, count=count)
        return replace(
            found, columns=replace(
                found.columns, drops=dropped, losses=lost, spin_gaps=self._spin_gaps()),
            names=replace(found.names, drop_reasons=tuple(reasons)),
            run=replace(found.run, shut_down=bool(
                (self._events.table['kind'] == SHUTDOWN).any())))

    def _spin_gaps(self) -> Table:
        gaps = []
        for layout, time, pid, _, *values in self._events.others:
            if layout.name != _SPIN_GAP:
                continue
            fields = dict(zip(layout.fields, values))
            program, begin, end = (fields.get(each) for each in ('program', 'begin', 'end'))
            if not (isinstance(program, int) and isinstance(begin, int) and isinstance(end, int)):
                continue
            number = program if program == -1 else self.who.program(pid, program)
            if program == -1 or number >= 0:    # the time may have been moved
                gaps.append((
                    self._process.get(pid, UNKNOWN), number, time - (end - begin), time))
        process, program, start, end = zip(*gaps) if gaps else ((),) * 4
        return rows(SPIN_GAPS, len(gaps), process=process, program=program, start=start, end=end)

    def _judged_until(self) -> int:
        table = self._events.table
        ends = table['a'][table['kind'] == SHUTDOWN]
        return int(ends[-1]) if len(ends) else self.end

    def _times(self, jobs: ImportedJobs) -> tuple[Ints, Ints]:
        number, own = self.links.runs['callback'], self.links.own_runs
        due, is_timer = self.links.runs['due'], self._is_any('timer')[number]
        ready = self.links.runs['ready'].copy()
        if not own.all():
            ready = np.where(own, ready, self._ready())
            timers = np.flatnonzero(is_timer & ~own)
            ready[timers] = self._due(timers, self.links.runs['start'][timers])
        for callback, mine in zip(
                self.links.callbacks, rows_by(number, len(self.links.callbacks))):
            if callback.kind == 'timer':
                times = distinct(ready[mine[(due[mine] == 0) & own[mine]]])
                if len(times):
                    callback.grid = _grid(times, callback.period)
        # the time at which a request was taken is not recorded
        release = self._releases(jobs, ready, 'timer', 'service')
        timer = (is_timer & own & (due == 0))[jobs.sources]
        mine = jobs.sources[timer]
        release[timer] = self._due(mine, ready[mine])
        return ready, np.where(due[jobs.sources] > 0, due[jobs.sources], release)

    def _skipped(self, jobs: ImportedJobs) -> Table:
        """Return the releases of sources that were skipped (rule 3); count those of others."""
        runs, found = self.links.runs, [rows(SKIPPED)]
        row = np.full(len(runs), UNKNOWN)
        row[jobs.sources] = np.arange(len(jobs.sources))
        once = np.array([*(dag.vertices[dag.source].callback.once for dag in self.task_set.dags),
                         False])
        for callback, mine in zip(
                self.links.callbacks, rows_by(runs['callback'], len(self.links.callbacks))):
            mine = mine[runs['due'][mine] > 0]
            due, first = np.unique(runs['due'][mine], return_index=True)
            if callback.kind != 'timer' or callback.period <= 0 or len(due) < 2:
                continue
            # the executor may have begun to manage the timer after the first one was due
            since_first = due[1] - due[0] - callback.period // _A_LITTLE
            due[0] = due[1] - max(1, -(-since_first // callback.period)) * callback.period
            gaps = np.rint(np.diff(due) / callback.period).astype(np.int64) - 1
            mine, due = mine[first[:-1]], due[:-1]
            # it may have been cancelled in the rest of a gap
            skipped = np.minimum(gaps, (runs['start'][mine] - due) // callback.period)
            if (row[mine] < 0).any():
                self._odd.count('skipped', callback.label, int(skipped.clip(0).sum()))
                continue
            skipped[once[jobs.releases['dag'][row[mine]]]] = 0
            number = np.minimum(skipped.clip(0), MOST_SKIPPED)
            mine, due, last = (np.repeat(each, number) for each in (mine, due, skipped))
            back = np.arange(len(mine)) - np.repeat(np.cumsum(number) - number, number)
            release = due + (last - back) * callback.period
            found.append(rows(SKIPPED, len(mine), after=row[mine], release=release,
                              noticed=np.maximum(release, runs['ready'][mine])))
        return concatenate(found)

    def _pieces(self) -> tuple[Ints, Mask]:
        """Return the first pieces of executions, and which end them (rule 4)."""
        runs = self.links.runs
        first, own = np.arange(len(runs)), np.flatnonzero(self.links.own_runs)
        order = own[sort_by(runs['callback'][own], runs['ready'][own])]
        number, ready = runs['callback'][order], runs['ready'][order]
        again = np.append(False, (np.diff(number) == 0) & (np.diff(ready) == 0))[:len(order)]
        first[order] = order[np.maximum.accumulate(np.where(again, 0, np.arange(len(order))))]
        newest, lost = np.full(len(runs), UNKNOWN), np.zeros(len(runs), dtype=np.bool_)
        np.maximum.at(newest, first, runs['end_at'])
        lost[first[runs['end_at'] < 0]] = True
        return first, (runs['end_at'] == newest[first]) & ~lost[first]


def _grid(ready: Ints, period: int) -> int | None:
    """
    Return a time on the grid of a timer's releases, before them; None: no grid (rule 3).

    :param ready: when it was noticed, ascending.
    """
    if not 0 < period < NEVER:
        return None
    phase = (ready - ready[0]) % period
    origins = distinct(phase)
    n = len(origins)
    # an origin in (the later moment, the earlier one] is excluded
    close = np.flatnonzero(np.diff(ready) < period)
    begin, until = (np.searchsorted(origins, phase[each], 'right') for each in (close + 1, close))
    changes = np.zeros(n + 1, dtype=np.int64)
    np.add.at(changes, begin, 1)
    np.add.at(changes, until, -1)
    changes[0] += (begin > until).sum()
    excluding = np.cumsum(changes)[:n]
    # how late the timer was noticed altogether, by origin: less by each step, more at each moment
    steps = np.diff(origins, prepend=0)
    passed = np.searchsorted(np.sort(phase), origins)
    late = phase.sum() - len(ready) * np.cumsum(steps) + period * passed
    allowed = np.flatnonzero(excluding * _ONE_OF <= len(ready))
    if not len(allowed):
        return None
    origin = int(origins[allowed[np.argmin(late[allowed])]])
    soon = (phase - origin) % period <= min(_SOON_NS, period // _SOON_PART)
    if len(close) * _ONE_OF < len(ready) and 2 * soon.sum() < len(ready):
        return None
    return int(ready[0]) + origin - 2 * period
