# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Reads a trace of this executor into a recording.

Theory of operation
-------------------
1. The file is read chunk by chunk, in the order of the file.  Whole chunks before damage are used.
   No event is dropped because of its time.
2. ``executions`` joins the events of executions.
3. A publication belongs to the execution that ran in its thread at that time, or of several that
   ended or started then, to the first one that is completed after it in the file.  If it was made
   on behalf of another execution, ``on_behalf`` says so.
4. The core processed events in the order of their times, equal times in the order of the file.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
import re
from typing import Any, NamedTuple

from mddag_executor.core import NEVER
from mddag_executor.memory import give_back
from mddag_executor.recording.columns import concatenate, Growing, Ints, Mask, rows, Table
from mddag_executor.recording.head import Head
from mddag_executor.recording.joins import earliest, rows_by, sort_by
from mddag_executor.recording.losses import Loss, Losses
from mddag_executor.recording.recording import Recording
from mddag_executor.recording.run import Run
from mddag_executor.recording.tables import (
    ABORTED,
    Columns,
    DEMOTIONS,
    DROPS,
    EXPIRED,
    FAILED,
    JOB_ENDS,
    LOSSES,
    MISSES,
    OUTDATED,
    PUBLICATIONS,
    RELEASES,
    SPIN_GAPS,
    STOPS,
    TAKES,
    UNKNOWN,
)
from mddag_executor.sources.entities import Entities, OWN_INIT_EVENTS, signed
from mddag_executor.sources.executions import (
    Batches,
    COMPLETE,
    DISPATCH,
    END,
    ExecutionJoin,
    Numbering,
    PARTS,
    running_at,
    unfinished_rows,
)
from mddag_executor.sources.head import (
    damage,
    declared,
    named_errors,
    no_end,
    no_jobs,
    steps,
    TASK_SET,
)
from mddag_executor.sources.progress import Progress
from mddag_executor.text import counted
from mddag_executor.trace import TraceReader
from mddag_executor.trace.events import Batch, Event
from mddag_executor.trace.schema import EVENTS, HOST, PREAMBLE
from msg_graph import TaskSet
import numpy as np

_INIT, _PUBLISH, _RELEASE = (
    'ros2_caret:caret_init', 'ros2:rclcpp_publish', 'mddag:job_release')
(_DEADLINE, _DEMOTE, _FAIL, _EXPIRE, _ABORT, _OUTDATE, _LOST, _STOP, _DROP, _HOSTED, _SHUTDOWN,
 _JUDGE_FROM, _MESSAGES_LOST, _UNFINISHED, _CLOCK_STEP, _ON_BEHALF, _SPIN_GAP) = (
    f'mddag:{name}' for name in (
        'deadline', 'demote', 'fail', 'expire', 'abort', 'outdate', 'lost', 'stop', 'drop',
        'hosted', 'shutdown', 'judge_from', 'messages_lost', 'unfinished',
        'clock_step', 'on_behalf', 'spin_gap'))
_PROGRAM = 'mddag:program'
_FIELDS = {
    DISPATCH: 'vtid callback dag vertex job worker ready reference_deadline cpu_time '
              'held_interpreter',
    END: 'vtid callback',
    COMPLETE: 'vtid callback dag vertex job last_leg completed leg cpu_time held_interpreter',
    _PUBLISH: 'vtid publisher_handle message_timestamp', _RELEASE: 'dag job release',
    _DEADLINE: 'dag vertex job deadline completed', _DEMOTE: 'dag vertex job',
    _FAIL: 'dag vertex job', _EXPIRE: 'dag job', _ABORT: 'dag job', _OUTDATE: 'dag job',
    _LOST: 'count', _CLOCK_STEP: 'step', _MESSAGES_LOST: 'callback count', _STOP: 'begin end',
    _SPIN_GAP: 'program begin end',
    _ON_BEHALF: 'vtid callback job ready',
    _JUDGE_FROM: 'release', _SHUTDOWN: 'end'}
"""The used fields of events that have only numbers."""
_ROWS = {name: np.dtype([(field, 'i8') for field in ('place', 'timestamp', *fields.split())])
        for name, fields in _FIELDS.items()}
"""By kind of event the type of its rows; ``place`` is the position in the file."""
_JOB_ENDS = {_EXPIRE: EXPIRED, _ABORT: ABORTED, _FAIL: FAILED, _OUTDATE: OUTDATED}
_CORE = (_RELEASE, _DEADLINE, *_JOB_ENDS)
"""Events that the executor's core processed: the run lasts at least until the last of them."""

_VERTEX = re.compile('[0-9]{1,9}')



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
        who = Entities(by_address=True)
        read = _Source(reader, name, head, declared(head, name), who).read(progress)
    give_back()     # events that are in no table
    return Recording(
        read.run, Columns(**read.tables), replace(
            who.names, drop_reasons=read.drop_reasons, places=read.places),
        Losses((*read.losses, *end_losses(read.run, len(read.tables['releases']), read.lost))))


def read_process(
    reader: TraceReader, name: str, head: Head, task_set: TaskSet, who: Entities,
    edit: Callable[[Event], Event], progress: Progress | None = None,
) -> Read:
    """
    Return what was read of one of several processes.

    :param task_set: the declaration in its head.
    :param who: receives the nodes and callbacks; ``edit``: changes initialisation events.
    """
    with named_errors(reader.path, name):
        return _Source(reader, name, head, task_set, who, edit).read(progress)


def begin_of(releases: Table, executions: Table) -> int | None:
    """Return the first release, or when the first execution became ready; None: neither."""
    return earliest(releases['release'], executions['ready'][
        (executions['end'] >= 0) & (executions['start'] >= 0)])


def end_losses(run: Run, n_releases: int, lost: int) -> Iterator[Loss]:
    """Yield what the run as a whole lacks."""
    if not run.shut_down:
        yield no_end(run.name)
    if lost:
        yield Loss('events', lost, (
            f'{run.name}: {counted(lost, "event")} lost while recording: jobs may be '
            'missing, or wrongly count as late'))
    if not n_releases:
        yield no_jobs(run.name)


class Stated(NamedTuple):
    """
    What a process says about itself; of several events the last one in the file.

    :ivar clock: offset from the machine's steady clock to its times, ns; ``boot``: the boot of the
        machine, '': unknown.
    :ivar judges_from: from when it judged, 0: unknown; ``end``: until when, None: not recorded.
    """

    clock: int = 0
    boot: str = ''
    judges_from: int = 0
    end: int | None = None


@dataclass
class Read:
    """
    What was read of a trace, before it becomes a recording.

    :ivar tables: by name, see ``tables.TABLES``.
    :ivar lost: number of events that the recorder lost.
    :ivar seen_at: the times of the core's events, by position in the order.
    :ivar stated: what the process says about itself.
    """

    run: Run
    tables: dict[str, Table]
    drop_reasons: Sequence[str]
    places: Sequence[str]
    lost: int
    losses: Sequence[Loss]
    seen_at: Ints
    stated: Stated


class _Source:
    """Reads one trace."""

    def __init__(
        self, reader: TraceReader, name: str, head: Head, task_set: TaskSet, who: Entities,
        edit: Callable[[Event], Event] | None = None,
    ) -> None:
        self._reader, self._name, self._head, self._edit = reader, name, head, edit
        self._task_set = task_set
        self._numbering = Numbering(self._task_set)
        self._strange: Counter[str] = Counter()
        self._executions = ExecutionJoin(_ROWS[COMPLETE], self._numbering, self._strange)
        self._who = who
        # rows of the other events
        self._kinds = {name: Growing(kind) for name, kind in _ROWS.items() if name not in PARTS}
        self._last_seen = self._latest = 0
        self._others: list[tuple[int, Event]] = []

    def read(self, progress: Progress | None) -> Read:
        count = 0
        for batch in self._reader.batches({
                *_ROWS, *OWN_INIT_EVENTS, _INIT, HOST, TASK_SET, _DROP, _HOSTED, _UNFINISHED}):
            self._take(batch)
            count += batch.n_events
            if progress is not None:
                progress(count)
        give_back()     # memory of the batches
        return self._read()

    # --- batches ---------------------------------------------------------------------------------

    def _take(self, batch: Batch) -> None:
        """Store the events of a batch, executions as rows."""
        self._latest = max(self._latest, *(
            int(table['timestamp'].max(initial=0)) for _, table, _ in batch.tables), *(
            event[1] or 0 for _, event in batch.others), 0)
        parts: dict[str, list[tuple[Table, Ints]]] = {}
        for (name, *_), table, places in batch.tables:
            if name in _ROWS:
                parts.setdefault(name, []).append((table, places))
            else:
                self._others += [(place, (name, *row)) for place, row in zip(
                    places.tolist(), table.tolist())]
        for place, event in batch.others:
            if None in event:
                self._strange[f'{event[0]} without some of its fields'] += 1
            elif event[0] in _ROWS:
                parts.setdefault(event[0], []).append((_one_row(event), np.array([place])))
            else:
                self._others.append((place, event))
        self._executions.expect(batch.share)
        self._executions.add(parts)
        for name, found in parts.items():
            if name not in PARTS:
                self._kinds[name].add(Batches(found).rows(_ROWS[name]))

    def _pop(self, name: str) -> Table:
        """Return the rows of a kind of event; forget them."""
        table = self._kinds.pop(name).table()
        if name in _CORE:
            self._last_seen = max(self._last_seen, int(table['timestamp'].max(initial=0)))
        return table

    # --- putting together ------------------------------------------------------------------------

    def _read(self) -> Read:
        self._entities()
        stated = self._stated()
        unfinished, places = self._unfinished()
        executions, completed = self._executions.tables()
        self._last_seen = max(self._last_seen, self._executions.last)
        publications = self._publications(executions, completed)
        releases, released_at = self._releases(self._pop(_RELEASE))
        job_ends, ends_at = self._job_ends()
        misses = self._at_vertices(
            _DEADLINE, MISSES, job='job', deadline='deadline', completed='completed')
        demotions = self._at_vertices(_DEMOTE, DEMOTIONS, job='job', time='timestamp')
        losses = self._pop(_MESSAGES_LOST)
        losses = rows(LOSSES, len(losses), callback=losses['callback'],
                      time=losses['timestamp'], count=losses['count'])
        stops = self._pop(_STOP)
        # recordings of earlier versions begin with an empty one
        stops = stops[stops['begin'] < stops['end']]
        stops = rows(STOPS, len(stops), start=stops['begin'], end=stops['end'])
        lost = sum(self._pop(_LOST)['count'].tolist())
        drops, reasons = self._drops()
        run = self._put_in_order(self._with_end(Run(
            self._name, self._head, self._task_set, self._task_set,
            workers_each=self._head.workers, start=begin_of(releases, executions))), executions, [
            (releases, releases['noticed'], released_at),
            (job_ends, job_ends['time'], ends_at)], completed)
        times, in_order = self._seen
        return Read(run, {
            'releases': releases, 'executions': executions, 'publications': publications,
            'job_ends': job_ends, 'misses': misses, 'demotions': demotions, 'losses': losses,
            'stops': stops, 'spin_gaps': self._spin_gaps(), 'drops': drops,
            'takes': rows(TAKES), 'unfinished': unfinished},
            reasons, places, lost, self._doubts(), times[in_order], stated)

    def _spin_gaps(self) -> Table:
        """Return when the executor (-1) or a program did not spin; without unknown programs."""
        found = self._pop(_SPIN_GAP)
        numbers = {-1: -1} | {
            event[5]: self._who.program(event[2], event[5])
            for _, event in self._others if event[0] == _PROGRAM}
        program = np.array([numbers.get(each, UNKNOWN - 1)
                            for each in found['program'].tolist()], dtype=np.int64)
        known = program >= -1
        return rows(SPIN_GAPS, int(known.sum()), program=program[known],
                    start=found['begin'][known], end=found['end'][known])

    def _stated(self) -> Stated:
        """Return what the process says about itself."""
        last = {event[0]: event[4:] for _, event in self._others if event[0] in (_INIT, HOST)}
        until, begin = (self._kinds[kind].rows()[field][-1:].tolist() for kind, field in (
            (_SHUTDOWN, 'end'), (_JUDGE_FROM, 'release')))
        return Stated(
            *last.get(_INIT, (0,))[:1], *last.get(HOST, ('', ''))[1:2], *(begin or (0,)),
            *until)

    def _entities(self) -> None:
        self._others.sort(key=lambda each: each[0])
        for _, event in self._others:
            if event[0] in OWN_INIT_EVENTS:
                self._who.take(event if self._edit is None else self._edit(event))
            elif event[0] == TASK_SET and event[4] != self._head.yaml:
                self._strange[f'{TASK_SET} with another declaration'] += 1

    def _unfinished(self) -> tuple[Table, Sequence[str]]:
        """Add the executions that have not ended; return them, and where they were."""
        several = [event for _, event in self._others if event[0] == _UNFINISHED]
        self._last_seen = max([self._last_seen, *(event[1] for event in several)])
        added = self._executions.add_unfinished(several, min(self._latest, NEVER - 1))
        return unfinished_rows(
            [(signed(event[4]), event[10], event[11], 0) for event in added])

    def _publications(self, executions: Table, completed: Table) -> Table:
        published = self._pop(_PUBLISH)
        time = published['timestamp']
        if (time[1:] < time[:-1]).any():
            published = published[sort_by(time)]
            time = published['timestamp']
        by = running_at(executions, completed, published['vtid'], time, published['place'])
        self._on_behalf(executions, published, by)
        table = rows(
            PUBLICATIONS, len(published), publisher=published['publisher_handle'],
            execution=by, vertex=UNKNOWN, time=time, source_timestamp=UNKNOWN,
            header_stamp=_known(published['message_timestamp']))
        known = by >= 0     # a killed run may have publications, and no execution
        table['vertex'][known] = executions['vertex'][by[known]]
        return table

    def _on_behalf(self, executions: Table, published: Table, by: Ints) -> None:
        """Correct the executions of publications that were made on behalf of others (rule 3)."""
        said = self._pop(_ON_BEHALF)
        if not len(said):
            return
        number = {key: row for row, key in enumerate(zip(
            published['vtid'].tolist(), published['timestamp'].tolist()))}
        mine = np.flatnonzero(np.isin(executions['callback'], said['callback']))
        keys = executions[['callback', 'job', 'ready']][mine].tolist()
        row_of = dict(zip(keys[::-1], mine[::-1].tolist()))     # the first piece
        for thread, time, *key in zip(*(said[name].tolist() for name in (
                'vtid', 'timestamp', 'callback', 'job', 'ready'))):
            at = number.get((thread, time), -1)
            if at >= 0:
                by[at] = row_of.get(tuple(key), UNKNOWN)

    def _releases(self, released: Table) -> tuple[Table, Ints]:
        """Return the releases, and their positions in the file."""
        released = released[sort_by(released['timestamp'], released['place'])]
        good = (released['dag'] >= 0) & (released['dag'] < len(self._task_set.dags))
        self._left_out(_RELEASE, 'of a DAG that is not declared', ~good)
        again = np.zeros(len(released), dtype=np.bool_)
        for mine in rows_by(np.where(good, released['dag'], -1), len(self._task_set.dags)):
            newest = np.maximum.accumulate(np.r_[-1, released['job'][mine]])
            again[mine] = released['job'][mine] <= newest[:-1]
        self._left_out(_RELEASE, 'of a job that is not newer than the last', again)
        good &= ~again
        released = released[good]
        release, noticed = released['release'], released['timestamp']
        to_come = (release < 0) | (release > noticed)
        self._left_out(_RELEASE, 'of a release that is still to come', to_come)
        return rows(
            RELEASES, len(released), dag=released['dag'], job=released['job'],
            release=np.where(to_come, noticed, release), noticed=noticed), released['place']

    def _left_out(self, name: str, why: str, which: Mask) -> None:
        count = int(which.sum())
        if count:
            self._strange[f'{name} {why}'] += count

    def _job_ends(self) -> tuple[Table, Ints]:
        tables, places = [rows(JOB_ENDS)], [np.empty(0, dtype=np.int64)]
        for kind, reason in _JOB_ENDS.items():
            found = self._pop(kind)
            good = (found['dag'] >= 0) & (found['dag'] < len(self._task_set.dags))
            self._left_out(kind, 'of a DAG that is not declared', ~good)
            vertex = np.full(len(found), UNKNOWN)
            if kind == _FAIL:
                vertex = self._numbering.of(found['dag'], found['vertex'])[1]
                good &= vertex >= 0
            tables.append(rows(
                JOB_ENDS, int(good.sum()), dag=found['dag'][good], vertex=vertex[good],
                job=found['job'][good], time=found['timestamp'][good], reason=reason))
            places.append(found['place'][good])
        return concatenate(tables), np.concatenate(places)

    def _at_vertices(self, name: str, kind: np.dtype[Any], **fields: str) -> Table:
        """Return events as rows of a type; ``fields``: by column the field of the events."""
        found = self._pop(name)
        dag, vertex = self._numbering.of(found['dag'], found['vertex'])
        return rows(kind, len(found), dag=dag, vertex=vertex, **{
            column: found[field] for column, field in fields.items()})

    def _drops(self) -> tuple[Table, Sequence[str]]:
        """Return the dropped executions and the names of the reasons; note what is hosted."""
        drops, reasons, hosted = [], dict[str, int](), []
        for place, event in self._others:
            if event[0] == _DROP:
                _, now, _, _, callback, dag, vertex, job, reason = event
                number = reasons.setdefault(reason, len(reasons))
                drops.append((signed(callback), self._numbering.one(dag, vertex), signed(job),
                              signed(now), number))
            elif event[0] == _HOSTED:
                vertices = self._hosted(event)
                if vertices is not None:
                    hosted.append((event[1], place, event[4], vertices))
            if event[0] in (_DROP, _HOSTED):
                self._last_seen = max(self._last_seen, event[1])
        self._hosting = sorted(hosted, key=lambda h: h[:2])
        callbacks, vertex, job, time, reason = zip(*drops) if drops else ((),) * 5
        return rows(DROPS, len(drops), callback=callbacks, vertex=vertex, job=job, time=time,
                    reason=reason), tuple(reasons)

    def _with_end(self, run: Run) -> Run:
        """Return the run with the times at which judging began and ended."""
        judging = self._pop(_JUDGE_FROM)
        last = max(self._last_seen, int(judging['timestamp'].max(initial=0)))
        possible = (judging['release'] >= 0) & (judging['release'] <= NEVER)
        self._left_out(_JUDGE_FROM, 'an impossible time', ~possible)
        judging = judging[possible]
        for place in sort_by(judging['timestamp'])[-1:]:
            run = replace(run, judge_from=int(judging['release'][place]))
        last = min(last, NEVER - 1)     # a run without end cannot be rescheduled
        run = replace(run, end=last, judged_until=last)
        self._shutdown_at: tuple[int, int] | None = None
        shutdown = self._pop(_SHUTDOWN)
        if len(shutdown):
            now, judged = int(shutdown['timestamp'][0]), int(shutdown['end'][0])
            if last <= now < NEVER and 0 <= judged <= now:
                run = replace(run, end=now, judged_until=judged, shut_down=True)
                self._shutdown_at = now, int(shutdown['place'][0])
            else:
                self._strange[f'{_SHUTDOWN} at an impossible time'] += 1
        if run.end == 0:
            last = min(max(0, self._head.time), NEVER - 1)
            run = replace(run, end=last, judged_until=last)
        return run

    def _hosted(self, event: Event) -> frozenset[int] | None:
        dag, text = event[4:6]
        words = text.split(',') if text else []
        found = [self._numbering.one(dag, int(word)) if _VERTEX.fullmatch(word) else -1
                 for word in words]
        if not 0 <= dag < len(self._task_set.dags) or -1 in found:
            self._strange[f'{_HOSTED} of a vertex that is not declared'] += 1
            return None
        return frozenset(found)

    def _put_in_order(
        self, run: Run, executions: Table, core: list[tuple[Table, Any, Ints]], completed: Table
    ) -> Run:
        """Assign positions in the order to the core's events (rule 4)."""
        single = [(time, place) for time, place, *_ in self._hosting]
        if self._shutdown_at is not None:
            single.append(self._shutdown_at)
        some = np.array(single, dtype=np.int64).reshape(-1, 2)
        times = np.concatenate([completed['time'], *(each for _, each, _ in core), some[:, 0]])
        places = np.concatenate([completed['place'], *(at for _, _, at in core), some[:, 1]])
        in_order = sort_by(times, places)
        del places
        self._seen = times, in_order
        rank = np.empty(len(times), dtype=np.int32)
        rank[in_order] = np.arange(len(times), dtype=np.int32)
        executions['order'][completed['row']] = rank[:len(completed)]
        at = len(completed)
        for table, _, _ in core:
            table['order'] = rank[at:at + len(table)]
            at += len(table)
        ranks = iter(rank[at:].tolist())
        run = replace(run, hosted=[
            (next(ranks), dag, vertices) for *_, dag, vertices in self._hosting])
        return run if self._shutdown_at is None else replace(run, judged_order=next(ranks))

    def _doubts(self) -> list[Loss]:
        """Return defects of the trace."""
        name, path = self._name, self._reader.path
        found = [*damage(self._reader.warnings, path, name),
                 *steps(name, self._pop(_CLOCK_STEP)['step'].tolist())]
        if self._strange:
            what, n = min(self._strange.items(), key=lambda item: (-item[1], item[0]))
            total = sum(self._strange.values())
            found.append(Loss('strange', total, (
                f'{name}: left out: '
                + counted(total, 'event that makes no sense', 'events that make no sense')
                + f', most often ({n}) {what}')))
        orphans = self._executions.orphans
        if orphans:
            found.append(Loss('open', orphans, (
                f'{name}: {counted(orphans, "completed execution")} whose start is not in it')))
        return found


def _known(stamps: Ints) -> Ints:
    """Return header stamps with UNKNOWN for messages without one."""
    found: Ints = np.where(stamps > 0, stamps, UNKNOWN)
    return found


def _one_row(event: Event) -> Table:
    """Return an event, a tuple with the fields of the table, as a row."""
    kind = _ROWS[event[0]]
    fields = [name for name, _ in (*PREAMBLE, *EVENTS[event[0]].fields)]
    values = dict(zip(fields, event[1:]))
    return rows(kind, 1, **{name: values[name] for name in (kind.names or ())[1:]})
