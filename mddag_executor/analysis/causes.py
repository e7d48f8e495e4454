# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The parts of the time of each job that missed its deadline, and the one cause of the miss.

Theory of operation
-------------------
The time of a job, from its release to its completion at the sink (or to its early end), is split
along its critical chain (see ``chains``):

* overlap with a recorded stop of the machine: *machine*;
* before the source is ready: *waited* while all workers were busy, so that none could notice the
  timer or message; else *released late*;
* ready callback: *group* while another callback of its group ran; else *program* while another
  callback of its program ran, if that runs them one at a time; else *waited* while all workers
  were busy; else, with an idle worker, *interpreter* while any callback ran that held the GIL, or
  may have held it because the trace does not say (undeclared callbacks in traces of version 2),
  *machine* while none ran;
* the time that a job *waited*, or waited for its *program* or the *interpreter*, after its
  demotion counts as *demoted*; or as *less important* if the job could still have been in time
  when it was demoted, so that it only made way for more important work;
* callback that had not ended when the recording did (``recording.unfinished``), and had run for
  ``HANGS_NS``: *never ended*, and so is the time that others of its group waited for it;
* running callback: *ran* up to the usual time (its median or, if less, the declared maximum) and
  *ran long* beyond.  If its CPU time is recorded, shows computing and is not unusual, the excess
  is *interpreter* while other callbacks held the GIL, else *machine*: it got no CPU;
* end of a callback until the next one is ready: *transport*; *other topic* if the next one is a
  driven sync that had its driving message and got one of another topic later, or not at all;
* ready callback in a process of another executor, which does not say when a message or timer was
  noticed: *waited* while its own thread ran a callback; with an idle thread *released late* (a
  source), else *transport*, because the message was still on its way;
* job that ended early because of a callback that never ran, or a sync that did not get all of its
  messages: *dropped* if the executor dropped the message from its queue, *destroyed* if it did so
  because the node or subscription was destroyed, *withdrawn* if the program reset or cancelled
  the timer; *waited* if the callback was ready; *not
  published* if the callback before it ended without publishing; else the message is *lost*.

The largest part, beyond what is usual, is the cause of the miss.  Two rules precede:

* Waiting during or shortly after a stall of the machine is caused by the backlog.  It counts as
  *machine*, up to the length of the stalls.
* If all unusual time together is less than the lateness, the usual times are too long for the
  deadline.  Then they count as well: usual execution times as *ran long*.

A job whose callback raised has *failed*.  A job that expired because of a callback that never ran
has the cause for which that callback did not run.  A timer's release that was skipped because the
previous execution still waited has the cause of the previous job; if that one was in time, it
*waited*.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from mddag_executor.analysis.spans import Spans
from mddag_executor.core.state import SINK_ABORTED, SINK_EXPIRED, SINK_FAILED, SINK_LATE
from mddag_executor.recording.columns import concatenate, Ints, Mask, Table
from mddag_executor.recording.columns import rows as table_of
from mddag_executor.recording.joins import as_of, distinct, equal_pairs
import numpy as np

CAUSES = ('waited', 'ran long', 'interpreter', 'group', 'released late', 'transport', 'machine',
          'demoted', 'less important', 'dropped', 'destroyed', 'withdrawn', 'not published',
          'lost', 'failed', 'other topic', 'never ended', 'program')
(WAITED, RAN_LONG, INTERPRETER, GROUP, RELEASED_LATE, TRANSPORT, MACHINE, DEMOTED, LESS_IMPORTANT,
 DROPPED, DESTROYED, WITHDRAWN, NOT_PUBLISHED, LOST, FAILED, OTHER_TOPIC, NEVER_ENDED, PROGRAM,
 RAN_USUALLY, UNKNOWN, SKIPPED) = range(21)
#: Kinds of time of a job; the last three are not causes.
PARTS = (*CAUSES, 'ran', 'unknown', 'skipped')
#: By cause what to do about it.
REMEDIES = {
    'waited': 'more workers, or shorter callbacks before it',
    'ran long': 'make the callback shorter, or declare the time that it takes',
    'interpreter': 'give the nodes processes of their own, or release the lock while computing',
    'group': 'give the callback a group of its own, or a reentrant one',
    'program': 'if the callbacks of its program may overlap, let them (--concurrent NODE, or a '
               'MultiThreadedExecutor); else give the node a program of its own; if it spins in a '
               'loop of its own (spin_once), spin more often, as nothing runs between two spins',
    'released late': 'look at the timer, or at the way of the message from its sensor',
    'transport': 'let the nodes share a process, or send smaller messages',
    'machine': 'free the CPUs of other work, pin the workers, or take a machine that does not '
               'stand still',
    'demoted': 'less work, or a longer deadline: it could no longer be in time, so others went '
               'first',
    'less important': 'less work of higher importance, or a higher importance of this sink',
    'dropped': 'shorter callbacks before it; for messages a longer queue (QoS depth, or without '
               '`keep: newest`); a late release of a timer is dropped when its next one is '
               'ready: less load, or a longer deadline',
    'destroyed': 'let the program and the node run on, and keep the subscription; if the node '
                 'is meant to end before the others, judge the time before that (--to)',
    'withdrawn': 'nothing, if the program meant it: it reset or cancelled the timer while its '
                 'callback waited; else a longer period, or shorter callbacks before it',
    'not published': 'publish in each execution of the callback before it, or declare the topic '
                     'under `may_publish`',
    'lost': 'reliable QoS, the same QoS of publisher and subscription, or a longer queue (QoS '
            'depth); if a process ended early (see the warnings), its end',
    'failed': 'mend what the callback raises',
    'other topic': 'let the other topics of the sync come earlier: less work before them, or '
                   'deadlines for the callbacks that publish them',
    'never ended': 'mend the callback that has not ended: give what it waits for (a service, a '
                   'lock, a future) a timeout'}
ON_WORKERS = (WAITED, DEMOTED, LESS_IMPORTANT, DROPPED)
"""Causes for which a callback waited until a worker was free."""
WAITS = (*ON_WORKERS, INTERPRETER, GROUP, NEVER_ENDED, PROGRAM)
"""Causes for which a callback waited for others, which are named."""
DROPS = {'qos_depth': DROPPED, 'newer': DROPPED, 'destroyed': DESTROYED, 'withdrawn': WITHDRAWN}
"""By reason of a drop its cause; jobs are aborted because of an earlier miss: they *waited*."""
NO_MESSAGE = (DROPPED, DESTROYED, WITHDRAWN, NOT_PUBLISHED, LOST)
"""Causes for which a callback never ran."""
HANGS_NS = 1_000_000_000
_NOTHING_NS = 1_000_000
_ABOUT_BITS = 4     # up to a 16th above the usual time is usual

MISSED = np.dtype([
    ('kind', 'i8'), ('sink', 'i8'), ('job', 'i8'), ('release', 'i8'), ('until', 'i8'),
    ('at', 'i8'), ('in_job', 'i8'), ('length', 'i8'), ('demoted', 'i8'), ('outranked', '?')])
"""
Columns of a miss: ``at`` is the vertex that the job reached, ``in_job`` the job whose executions
completed it there (a later one, if a driven sync answered that one), ``length`` of its chain,
``demoted`` when it was demoted, ``outranked`` whether it could still have been in time then.
"""
PARTS_OF = np.dtype([
    ('miss', 'i8'), ('vertex', 'i8'), ('cause', 'i8'), ('begin', 'i8'), ('end', 'i8'),
    ('ns', 'i8'), ('place', 'i8')])
"""
Columns of a part of the time of a miss; ``cause`` is an index of ``PARTS``, ``place`` where the
callback ran (see ``Pool``).
"""
# A time span of a miss at a vertex: of a wait its group part, of an execution its CPU time.
_SPAN = np.dtype([
    ('miss', 'i8'), ('vertex', 'i8'), ('kind', 'i8'), ('begin', 'i8'), ('end', 'i8'),
    ('more', 'i8'), ('place', 'i8'), ('hangs', '?')])
_LAG, _BEFORE, _WAIT, _RUN, _TRANSPORT, _OTHER_TOPIC, _PENDING = range(7)


class Busy(NamedTuple):
    """
    What ran in a process.

    :ivar full: when all workers were busy.
    :ivar some: when any callback ran that may have held the GIL (a callback that lent its worker
        does not); ``shared``: when several held it.
    """

    full: Spans
    some: Spans
    shared: Spans


class Pool(NamedTuple):
    """
    What ran and what stalled during the misses.

    :ivar busy: by place what ran there, if it is a process.
    :ivar stalls: begin and end of each stall.
    :ivar knows_workers: whether the number of workers is known, and an idle one starts what is
        ready.
    :ivar place_of: by execution its place, whose callbacks may delay each other: its thread in a
        recording of another executor, else its process; ``place_of_vertex``: the same of the last
        execution of each vertex, -1: none.
    :ivar threads: by thread when callbacks ran in it; None: all places are processes.
    :ivar hangs: by execution whether it never ended, and had run for ``HANGS_NS``.
    :ivar blocked: by vertex when such an execution kept its callback group busy.
    :ivar programs: by vertex when callbacks of its program ran, if that runs one at a time, or
        when nothing of its program spun.
    :ivar gaps: by vertex when nothing in its process spun, so that no timer was noticed.
    :ivar answers: by execution whether a message of another topic than the driving one started it,
        of a driven sync.
    """

    busy: dict[int, Busy]
    stalls: list[tuple[int, int]]
    knows_workers: bool
    place_of: Ints
    place_of_vertex: Ints
    threads: dict[int, Spans] | None
    hangs: Mask
    blocked: dict[int, Spans]
    programs: dict[int, Spans]
    gaps: dict[int, Spans]
    answers: Mask

    def within(self, kind: str, spans: Table) -> Ints:
        """
        Return how much of each span a kind of ``Busy`` covers at its place, ns.

        Nothing is known of a place at which nothing ran.
        """
        covered = np.zeros(len(spans), dtype=np.int64)
        for place, busy in self.busy.items():
            mine = np.flatnonzero(spans['place'] == place)
            covered[mine] = getattr(busy, kind).within(spans['begin'][mine], spans['end'][mine])
        return covered


class Usual(NamedTuple):
    """
    Usual times.

    :ivar runs: by global vertex the execution time; ``cpu``: the CPU time.
    :ivar lags: by DAG the release lag.
    """

    runs: Ints
    cpu: Ints
    lags: Ints


STARTED = np.dtype([
    ('vertex', 'i4'), ('leg', 'i2'), ('job', 'i8'), ('ready', 'i8'), ('start', 'i8'),
    ('group', 'i8')])
"""Columns of a started execution; ``group``: how long it waited for its callback group, ns."""
DROPPED_RUNS = np.dtype([
    ('vertex', 'i4'), ('job', 'i8'), ('time', 'i8'), ('cause', 'i8'), ('aborted', '?')])
"""
Columns of a dropped execution: when it was dropped, and the cause of the miss that follows;
``aborted``: it was dropped with its job.
"""


class Never(NamedTuple):
    """
    What is known of executions that never ran.

    :ivar dropped: dropped executions, a table of ``DROPPED_RUNS``.
    :ivar dropped_at: by vertex when executions were dropped whose jobs are not recorded, and the
        causes of the misses that follow.
    :ivar started: executions that were started, a table of ``STARTED``.
    :ivar unpublished: by miss whether the callback before did not publish the message.
    :ivar is_driven: by vertex whether it is a driven sync.
    :ivar gone: by vertex when an entity that it lacked until the end was destroyed, ns; or never.
    :ivar knows_waiting: whether the executions that waited at the end are recorded: each process
        has ended in order.
    """

    dropped: Table
    dropped_at: dict[int, tuple[Ints, Ints]]
    started: Table
    unpublished: Mask
    is_driven: Mask
    gone: Ints
    knows_waiting: bool

    def drops_of(self, vertex: Ints, job: Ints) -> Ints:
        """Return the rows of ``dropped`` of vertices of jobs; -1: none."""
        return _last_of(self.dropped, vertex, job)

    def starts_of(self, vertex: Ints, job: Ints) -> Ints:
        """Return the rows of ``started`` of vertices of jobs; -1: none."""
        return _last_of(self.started, vertex, job)

    def causes(self, miss: Ints, vertex: Ints, job: Ints, begin: Ints, end: Ints) -> Ints:
        """Return why vertices of jobs of misses never ran, which did not wait at the end."""
        lost = np.where(self.gone[vertex] < end, DESTROYED, LOST)
        for each, (times, causes) in self.dropped_at.items():
            mine = np.flatnonzero(vertex == each)
            first, last = (np.searchsorted(times, time[mine]) for time in (begin, end))
            lost[mine[last > first]] = causes[first[last > first]]
        drop = self.drops_of(vertex, job)
        return np.where(drop >= 0, np.append(self.dropped['cause'], UNKNOWN)[drop], np.where(
            self.unpublished[miss], NOT_PUBLISHED, lost))

    def waiting(self, vertices: Ints, times: Ints) -> Ints:
        """Return by vertex the job whose execution waited at the given time, or -1."""
        jobs = np.full(len(vertices), -1)
        for vertex in distinct(vertices).tolist():
            mine = self.started[self.started['vertex'] == vertex]
            mine = mine[mine['ready'].argsort(kind='stable')]
            job, ready, start = mine['job'], mine['ready'], mine['start']
            latest = np.maximum.accumulate(start)
            asked = np.flatnonzero(vertices == vertex)
            before = as_of(ready, times[asked])
            asked, before = asked[before >= 0], before[before >= 0]
            waits = latest[before] > times[asked]
            last = np.maximum.accumulate(np.where(start == latest, np.arange(len(start)), 0))
            jobs[asked[waits]] = job[last[before[waits]]]
        return jobs

    def got(self, vertex: int, leg: int, jobs: Ints) -> Mask:
        """Return which jobs have started a vertex with the message of a leg."""
        started = self.started
        mine = (started['vertex'] == vertex) & (started['leg'] == leg)
        return np.isin(jobs, started['job'][mine])


def _last_of(table: Table, vertex: Ints, job: Ints) -> Ints:
    """Return the last rows of a table that have a vertex and job; -1: none."""
    wanted = np.isin(table['vertex'], distinct(vertex))
    backwards = np.append(np.flatnonzero(wanted)[::-1], -1)
    at, _ = equal_pairs(
        (table['vertex'][backwards[:-1]], table['job'][backwards[:-1]]), (vertex, job))
    found: Ints = backwards[at]
    return found


class Found(NamedTuple):
    """
    Misses (a table of ``MISSED``), their causes, and the parts of their times in order.

    :ivar too_short: misses whose deadline is shorter than the usual times.
    """

    misses: Table
    causes: Ints
    parts: Table
    too_short: Mask


def find(
    rows: Table, chain: Table, pool: Pool, usual: Usual, never: Never, dag_of: Ints,
    deadline: Ints, is_source: Any,
) -> Found:
    """
    Find the causes of misses.

    :param rows: a table of ``MISSED``; ``chain``: the links of their chains (``chains.LINKS``),
        one chain after the other, each from its end.
    :param dag_of: by global vertex its DAG; ``deadline``: its relative deadline as a sink.
    :param is_source: by global vertex whether it is its DAG's source.
    """
    spans = _spans(rows, chain, is_source, pool)
    kinds, of = spans['kind'], spans['miss']
    begins, ends = np.array(pool.stalls, dtype=np.int64).reshape(-1, 2).T
    stalls = Spans(begins, ends)
    stood = stalls.within(spans['begin'], spans['end'])
    left = spans['end'] - spans['begin'] - stood
    times = np.zeros((len(spans), len(PARTS)), dtype=np.int64)
    times[:, MACHINE] = stood
    for kind, part in ((_LAG, RELEASED_LATE), (_TRANSPORT, TRANSPORT), (_OTHER_TOPIC, OTHER_TOPIC),
                       (_BEFORE, UNKNOWN)):
        times[kinds == kind, part] = left[kinds == kind]
    lags = kinds == _LAG
    if pool.knows_workers:
        times[lags, WAITED] = np.minimum(
            left[lags], pool.within('full', spans[lags]))
        times[lags, RELEASED_LATE] -= times[lags, WAITED]
    times[lags, PROGRAM] = np.minimum(
        _overlap(spans[lags], pool.gaps), times[lags, RELEASED_LATE])
    times[lags, RELEASED_LATE] -= times[lags, PROGRAM]
    runs = kinds == _RUN
    normal = usual.runs[spans['vertex']]
    usually = np.where(left <= normal + (normal >> _ABOUT_BITS), left, normal)
    times[runs, RAN_USUALLY] = usually[runs]
    times[runs] += _ran_long(spans[runs], (left - usually)[runs], usual, pool)
    hangs = runs & spans['hangs']
    times[hangs, NEVER_ENDED] = times[hangs, RAN_LONG]
    times[hangs, RAN_LONG] = 0
    _pending(rows, spans, times, left, never, pool, is_source)
    # what kept the execution before a skipped release waiting meanwhile
    skips = times[:, SKIPPED] > 0
    instead = np.full(len(rows), WAITED)
    instead[of[skips]] = _waits(spans[skips], left[skips], pool, is_source).argmax(axis=1)
    waits = kinds == _WAIT
    if waits.any():
        times[waits] += _waits(spans[waits], left[waits], pool, is_source)
        demoted = np.maximum(0, spans['end'] - np.maximum(spans['begin'], rows['demoted'][of]))
        for part in (PROGRAM, WAITED, INTERPRETER):
            moved = np.where(waits, np.minimum(times[:, part], demoted), 0)
            times[:, part] -= moved
            times[:, DEMOTED] += np.where(rows['outranked'][of], 0, moved)
            times[:, LESS_IMPORTANT] += np.where(rows['outranked'][of], moved, 0)
            demoted -= moved
    total = np.zeros((len(rows), len(PARTS)), dtype=np.int64)
    np.add.at(total, of, times)
    sinks = rows['sink']
    unusual = total[:, :len(CAUSES)].copy()
    unusual[:, RELEASED_LATE] = np.maximum(0, total[:, RELEASED_LATE] - usual.lags[dag_of[sinks]])
    # the deadline is shorter than the usual times
    excess, lateness = unusual.sum(axis=1), rows['until'] - rows['release'] - deadline[sinks]
    short: Mask = (excess == 0) | ((rows['kind'] == SINK_LATE) & (excess < lateness))
    amounts = np.where(short[:, np.newaxis], total[:, :len(CAUSES)], unusual)
    amounts[short, RAN_LONG] += total[short, RAN_USUALLY]
    causes = _causes(rows, total, amounts, instead, pool, never, is_source)
    which, cause = np.nonzero(times)
    parts = table_of(PARTS_OF, len(which), cause=cause, ns=times[which, cause], **{
        name: spans[name][which] for name in ('miss', 'vertex', 'begin', 'end', 'place')})
    return Found(rows, causes, parts, short)


def _spans(rows: Table, chain: Table, is_source: Any, pool: Pool) -> Table:
    """Return the time spans of misses, each miss in order."""
    n, lengths = len(rows), rows['length']
    first = np.cumsum(lengths) - lengths
    of = np.repeat(np.arange(n), lengths)
    # last link of its chain, which comes first in the table
    is_last = np.zeros(len(chain), dtype=np.bool_)
    is_last[first[lengths > 0]] = True
    until = rows['until'][of]
    ready, start, end = chain['ready'], chain['start'], chain['end']
    after = np.where(is_last, until, np.r_[0, ready[:-1]])
    done = np.maximum(start, np.minimum(end, after))
    at = chain['vertex']
    after_vertex = np.where(is_last, rows['at'][of], np.r_[0, at[:-1]])
    waited_for = np.r_[False, pool.answers[chain['row'][:-1]]]  # when the next one was ready
    onward = np.where(is_last, _PENDING, np.where(waited_for, _OTHER_TOPIC, _TRANSPORT))
    some = lengths > 0
    begins = (first + lengths - 1)[some]
    whole = is_source[at[begins]]
    everyone = np.arange(n)

    def columns(*each: Any) -> Table:
        return table_of(_SPAN, len(each[0]), **dict(zip(_SPAN.names or (), each)))

    own = pool.place_of[chain['row']]
    spans = concatenate([
        columns(everyone[some], at[begins], np.where(whole, _LAG, _BEFORE),
                rows['release'][some], ready[begins], 0, own[begins]),
        columns(everyone[~some], rows['at'][~some], _PENDING, rows['release'][~some],
                rows['until'][~some], 0, pool.place_of_vertex[rows['at'][~some]]),
        columns(of, at, _WAIT, ready, start, chain['group'], own),
        columns(of, at, _RUN, start, done, chain['cpu'], own, pool.hangs[chain['row']]),
        columns(of, after_vertex, onward, done, after, 0, pool.place_of_vertex[after_vertex])])
    spans = spans[spans['end'] > spans['begin']]
    return spans[np.lexsort((spans['begin'], spans['miss']))]


def _ran_long(spans: Table, more: Ints, usual: Usual, pool: Pool) -> Ints:
    """Split the time beyond the usual execution times."""
    times = np.zeros((len(spans), len(PARTS)), dtype=np.int64)
    cpu, vertex = spans['more'], spans['vertex']
    computed = np.maximum(0, cpu - usual.cpu[vertex])
    starved = (cpu >= 0) & (2 * usual.cpu[vertex] >= usual.runs[vertex]) & (2 * computed < more)
    idle = np.where(starved, more - computed, 0)
    times[:, RAN_LONG] = more - idle
    times[:, INTERPRETER] = np.minimum(
        idle, pool.within('shared', spans))
    times[:, MACHINE] = idle - times[:, INTERPRETER]
    return times


def _waits(spans: Table, left: Ints, pool: Pool, is_source: Any) -> Ints:
    """Split the waiting time, without stalls."""
    times = np.zeros((len(spans), len(PARTS)), dtype=np.int64)
    times[:, GROUP] = np.minimum(spans['more'], left)
    left = left - times[:, GROUP]
    # of the waits for a group, those in which it was blocked for ever
    times[:, NEVER_ENDED] = np.minimum(times[:, GROUP], _overlap(spans, pool.blocked))
    times[:, GROUP] -= times[:, NEVER_ENDED]
    occupied = _overlap(spans, pool.programs)
    # the group is busy only while the program is
    times[:, PROGRAM] = np.clip(occupied - np.minimum(spans['more'], occupied), 0, left)
    left = left - times[:, PROGRAM]
    in_thread = np.zeros(len(spans), dtype=np.bool_) if pool.threads is None else ~np.isin(
        spans['place'], [*pool.busy])
    mine, others = np.flatnonzero(~in_thread), np.flatnonzero(in_thread)
    times[mine] = _waits_in_process(spans[mine], left[mine], times[mine], pool)
    times[others] = _waits_in_thread(spans[others], left[others], times[others], pool, is_source)
    return times


def _waits_in_thread(
    spans: Table, left: Ints, times: Ints, pool: Pool, is_source: Any
) -> Ints:
    """Split the rest of the waiting time in threads, which nothing else may delay."""
    threads = pool.threads or {}
    for thread in distinct(spans['place']).tolist():
        mine = np.flatnonzero(spans['place'] == thread)
        # without an execution its thread is unknown
        times[mine, WAITED] = left[mine] if thread not in threads else np.minimum(
            left[mine], threads[thread].within(spans['begin'][mine], spans['end'][mine]))
    idle, source = left - times[:, WAITED], is_source[spans['vertex']]
    times[:, RELEASED_LATE] = np.where(source, idle, 0)
    times[:, TRANSPORT] = np.where(source, 0, idle)
    return times


def _waits_in_process(spans: Table, left: Ints, times: Ints, pool: Pool) -> Ints:
    """Split the rest of the waiting time in processes, by what their workers did."""
    if not pool.knows_workers:
        times[:, WAITED] = left
        return times
    # where nothing ran, it is not known whose workers were busy
    times[:, WAITED] = np.where(np.isin(spans['place'], [*pool.busy]), np.minimum(
        left, pool.within('full', spans)), left)
    left = left - times[:, WAITED]
    some = pool.within('some', spans) - times[:, [WAITED, GROUP, NEVER_ENDED, PROGRAM]].sum(axis=1)
    times[:, INTERPRETER] = np.clip(some, 0, left)
    left = left - times[:, INTERPRETER]
    nothing = left >= _NOTHING_NS
    times[nothing, MACHINE] = left[nothing]
    times[~nothing, WAITED] += left[~nothing]
    return times


def _overlap(spans: Table, busy: dict[int, Spans]) -> Ints:
    """Return for how long of each span something of its vertex was busy; 0: nothing is known."""
    found = np.zeros(len(spans), dtype=np.int64)
    for vertex, runs in busy.items():
        mine = np.flatnonzero(spans['vertex'] == vertex)
        found[mine] = runs.within(spans['begin'][mine], spans['end'][mine])
    return found


def _pending(
    rows: Table, spans: Table, times: Ints, left: Ints, never: Never, pool: Pool, is_source: Any
) -> None:
    """
    Find what callbacks that never ran were pending for: they waited, or ``Never.causes``.

    A timer's skipped release waited if all workers were busy for most of the time; otherwise an
    execution before it waited, or it was noticed late.  The part of a dropped execution ends with
    the drop.  A recording that was cut off lacks the executions that waited then: they waited if a
    callback that never ended kept their group busy for most of the time.
    """
    which = np.flatnonzero(spans['kind'] == _PENDING)
    miss, vertex, begin, end = (
        spans[name][which] for name in ('miss', 'vertex', 'begin', 'end'))
    job, source, length = rows['in_job'][miss], is_source[vertex], end - begin
    start, drop = never.starts_of(vertex, job), never.drops_of(vertex, job)
    began, dropped = np.append(never.started['start'], 0)[start], drop >= 0
    waits = np.append(never.dropped['aborted'], False)[drop] | (start >= 0) & (
        np.append(never.started['ready'], 0)[start] < end) & (end <= began)
    # a driven sync with its driving message: the larger part of the time counts
    answerless = never.is_driven[vertex] & (start >= 0) & (began < end) & ~dropped
    waits |= answerless & (began - begin > end - began)
    group = np.minimum(np.append(never.started['group'], 0)[start], length)
    behind = np.where(source & ~dropped, never.waiting(vertex, end), -1)
    if pool.knows_workers:
        may_wait = np.flatnonzero(~waits & ~dropped & ~answerless & (
            (rows['kind'][miss] != SINK_EXPIRED) | source))
        full = pool.within('full', spans[which[may_wait]])
        waits[may_wait] = 2 * full >= length[may_wait]
    if never.knows_waiting:
        blocked = np.zeros(len(which), dtype=np.int64)
    else:
        blocked = np.where(waits | dropped | source | never.unpublished[miss], 0,
                           _overlap(spans[which], pool.blocked))
    waits |= 2 * blocked > length
    spans['kind'][which[waits]] = _WAIT
    spans['more'][which[waits]] = np.maximum(group, blocked)[waits]
    part = np.where(
        source & ~dropped,
        np.where(behind >= 0, SKIPPED, RELEASED_LATE),
        np.where(answerless, OTHER_TOPIC, never.causes(miss, vertex, job, begin, end)))
    other = which[~waits]
    times[other, part[~waits]] = left[other]
    ended = ~waits & dropped
    spans['end'][which[ended]] = np.minimum(end[ended], np.maximum(
        begin[ended], never.dropped['time'][drop[ended]]))


def delayed_by(rows: Table, stall: tuple[int, int]) -> Any:
    """Return which misses a stall or its backlog may have delayed."""
    begin, end = stall
    return (rows['release'] < 2 * end - begin) & (rows['until'] > begin)


def _causes(
    rows: Table, total: Ints, amounts: Ints, instead: Ints, pool: Pool, never: Never,
    is_source: Any,
) -> Ints:
    """
    Return the cause of each miss.

    :param amounts: the times that are compared.
    :param instead: the causes of skipped releases if the job that waited had no miss.
    """
    credit = np.zeros(len(rows), dtype=np.int64)    # time that the machine may have caused
    for stall in pool.stalls:
        credit[delayed_by(rows, stall)] += stall[1] - stall[0]
    after_stall = credit > 0
    for cause in (WAITED, INTERPRETER, GROUP, DEMOTED, LESS_IMPORTANT, RELEASED_LATE, TRANSPORT):
        moved = np.minimum(credit, amounts[:, cause])
        amounts[:, cause] -= moved
        amounts[:, MACHINE] += moved
        credit -= moved
    causes: Ints = amounts.argmax(axis=1)
    causes[rows['kind'] == SINK_FAILED] = FAILED
    given_up = np.flatnonzero(
        np.isin(rows['kind'], (SINK_EXPIRED, SINK_ABORTED))
        & ((total[:, [*NO_MESSAGE, SKIPPED]].sum(axis=1) > 0) | (amounts.max(axis=1) == 0)))
    causes[given_up] = _given_up(
        rows, given_up, causes, np.where(after_stall, MACHINE, RELEASED_LATE), instead, never,
        is_source)
    return causes


def _given_up(
    rows: Table, which: Ints, causes: Ints, skipped: Ints, instead: Ints, never: Never,
    is_source: Any,
) -> Ints:
    """
    Return the causes of misses whose jobs ended early.

    :param causes: of all misses.
    :param skipped: causes of skipped releases for which no execution waited.
    :param instead: causes of skipped releases if the job that waited had no miss at the sink: its
        result was not due, for instance.
    """
    found = causes[which]
    kind, job, at, release, until = (
        rows[name][which] for name in ('kind', 'in_job', 'at', 'release', 'until'))
    dropped = never.drops_of(at, job) >= 0
    skips = is_source[at] & ~dropped
    lost = ~skips & (dropped | (kind == SINK_EXPIRED))
    found[lost] = never.causes(which, at, job, release, until)[lost]
    found[skips] = skipped[which[skips]]
    before = never.waiting(at, until)
    waits = skips & (before >= 0) & (found != MACHINE)
    raised = rows['kind'] == SINK_FAILED     # a failure does not say why an execution waited
    same, _ = equal_pairs(
        (rows['sink'][~raised], rows['job'][~raised]),
        (rows['sink'][which[waits]], before[waits]))
    found[waits] = np.where(
        same >= 0, np.append(causes[~raised], UNKNOWN)[same], instead[which[waits]])
    return found
