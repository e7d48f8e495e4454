# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Reads a trace of this executor into a recording.

Theory of operation
-------------------
1. The file is read chunk by chunk, in the order of the file.  Whole chunks before damage are used.
   No event is dropped because of its time.
2. The executor writes an execution as four adjacent events: ``dispatch``, ``callback_start``,
   ``callback_end`` and, unless it was suspended or is undeclared, ``complete``.  Adjacent events
   become one row directly.
3. The remaining events (simulations write events in the order of time) are joined by thread in the
   order of the file.  An end belongs to the last dispatch; a ``complete`` belongs to the last
   ended execution of its thread, if DAG, vertex and job agree.
4. A ``complete`` without execution is a row without start; a dispatch without end is a row without
   end: it ran at the end of the run, or waited (then its worker is -1, its start the run's end).
5. Rows with the same vertex, job and ready time, up to the completing one, are pieces of one
   execution.
6. A publication belongs to the execution that ran in its thread at that time.
7. The core processed events in the order of their times, equal times in the order of the file.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

from mddag_executor.core import legs_of, NEVER
from mddag_executor.memory import give_back
from mddag_executor.recording.entities import Entities, OWN_INIT_EVENTS
from mddag_executor.recording.head import declared, Head, named_errors, no_end, TASK_SET
from mddag_executor.recording.tables import (
    ABORTED,
    ALL_LEGS,
    DEMOTIONS,
    DROPS,
    earliest,
    EXECUTIONS,
    EXPIRED,
    FAILED,
    groups,
    Growing,
    Ints,
    JOB_ENDS,
    last_of,
    LEG,
    Mask,
    MISSES,
    NOTHING,
    OUTDATED,
    pick,
    PUBLICATIONS,
    Recording,
    RELEASES,
    rows,
    sort_by,
    STOPS,
    Table,
    UNKNOWN,
    VERTEX,
)
from mddag_executor.text import counted
from mddag_executor.trace import TraceReader
from mddag_executor.trace.errors import renamed
from mddag_executor.trace.events import Batch, Column, Event, FIELDS, rows_at, with_fields
from mddag_executor.trace.schema import EVENTS, PREAMBLE
from msg_graph import TaskSet
import numpy as np

_DISPATCH, _START, _END, _COMPLETE = (
    'mddag:dispatch', 'ros2:callback_start', 'ros2:callback_end', 'mddag:complete')
_PUBLISH, _RELEASE = 'ros2:rclcpp_publish', 'mddag:job_release'
(_DEADLINE, _DEMOTE, _FAIL, _EXPIRE, _ABORT, _OUTDATE, _LOST, _STOP, _DROP, _HOSTED, _SHUTDOWN,
 _JUDGE_FROM) = (
    f'mddag:{name}' for name in (
        'deadline', 'demote', 'fail', 'expire', 'abort', 'outdate', 'lost', 'stop', 'drop',
        'hosted', 'shutdown', 'judge_from'))
_NUMBERS = (_DISPATCH, _START, _END, _COMPLETE, _PUBLISH, _RELEASE, _DEADLINE, _DEMOTE, _FAIL,
            _EXPIRE, _ABORT, _OUTDATE, _LOST, _STOP, _JUDGE_FROM, _SHUTDOWN)
_JOB_ENDS = {_EXPIRE: EXPIRED, _ABORT: ABORTED, _FAIL: FAILED, _OUTDATE: OUTDATED}
_CORE = (_RELEASE, _COMPLETE, _DEADLINE, *_JOB_ENDS)
"""Events that the executor's core processed: the run lasts at least until the last of them."""

Progress = Callable[[int], None]


def read_own(
    reader: TraceReader, name: str, head: Head, progress: Progress | None = None
) -> Recording:
    """
    Return the recording of a trace of this executor.

    :param name: the trace's name in messages.
    :param head: head of the trace.
    :param progress: called regularly with the number of events read.
    """
    with named_errors(reader.path, name):
        source = _Source(reader, name, head, Entities(by_address=True))
        found = source.read(progress)
        found.warnings = [*source.doubts(), *end_lines(found)]
    del source      # it holds more than the tables
    give_back()
    return found


def read_process(
    reader: TraceReader, name: str, head: Head, who: Entities, edit: Callable[[Event], Event],
    progress: Progress | None = None,
) -> tuple[Recording, Ints]:
    """
    Return the recording of one of several processes.

    :param who: receives the nodes and callbacks; ``edit``: changes initialisation events.
    :return: the recording; and the times of the core's events, by position in the order.
    """
    with named_errors(reader.path, name):
        source = _Source(reader, name, head, who, edit)
        found = source.read(progress)
        found.warnings = source.doubts()
        return found, source.seen_at


def end_lines(found: Recording) -> list[str]:
    """Return missing data of the run as a whole, one line each."""
    name, lines = found.name, []
    if not found.shut_down:
        lines.append(no_end(name))
    if found.lost:
        lines.append(
            f'{name}: {counted(found.lost, "event")} lost while recording: jobs may be '
            'missing, or count as late that were not')
    if not len(found.releases):
        lines.append(f'{name}: no job was released in it')
    return lines


class _Source:
    """Reads one trace."""

    def __init__(
        self, reader: TraceReader, name: str, head: Head, who: Entities,
        edit: Callable[[Event], Event] | None = None,
    ) -> None:
        self._reader, self._name, self._head, self._edit = reader, name, head, edit
        self._task_set = declared(head, name)
        self._numbering = _Numbering(self._task_set)
        self._who = who
        #: The times of the core's events, by position in the order.
        self.seen_at = np.empty(0, dtype=np.int64)
        # by kind of event its rows, and their positions in the file
        self._kinds: dict[str, tuple[Growing, list[Ints]]] = {}
        # executions; positions of their dispatches, ends and completions; times of the latter
        self._executions = Growing(EXECUTIONS)
        self._dispatch_at: list[Ints] = []
        self._end_at: list[Ints] = []
        self._complete_at: list[Ints] = []
        self._seen: list[Ints] = []
        self._last_seen = 0
        self._others: list[tuple[int, Event]] = []
        self._strange: Counter[str] = Counter()
        self._orphans = 0

    def read(self, progress: Progress | None) -> Recording:
        count = 0
        for batch in self._reader.batches({
                *_NUMBERS, *OWN_INIT_EVENTS, TASK_SET, _DROP, _HOSTED}):
            self._take(batch)
            count += len(batch)
            if progress is not None:
                progress(count)
        give_back()     # memory of the batches
        return self._recording()

    # --- batches ---------------------------------------------------------------------------------

    def _take(self, batch: Batch) -> None:
        """Store the events of a batch, executions as rows."""
        columns: dict[str, Column] = {}
        for column in batch.columns:
            kind = column.fixed.head[0]
            if kind not in _NUMBERS:
                _, found, places = batch.table(column)
                self._others += [(place, (kind, *row)) for place, row in zip(
                    places.tolist(), found.tolist())]
            elif kind in columns:       # a second channel of the same kind
                self._keep(batch, column)
            else:
                columns[kind] = column
        for place, event in batch.others():
            if None in event:
                self._strange[f'{event[0]} without some of its fields'] += 1
            elif event[0] in _NUMBERS:
                self._add(event[0], _one_row(event), np.array([place]))
            else:
                self._others.append((place, event))
        if all(kind in columns and columns[kind].size for kind in (_DISPATCH, _START, _END)):
            self._adjacent(batch, columns)
        for column in columns.values():
            self._keep(batch, column)

    def _keep(self, batch: Batch, column: Column) -> None:
        if len(column.at):
            kind, found, places = batch.table(column)
            self._add(kind[0], found, places)

    def _add(self, name: str, found: Table, places: Ints) -> None:
        kind = _row_type(name)
        table, all_places = self._kinds.setdefault(name, (Growing(kind), []))
        table.add(rows(kind, len(found), **{field: found[field] for field in kind.names or ()}))
        all_places.append(places)

    def _pop(self, name: str) -> tuple[Table, Ints]:
        """Return the rows of a kind of event, and their positions in the file; forget them."""
        grown, places = self._kinds.pop(name, (Growing(_row_type(name)), []))
        table = grown.table()
        if name in _CORE:
            self._last_seen = max(self._last_seen, int(table['timestamp'].max(initial=0)))
        return table, np.concatenate([*places, np.empty(0, dtype=np.int64)])

    def _adjacent(self, batch: Batch, columns: dict[str, Column]) -> None:
        """Remove adjacent events of executions (rule 2)."""
        kinds = [_DISPATCH, _START, _END]
        at = columns[_DISPATCH].at
        start_at = at + columns[_DISPATCH].size
        end_at = start_at + columns[_START].size
        complete_at = end_at + columns[_END].size
        fits = _is_in(start_at, columns[_START].at) & _is_in(end_at, columns[_END].at)
        complete = columns.get(_COMPLETE)
        if complete is not None and complete.size:
            # several legs at once are joined later
            whole = fits & _is_in(complete_at, complete.at) & ~_is_in(
                complete_at + complete.size, complete.at)
            if whole.any():
                self._add_adjacent(batch, columns, [*kinds, _COMPLETE], at[whole])
            fits &= ~whole
        if fits.any():
            self._add_adjacent(batch, columns, kinds, at[fits])

    def _add_adjacent(
        self, batch: Batch, columns: dict[str, Column], kinds: list[str], at: Ints
    ) -> None:
        """Make rows of executions from adjacent events that match."""
        offsets = np.cumsum([0, *(columns[kind].size for kind in kinds)]).tolist()
        row = np.dtype({
            'names': kinds, 'formats': [columns[kind].fixed.kind for kind in kinds],
            'offsets': offsets[:-1],
            'itemsize': offsets[-2] + columns[kinds[-1]].fixed.kind.itemsize})
        found = rows_at(batch.data, row, at + FIELDS)
        same = np.ones(len(found), dtype=np.bool_)
        for kind in kinds[1:]:
            for field in ('vtid', 'callback', *(
                    ('dag', 'vertex', 'job') if kind == _COMPLETE else ())):
                same &= found[kind][field] == found[_DISPATCH][field]
        if not same.all():
            found, at = found[same], at[same]
        parts = {kind: with_fields(found[kind], columns[kind].fixed.missing) for kind in kinds}
        dispatch = parts[_DISPATCH]
        table = self._rows(dispatch, dispatch['timestamp'], parts[_END]['timestamp'])
        at_end = batch.base + at + offsets[2]
        self._dispatch_at.append(batch.base + at)
        self._end_at.append(at_end)
        if kinds[-1] == _COMPLETE:
            self._complete(table, parts[_COMPLETE])
            self._complete_at.append(batch.base + at + offsets[3])
            self._seen.append(parts[_COMPLETE]['timestamp'].astype(np.int64))
        else:
            self._complete_at.append(np.full(len(at), UNKNOWN))
            self._seen.append(np.full(len(at), UNKNOWN))
        self._executions.add(table)
        for kind, offset in zip(kinds, offsets):
            column = columns[kind]
            rest = column.at[:0] if len(column.at) == len(at) else column.at[
                ~_is_in(column.at, at + offset)]
            columns[kind] = column._replace(at=rest)

    def _rows(self, dispatch: Table, start: Any, end: Any) -> Table:
        """Return rows of dispatched executions."""
        table = np.zeros(len(dispatch), dtype=EXECUTIONS)
        dag, vertex = self._numbering.of(dispatch['dag'], dispatch['vertex'])
        table['callback'], table['thread'] = dispatch['callback'], dispatch['vtid']
        table['dag'], table['vertex'], table['job'] = dag, vertex, dispatch['job']
        ready = dispatch['ready']
        strange = (ready < 0) | (ready > start)
        if strange.any():
            self._left_out(_DISPATCH, 'before it was ready', strange)
            ready = np.where(strange, start, ready)
        table['worker'], table['ready'] = dispatch['worker'], ready
        table['start'] = table['began'] = start
        table['end'] = end
        table['busy'] = table['end'] - table['start']
        table['cpu'] = table['message'] = table['order'] = UNKNOWN
        return table

    def _complete(self, table: Table, complete: Table) -> None:
        table['leg'] = complete['leg']
        table['completes'] = np.where(complete['last_leg'], VERTEX, LEG)
        table['cpu'] = complete['cpu_time']
        table['holds_gil'] = complete['held_interpreter']

    # --- putting together ------------------------------------------------------------------------

    def _recording(self) -> Recording:
        head, task_set = self._head, self._task_set
        found = Recording(
            self._name, head, task_set, task_set, self._who, workers_each=head.workers)
        self._entities()
        executions, complete_at, seen = self._all_executions()
        found.executions = executions
        found.publications = self._publications(executions)
        released, released_at = self._pop(_RELEASE)
        found.releases, released_at = self._releases(released, released_at)
        found.job_ends, ends_at = self._job_ends()
        found.misses = self._misses()
        found.demotions = self._demotions()
        stops, _ = self._pop(_STOP)
        found.notices_stops = earliest(stops['end'])
        stops = stops[stops['begin'] < stops['end']]    # the first one is empty: stops are noticed
        found.stops = rows(STOPS, len(stops), start=stops['begin'], end=stops['end'])
        found.lost = sum(self._pop(_LOST)[0]['count'].tolist())
        self._set_end(found)
        self._put_in_order(found, [
            (found.releases, found.releases['noticed'], released_at),
            (found.job_ends, found.job_ends['time'], ends_at)], seen, complete_at)
        found.start = earliest(found.releases['release'], executions['ready'][
            (executions['end'] >= 0) & (executions['start'] >= 0)])
        return found

    def _entities(self) -> None:
        self._others.sort(key=lambda each: each[0])
        for _, event in self._others:
            if event[0] in OWN_INIT_EVENTS:
                self._who.take(event if self._edit is None else self._edit(event))
            elif event[0] == TASK_SET and event[4] != self._head.yaml:
                self._strange[f'{TASK_SET} with another declaration'] += 1

    def _all_executions(self) -> tuple[Table, Ints, Ints]:
        """Return all executions; positions of completions in the file, and their times."""
        rest, began_at, rest_at = self._by_thread()
        none = np.full(len(rest), UNKNOWN)
        self._executions.add(rest)
        dispatch_at = _joined(self._dispatch_at, began_at)
        end_at = _joined(self._end_at, rest_at)
        complete_at = _joined(self._complete_at, none)
        seen = _joined(self._seen, none)
        self._last_seen = max(self._last_seen, int(seen.max(initial=0)))
        table = self._executions.table()
        more, more_at, more_seen = self._completions(table, dispatch_at, complete_at, seen)
        _pieces(table, end_at)
        if len(more):
            del table       # frees memory
            self._executions.add(more)
            table = self._executions.table()
            complete_at = np.concatenate([complete_at, more_at])
            seen = np.concatenate([seen, more_seen])
        return table, complete_at, seen

    def _by_thread(self) -> tuple[Table, Ints, Ints]:
        """Return executions of events that are not adjacent, and positions of begins and ends."""
        found = [self._pop(kind) for kind in (_DISPATCH, _START, _END)]
        dispatch = found[0][0]
        line = _Line([each for each, _ in found], [at for _, at in found])
        is_dispatch, is_end = line.kind == 0, line.kind == 2
        before = last_of(is_dispatch | is_end, line.thread, before=True)
        runs = (before >= 0) & is_dispatch[before]
        same = runs & (line.callback == line.callback[before])
        started = last_of((line.kind == 1) & same, line.thread)
        ended = np.flatnonzero(is_end & same)
        self._left_out(_END, 'of an execution that was not dispatched', is_end & ~same)
        by = before[ended]
        start, last = line.time[by], started[ended]
        start = np.where(last > by, line.time[np.maximum(last, 0)], start)
        of = dispatch[line.row[by]]
        table = self._rows(of, start, line.time[ended])
        open_ones = np.ones(len(dispatch), dtype=np.bool_)
        open_ones[line.row[by]] = False
        still = dispatch[open_ones]
        running = self._rows(still, still['timestamp'], UNKNOWN)
        running['busy'] = UNKNOWN
        still_at = found[0][1][open_ones]
        return (np.concatenate([table, running]),
                np.concatenate([line.place[by], still_at]),
                np.concatenate([line.place[ended], still_at]))

    def _completions(
        self, table: Table, dispatch_at: Ints, complete_at: Ints, seen: Ints
    ) -> tuple[Table, Ints, Ints]:
        """Assign the other completions to executions; return those without execution."""
        complete, at = self._pop(_COMPLETE)
        if not len(complete):
            return rows(EXECUTIONS), at, at
        ended = np.flatnonzero((table['end'] >= 0) & (complete_at < 0))
        # the last dispatched execution in the thread
        thread = np.r_[table['thread'][ended], complete['vtid'].astype(np.int64)]
        place = np.r_[dispatch_at[ended], at]
        order = sort_by(thread, place)
        is_complete = order >= len(ended)
        last = last_of(~is_complete, thread[order])
        same = (last >= 0) & is_complete
        of = np.full(len(complete), -1)
        of[order[same] - len(ended)] = ended[order[last[same]]]
        dag, vertex = self._numbering.of(complete['dag'], complete['vertex'])
        good = (of >= 0) & (dag >= 0)
        for column, values in (('dag', dag), ('vertex', vertex), ('job', complete['job'])):
            good[good] = table[column][of[good]] == values[good]
        # one execution may complete several legs
        mine = np.flatnonzero(good)
        mine = mine[np.argsort(of[mine], kind='stable')]
        begins, until = groups(of[mine])
        taken = np.zeros(len(complete), dtype=np.bool_)
        if len(mine):
            row, last_leg = of[mine[begins]], mine[until - 1]
            changed = pick(table, row)
            self._complete(changed, complete[last_leg])
            legs = np.add.reduceat(1 << np.clip(complete['leg'][mine], 0, 62).astype(np.int64),
                                   begins)
            n_legs = np.array(self._numbering.n_legs)[changed['vertex']]
            every = (until - begins > 1) & (until - begins == n_legs) & (
                legs == (1 << np.minimum(n_legs, 62)) - 1)
            changed['leg'][every] = ALL_LEGS
            table[row] = changed
            complete_at[row], seen[row] = at[last_leg], complete['timestamp'][last_leg]
            taken[last_leg] = True
            taken[mine] |= np.repeat(every, until - begins)
        rest = np.flatnonzero(~taken)
        known = dag[rest] >= 0
        if not known.all():
            self._strange[f'{_COMPLETE} of a vertex that is not declared'] += int((~known).sum())
            rest = rest[known]
        self._orphans = int((~good[rest]).sum())
        more = rows(
            EXECUTIONS, len(rest), callback=complete['callback'][rest], dag=dag[rest],
            vertex=vertex[rest], job=complete['job'][rest], thread=complete['vtid'][rest],
            worker=UNKNOWN, ready=UNKNOWN, began=UNKNOWN, start=UNKNOWN,
            end=complete['completed'][rest], busy=UNKNOWN, message=UNKNOWN)
        self._complete(more, complete[rest])
        return more, at[rest], complete['timestamp'][rest].astype(np.int64)

    def _publications(self, executions: Table) -> Table:
        published, _ = self._pop(_PUBLISH)
        time = published['timestamp'].astype(np.int64)
        if (time[1:] < time[:-1]).any():
            order = np.argsort(time, kind='stable')
            published, time = published[order], time[order]
        by = running_at(executions, published['vtid'].astype(np.int64), time)
        return rows(
            PUBLICATIONS, len(published), publisher=published['publisher_handle'],
            execution=by, time=time, source_timestamp=UNKNOWN,
            vertex=np.where(by >= 0, executions['vertex'][by], UNKNOWN))

    def _releases(self, released: Table, at: Ints) -> tuple[Table, Ints]:
        order = sort_by(released['timestamp'], at)
        released, at = released[order], at[order]
        good = (released['dag'] >= 0) & (released['dag'] < len(self._task_set.dags))
        self._left_out(_RELEASE, 'of a DAG that is not declared', ~good)
        again = np.zeros(len(released), dtype=np.bool_)
        for dag in range(len(self._task_set.dags)):
            mine = np.flatnonzero(good & (released['dag'] == dag))
            newest = np.maximum.accumulate(np.r_[-1, released['job'][mine]])
            again[mine] = released['job'][mine] <= newest[:-1]
        self._left_out(_RELEASE, 'of a job that is not newer than the last', again)
        good &= ~again
        released, at = released[good], at[good]
        release, noticed = released['release'], released['timestamp']
        to_come = (release < 0) | (release > noticed)
        self._left_out(_RELEASE, 'of a release that is still to come', to_come)
        return rows(
            RELEASES, len(released), dag=released['dag'], job=released['job'],
            release=np.where(to_come, noticed, release), noticed=noticed), at

    def _left_out(self, name: str, why: str, which: Mask) -> None:
        count = int(which.sum())
        if count:
            self._strange[f'{name} {why}'] += count

    def _job_ends(self) -> tuple[Table, Ints]:
        tables, places = [rows(JOB_ENDS)], [np.empty(0, dtype=np.int64)]
        for kind, reason in _JOB_ENDS.items():
            found, at = self._pop(kind)
            good = (found['dag'] >= 0) & (found['dag'] < len(self._task_set.dags))
            self._left_out(kind, 'of a DAG that is not declared', ~good)
            vertex = np.full(len(found), UNKNOWN)
            if kind == _FAIL:
                vertex = self._numbering.of(found['dag'], found['vertex'])[1]
                good &= vertex >= 0
            tables.append(rows(
                JOB_ENDS, int(good.sum()), dag=found['dag'][good], vertex=vertex[good],
                job=found['job'][good], time=found['timestamp'][good], reason=reason))
            places.append(at[good])
        return np.concatenate(tables), np.concatenate(places)

    def _misses(self) -> Table:
        found, _ = self._pop(_DEADLINE)
        dag, vertex = self._numbering.of(found['dag'], found['vertex'])
        return rows(MISSES, len(found), dag=dag, vertex=vertex, job=found['job'],
                    deadline=found['deadline'], completed=found['completed'])

    def _demotions(self) -> Table:
        found, _ = self._pop(_DEMOTE)
        dag, vertex = self._numbering.of(found['dag'], found['vertex'])
        return rows(DEMOTIONS, len(found), dag=dag, vertex=vertex, job=found['job'],
                    time=found['timestamp'])

    def _set_end(self, found: Recording) -> None:
        """Find the end of the run, and process events that are not in tables."""
        last = self._last_seen
        drops, reasons, hosted = [], dict[str, int](), []
        for place, event in self._others:
            if event[0] == _DROP:
                _, now, _, _, _, dag, vertex, job, reason = event
                number = reasons.setdefault(reason, len(reasons))
                drops.append((self._numbering.one(dag, vertex), job, now, number))
            elif event[0] == _HOSTED:
                vertices = self._hosted(event)
                if vertices is not None:
                    hosted.append((event[1], place, event[4], vertices))
            if event[0] in (_DROP, _HOSTED):
                last = max(last, event[1])
        vertex, job, time, reason = zip(*drops) if drops else ((), (), (), ())
        found.drops = rows(DROPS, len(drops), vertex=vertex, job=job, time=time, reason=reason)
        found.drop_reasons = tuple(reasons)
        judging, _ = self._pop(_JUDGE_FROM)
        last = max(last, int(judging['timestamp'].max(initial=0)))
        possible = (judging['release'] >= 0) & (judging['release'] <= NEVER)
        self._left_out(_JUDGE_FROM, 'an impossible time', ~possible)
        judging = judging[possible]
        for place in sort_by(judging['timestamp'])[-1:]:
            found.judge_from = int(judging['release'][place])
        self._hosting = sorted(hosted, key=lambda h: h[:2])
        last = min(last, NEVER - 1)     # a run without end cannot be rescheduled
        found.end = found.judged_until = last
        self._shutdown_at: tuple[int, int] | None = None
        shutdown, shutdown_at = self._pop(_SHUTDOWN)
        if len(shutdown):
            now, judged = int(shutdown['timestamp'][0]), int(shutdown['end'][0])
            if last <= now < NEVER and 0 <= judged <= now:
                found.end, found.judged_until, found.shut_down = now, judged, True
                self._shutdown_at = now, int(shutdown_at[0])
            else:
                self._strange[f'{_SHUTDOWN} at an impossible time'] += 1
        if found.end == 0:
            found.end = found.judged_until = min(max(0, self._head.time), NEVER - 1)

    def _hosted(self, event: Event) -> frozenset[int] | None:
        dag, text = event[4:6]
        words = text.split(',') if text else []
        found = [self._numbering.one(dag, int(word)) if word.isascii() and word.isdigit() else -1
                 for word in words]
        if not 0 <= dag < len(self._task_set.dags) or -1 in found:
            self._strange[f'{_HOSTED} of a vertex that is not declared'] += 1
            return None
        return frozenset(found)

    def _put_in_order(
        self, found: Recording, core: list[tuple[Table, Any, Ints]], seen: Ints,
        complete_at: Ints,
    ) -> None:
        """Assign positions in the order to the core's events (rule 7)."""
        done = np.flatnonzero(complete_at >= 0)
        single = [(time, place) for time, place, *_ in self._hosting]
        if self._shutdown_at is not None:
            single.append(self._shutdown_at)
        times = np.concatenate([
            seen[done], *(each for _, each, _ in core),
            np.array([time for time, _ in single], dtype=np.int64)])
        places = np.concatenate([
            complete_at[done], *(at for _, _, at in core),
            np.array([place for _, place in single], dtype=np.int64)])
        rank = np.empty(len(times), dtype=np.int32)
        in_order = sort_by(times, places)
        rank[in_order] = np.arange(len(times))
        self.seen_at = times[in_order]
        found.executions['order'][done] = rank[:len(done)]
        at = len(done)
        for table, _, _ in core:
            table['order'] = rank[at:at + len(table)]
            at += len(table)
        ranks = iter(rank[at:].tolist())
        found.hosted = [(next(ranks), dag, vertices) for *_, dag, vertices in self._hosting]
        if self._shutdown_at is not None:
            found.judged_order = next(ranks)

    def doubts(self) -> list[str]:
        """Return defects of the trace, one line each."""
        name, path = self._name, self._reader.path
        lines = [renamed(text, path, name) for text in self._reader.warnings]
        if self._strange:
            what, n = min(self._strange.items(), key=lambda item: (-item[1], item[0]))
            lines.append(
                f'{name}: left out: {counted(sum(self._strange.values()), "event")} that make no '
                f'sense, most often ({n}) {what}')
        if self._orphans:
            lines.append(f'{name}: {counted(self._orphans, "completed execution")} whose start is '
                         'not in it')
        return lines


def _joined(parts: list[Ints], last: Ints) -> Ints:
    """Return all parts as one array; empties the list, to free memory."""
    found: Ints = np.concatenate([*parts, last])
    parts.clear()
    return found


def _is_in(places: Ints, known: Ints) -> Mask:
    """Return which positions are among known ones; both ascend."""
    found = np.zeros(len(places), dtype=np.bool_)
    if not len(places) or not len(known):
        return found
    # in most batches they are equal except for the first or last one
    first = int(np.searchsorted(known, places[0]))
    part = known[first:first + len(places)]
    found[:len(part)] = part == places[:len(part)]
    if not found[:-1].all():
        at = np.minimum(np.searchsorted(known, places), len(known) - 1)
        found = known[at] == places
    return found


class _Numbering:
    """Converts a DAG and the local number of a vertex to the global vertex."""

    def __init__(self, task_set: TaskSet) -> None:
        self._sizes = np.array([*(len(dag.vertices) for dag in task_set.dags), 0])
        self._first = np.r_[0, np.cumsum(self._sizes)[:-1]]
        #: By vertex the number of its legs.
        self.n_legs = [max(1, len(legs_of(vertex, dag.vertices)))
                       for dag in task_set.dags for vertex in dag.vertices] + [1]

    def of(self, dag: Any, vertex: Any) -> tuple[Ints, Ints]:
        """Return DAGs and global vertices; -1 for unknown vertices."""
        known = (dag >= 0) & (dag < len(self._sizes) - 1)
        at = np.where(known, dag, -1)
        known &= (vertex >= 0) & (vertex < self._sizes[at])
        return np.where(known, dag, -1), np.where(known, self._first[at] + vertex, -1)

    def one(self, dag: int, vertex: int) -> int:
        """Return a global vertex; -1 if unknown."""
        if not 0 <= dag < len(self._sizes) - 1 or not 0 <= vertex < self._sizes[dag]:
            return -1
        return int(self._first[dag]) + vertex


class _Line:
    """Events by thread, each thread in the order of the file."""

    def __init__(self, tables: list[Table], places: list[Ints]) -> None:
        parts = [(number, table, at) for number, (table, at) in enumerate(zip(tables, places))]
        thread = np.concatenate([table['vtid'].astype(np.int64) for _, table, _ in parts])
        place = np.concatenate([at for *_, at in parts])
        order = sort_by(thread, place)
        self.thread, self.place = thread[order], place[order]
        self.kind = np.concatenate([
            np.full(len(table), number) for number, table, _ in parts])[order]
        self.row = np.concatenate([np.arange(len(table)) for _, table, _ in parts])[order]
        self.time = np.concatenate([table['timestamp'] for _, table, _ in parts])[order]
        self.callback = np.concatenate([table['callback'] for _, table, _ in parts])[order]


def _pieces(table: Table, end_at: Ints) -> None:
    """
    Count the pieces of executions that were suspended (rule 5).

    :param end_at: positions of their ends in the file.
    """
    suspended = (table['completes'] == NOTHING) & (table['vertex'] >= 0)
    undeclared = table['vertex'] < 0
    if suspended.any():
        mine = np.flatnonzero(table['vertex'] >= 0)
        keys = _hashed(table['vertex'][mine], table['job'][mine], table['ready'][mine])
        some = np.unique(_hashed(*(table[name][suspended] for name in ('vertex', 'job', 'ready'))))
        number_pieces(table, mine[np.isin(keys, some)], 'job', end_at)
    if undeclared.any():
        number_pieces(table, np.flatnonzero(undeclared), 'callback', end_at)


def _hashed(vertex: Any, job: Any, ready: Any) -> Ints:
    found: Ints = (vertex.astype(np.int64) * 31 + job) * 0x9E3779B97F4A7C1 + ready
    return found


def number_pieces(table: Table, mine: Ints, of: str, end_at: Ints) -> None:
    """Count pieces among rows; pieces of an execution agree in vertex, ready time and a column."""
    columns = [table[name][mine] for name in (of, 'vertex', 'ready')]
    order = sort_by(*columns, end_at[mine])
    mine = mine[order]
    same = np.zeros(len(mine), dtype=np.bool_)
    same[1:] = table['completes'][mine[:-1]] == NOTHING
    for column in columns:
        values = column[order]
        same[1:] &= values[1:] == values[:-1]
    if not same.any():
        return
    begin = np.maximum.accumulate(np.where(same, 0, np.arange(len(mine))))
    table['piece'][mine] = np.arange(len(mine)) - begin
    table['began'][mine] = table['start'][mine[begin]]
    total = np.cumsum(table['busy'][mine])
    ended = table['end'][mine] >= 0     # a running piece is the last one
    table['busy'][mine[ended]] = (total - total[begin] + table['busy'][mine[begin]])[ended]


def running_at(executions: Table, thread: Ints, time: Ints) -> Ints:
    """
    Return the rows of the executions that ran in threads at given times; -1: none.

    :param time: ascending.
    """
    found = np.full(len(time), UNKNOWN)
    ran = np.flatnonzero((executions['end'] >= 0) & (executions['start'] >= 0))
    threads = executions['thread'][ran]
    for number in np.unique(thread).tolist():
        asked, mine = np.flatnonzero(thread == number), ran[threads == number]
        if not len(mine):
            continue
        start, end = executions['start'][mine], executions['end'][mine]
        if (start[1:] <= start[:-1]).any():
            order = sort_by(start, -end)
            mine, start, end = mine[order], start[order], end[order]
        at = np.searchsorted(start, time[asked], 'right') - 1
        # a nested execution may have ended before
        for _ in range(32):
            outer = (at >= 0) & (end[np.maximum(at, 0)] < time[asked])
            if not outer.any():
                break
            at[outer] -= 1
        good = (at >= 0) & (end[np.maximum(at, 0)] >= time[asked])
        found[asked[good]] = mine[at[good]]
    return found


def _row_type(name: str) -> np.dtype[Any]:
    """Return the type of rows of a kind of event that has only numbers."""
    return np.dtype([(field, 'u8' if kind == 'uint64' else 'i8')
                     for field, kind in (*PREAMBLE, *EVENTS[name].fields)])


def _one_row(event: Event) -> Table:
    kind = _row_type(event[0])
    return rows(kind, 1, **dict(zip(kind.names or (), event[1:])))
