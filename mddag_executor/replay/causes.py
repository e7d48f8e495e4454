# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Why deadlines were missed: the parts of the time of each such job, and the one cause among them.

Theory of operation
-------------------
The time of a job, from its release to its completion at the sink (or until it was given up), goes
along its critical chain (see ``chains``).  Each piece of it is split:

* what overlaps a stall (see ``stalls``) is the *machine*'s;
* before the source is ready the job is *released late*;
* a callback that is ready waits: for its *group*, as far as another of the group ran; else it
  *waited* as far as all workers were busy; else, with a free worker, for the *interpreter* as far
  as something else ran; and where nothing ran though a worker was free, for the *machine*;
* a callback that runs *ran*, and *ran long* beyond what is usual: its own median, or the longest
  time that is declared, if that is less.  Where its CPU time is recorded, and it computes but did
  not compute longer than usual, it had to share the *interpreter* as far as others held it, too,
  and else the *machine* gave it no CPU;
* *transport* is from the end of a callback until the next one is ready;
* a job that was given up waits for a callback that never ran: its message is *lost*, unless it was
  ready and waited.

The cause of a miss is that of which there is most, beyond what is usual.  Two rules go before:

* What waited while, or soon after, the machine stood still had to wait for the backlog: up to the
  length of the stalls it counts as the machine's.
* If all of that together is less than the lateness, the usual times are too long for the deadline,
  and they count, too: what callbacks usually take as *ran long*.

A job whose callback raised has *failed*; one that expired for want of a message has *lost* it.
Where a timer's release was skipped because the callback still waited for the one before, that
one's cause is its cause, too; if that one was in time, the job *waited*.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from mddag_executor.core.state import SINK_ABORTED, SINK_EXPIRED, SINK_FAILED, SINK_LATE
from mddag_executor.replay.chains import (
    L_CPU,
    L_END,
    L_GROUP,
    L_READY,
    L_START,
    L_VERTEX,
    M_AT,
    M_JOB,
    M_KIND,
    M_LENGTH,
    M_RELEASE,
    M_SINK,
    M_UNTIL,
    Misses,
)
from mddag_executor.replay.happenings import Ints
from mddag_executor.replay.stalls import Spans
import numpy as np

CAUSES = ('waited', 'ran long', 'interpreter', 'group', 'released late', 'transport', 'machine',
          'lost', 'failed')
(WAITED, RAN_LONG, INTERPRETER, GROUP, RELEASED_LATE, TRANSPORT, MACHINE, LOST, FAILED,
 RAN_USUALLY, UNKNOWN) = range(11)
#: What a part of a job's time may be; the last two are no causes.
PARTS = (*CAUSES, 'ran', 'unknown')
#: What is done about it.
REMEDIES = {
    'waited': 'more workers, or shorter callbacks before it',
    'ran long': 'make the callback shorter, or declare the time that it takes',
    'interpreter': 'give the nodes processes of their own, or release the lock while computing',
    'group': 'give the callback a group of its own, or a reentrant one',
    'released late': 'look at the timer, or at the way of the message from its sensor',
    'transport': 'let the nodes share a process, or send smaller messages',
    'machine': 'free the CPUs of other work, pin the workers, or take a machine that does not '
               'stand still',
    'lost': 'if a process ended early (see the warnings), its end; else a longer queue (QoS '
            'depth), reliable QoS, or a publisher that always publishes',
    'failed': 'mend what the callback raises'}
_NOTHING_NS = 1_000_000
_ABOUT_BITS = 4     # up to a 16th more is usual, too
# Columns of parts.
P_MISS, P_VERTEX, P_CAUSE, P_BEGIN, P_END, P_NS, N_PART = range(7)
_WAITS = (WAITED, INTERPRETER, GROUP)


class Pool(NamedTuple):
    """
    What ran and stood still in the time that is looked at.

    :ivar full: when all workers were busy; ``some``: when anything ran that may have held the
        interpreter (a callback that lent its worker waits); ``shared``: when several did hold it.
    :ivar stalls: begin and end of each.
    :ivar knows_workers: whether the number of workers is known, and an idle one takes what is
        ready.
    """

    full: Spans
    some: Spans
    shared: Spans
    stalls: list[tuple[int, int]]
    knows_workers: bool


class Usual(NamedTuple):
    """
    What is usual.

    :ivar runs: by global vertex how long it runs; ``cpu``: how long it computes.
    :ivar lags: by DAG how late its release is seen.
    """

    runs: Ints
    cpu: Ints
    lags: Ints


class Never(NamedTuple):
    """
    What is known of what never ran.

    :ivar dropped: by vertex and job, why its execution was dropped.
    :ivar started: executions that were started: vertex, job, ready, start.
    """

    dropped: dict[tuple[int, int], str]
    started: Ints

    def waiting(self, vertices: Ints, times: Ints) -> Ints:
        """Return of each vertex the job whose execution waited at the time beside it, or -1."""
        jobs = np.full(len(vertices), -1)
        for vertex in np.unique(vertices).tolist():
            mine = self.started[self.started[:, 0] == vertex, 1:]
            job, ready, start = mine[mine[:, 1].argsort()].T
            latest = np.maximum.accumulate(start)
            asked = np.flatnonzero(vertices == vertex)
            before = np.searchsorted(ready, times[asked], 'right') - 1
            asked, before = asked[before >= 0], before[before >= 0]
            waits = latest[before] > times[asked]
            last = np.maximum.accumulate(np.where(start == latest, np.arange(len(start)), 0))
            jobs[asked[waits]] = job[last[before[waits]]]
        return jobs


class Found(NamedTuple):
    """
    Misses (rows as in ``Misses``), their causes, and the parts of their times in order.

    :ivar too_short: of which misses the deadline is too short for what is usual.
    """

    misses: Ints
    causes: Ints
    parts: Ints
    too_short: Any


def find(
    misses: Misses, pool: Pool, usual: Usual, never: Never, dag_of: Ints, deadline: Ints,
    is_source: Any,
) -> Found:
    """
    Find the causes of misses.

    :param dag_of: by global vertex its DAG; ``deadline``: its relative deadline as a sink.
    :param is_source: by global vertex whether it is its DAG's source.
    """
    rows, chain = misses
    spans = _spans(rows, chain, is_source)
    kinds, of = spans[:, _S_KIND], spans[:, _S_MISS]
    begins, ends = np.array(pool.stalls, dtype=np.int64).reshape(-1, 2).T
    stalls = Spans(begins, ends)
    stood = stalls.within(spans[:, _S_BEGIN], spans[:, _S_END])
    left = spans[:, _S_END] - spans[:, _S_BEGIN] - stood
    times = np.zeros((len(spans), len(PARTS)), dtype=np.int64)
    times[:, MACHINE] = stood
    for kind, part in ((_LAG, RELEASED_LATE), (_TRANSPORT, TRANSPORT), (_BEFORE, UNKNOWN)):
        times[kinds == kind, part] = left[kinds == kind]
    runs = kinds == _RUN
    normal = usual.runs[spans[:, _S_VERTEX]]
    usually = np.where(left <= normal + (normal >> _ABOUT_BITS), left, normal)
    times[runs, RAN_USUALLY] = usually[runs]
    times[runs] += _ran_long(spans[runs], (left - usually)[runs], usual, pool)
    _pending(rows, spans, times, left, never, pool)
    waits = kinds == _WAIT
    if waits.any():
        times[waits] += _waits(spans[waits], left[waits], pool)
    total = np.zeros((len(rows), len(PARTS)), dtype=np.int64)
    np.add.at(total, of, times)
    sinks = rows[:, M_SINK]
    unusual = _unusual(total, usual.lags[dag_of[sinks]])
    short = _too_short(rows, unusual.sum(axis=1), deadline[sinks])
    amounts = np.where(short[:, np.newaxis], total[:, :len(CAUSES)], unusual)
    amounts[short, RAN_LONG] += total[short, RAN_USUALLY]
    causes = _causes(rows, total, amounts, pool, never, is_source)
    which, cause = np.nonzero(times)
    parts = np.column_stack((
        spans[which][:, [_S_MISS, _S_VERTEX]], cause, spans[which][:, [_S_BEGIN, _S_END]],
        times[which, cause]))
    return Found(rows, causes, parts, short)


# A span of time of a miss, at a vertex; of a wait how much of it was for the group, of a run its
# CPU time.
_S_MISS, _S_VERTEX, _S_KIND, _S_BEGIN, _S_END, _S_MORE = range(6)
_LAG, _BEFORE, _WAIT, _RUN, _TRANSPORT, _PENDING = range(6)


def _spans(rows: Ints, chain: Ints, is_source: Any) -> Ints:
    """Return the spans of time that misses went through, each in order."""
    n, lengths = len(rows), rows[:, M_LENGTH]
    first = np.cumsum(lengths) - lengths
    of = np.repeat(np.arange(n), lengths)
    is_last = np.zeros(len(chain), dtype=np.bool_)      # of its chain: it stands first
    is_last[first[lengths > 0]] = True
    until = rows[of, M_UNTIL]
    ready, start, end = chain[:, L_READY], chain[:, L_START], chain[:, L_END]
    after = np.where(is_last, until, np.r_[0, ready[:-1]])
    done = np.maximum(start, np.minimum(end, after))
    at = chain[:, L_VERTEX]
    after_vertex = np.where(is_last, rows[of, M_AT], np.r_[0, at[:-1]])
    onward = np.where(is_last & (after_vertex != at), _PENDING, _TRANSPORT)
    some = lengths > 0
    begins = (first + lengths - 1)[some]
    whole = is_source[at[begins]]
    everyone, nothing = np.arange(n), np.zeros(n, dtype=np.int64)

    def columns(*each: Any) -> Ints:
        return np.column_stack(np.broadcast_arrays(*each))

    spans = np.concatenate([
        columns(everyone[some], at[begins], np.where(whole, _LAG, _BEFORE),
                rows[some, M_RELEASE], ready[begins], 0),
        columns(everyone[~some], rows[~some, M_AT], _PENDING, rows[~some, M_RELEASE],
                rows[~some, M_UNTIL], nothing[~some]),
        columns(of, at, _WAIT, ready, start, chain[:, L_GROUP]),
        columns(of, at, _RUN, start, done, chain[:, L_CPU]),
        columns(of, after_vertex, onward, done, after, 0)])
    spans = spans[spans[:, _S_END] > spans[:, _S_BEGIN]]
    return spans[np.lexsort((spans[:, _S_BEGIN], spans[:, _S_MISS]))]


def _ran_long(spans: Ints, more: Ints, usual: Usual, pool: Pool) -> Ints:
    """Split the time for which callbacks ran longer than usual."""
    times = np.zeros((len(spans), len(PARTS)), dtype=np.int64)
    cpu, vertex = spans[:, _S_MORE], spans[:, _S_VERTEX]
    computed = np.maximum(0, cpu - usual.cpu[vertex])
    starved = (cpu >= 0) & (2 * usual.cpu[vertex] >= usual.runs[vertex]) & (2 * computed < more)
    idle = np.where(starved, more - computed, 0)
    times[:, RAN_LONG] = more - idle
    times[:, INTERPRETER] = np.minimum(
        idle, pool.shared.within(spans[:, _S_BEGIN], spans[:, _S_END]))
    times[:, MACHINE] = idle - times[:, INTERPRETER]
    return times


def _waits(spans: Ints, left: Ints, pool: Pool) -> Ints:
    """Split the time for which callbacks waited, but for stalls."""
    times = np.zeros((len(spans), len(PARTS)), dtype=np.int64)
    times[:, GROUP] = np.minimum(spans[:, _S_MORE], left)
    left = left - times[:, GROUP]
    if not pool.knows_workers:
        times[:, WAITED] = left
        return times
    begins, ends = spans[:, _S_BEGIN], spans[:, _S_END]
    times[:, WAITED] = np.minimum(left, pool.full.within(begins, ends))
    left = left - times[:, WAITED]
    some = pool.some.within(begins, ends) - times[:, WAITED] - times[:, GROUP]
    times[:, INTERPRETER] = np.clip(some, 0, left)
    left = left - times[:, INTERPRETER]
    nothing = left >= _NOTHING_NS
    times[nothing, MACHINE] = left[nothing]
    times[~nothing, WAITED] += left[~nothing]
    return times


def _pending(
    rows: Ints, spans: Ints, times: Ints, left: Ints, never: Never, pool: Pool
) -> None:
    """Find out what became of the callbacks that never ran; they wait or are lost."""
    open_ones = np.flatnonzero(spans[:, _S_KIND] == _PENDING).tolist()
    started = never.started if open_ones else never.started[:0]
    ready = dict(zip(zip(*started[:, :2].T.tolist()), started[:, 2].tolist()))
    for i in open_ones:
        miss, vertex, _, begin, end, _ = spans[i].tolist()
        key = vertex, int(rows[miss, M_JOB])
        waits = never.dropped.get(key) == 'aborted' or ready.get(key, end) < end
        if not waits and key not in never.dropped and rows[miss, M_KIND] != SINK_EXPIRED:
            full, = pool.full.within(*(np.array([each]) for each in (begin, end)))
            waits = pool.knows_workers and 2 * int(full) >= end - begin
        if waits:
            spans[i, _S_KIND] = _WAIT
        else:
            times[i, LOST] = left[i]


def _unusual(total: Ints, lags: Ints) -> Ints:
    """Return of each miss the times by cause, beyond what is usual."""
    amounts: Ints = total[:, :len(CAUSES)].copy()
    amounts[:, RELEASED_LATE] -= np.minimum(amounts[:, RELEASED_LATE], lags)
    return amounts


def _too_short(rows: Ints, unusual: Ints, deadline: Ints) -> Any:
    """Return of which misses the deadline is too short for what is usual."""
    lateness = rows[:, M_UNTIL] - rows[:, M_RELEASE] - deadline
    return (unusual == 0) | ((rows[:, M_KIND] == SINK_LATE) & (unusual < lateness))


def delayed_by(rows: Ints, stall: tuple[int, int]) -> Any:
    """Return which misses a stall, or the backlog after it, may have delayed."""
    begin, end = stall
    return (rows[:, M_RELEASE] < 2 * end - begin) & (rows[:, M_UNTIL] > begin)


def _causes(
    rows: Ints, total: Ints, amounts: Ints, pool: Pool, never: Never, is_source: Any
) -> Ints:
    """Return the cause of each miss; ``amounts`` are the times that count for it."""
    credit = np.zeros(len(rows), dtype=np.int64)    # what the machine may have delayed
    for stall in pool.stalls:
        credit[delayed_by(rows, stall)] += stall[1] - stall[0]
    after_stall = credit > 0
    for cause in (WAITED, INTERPRETER, GROUP, RELEASED_LATE, TRANSPORT):
        moved = np.minimum(credit, amounts[:, cause])
        amounts[:, cause] -= moved
        amounts[:, MACHINE] += moved
        credit -= moved
    causes: Ints = amounts.argmax(axis=1)
    causes[rows[:, M_KIND] == SINK_FAILED] = FAILED
    given_up = np.flatnonzero(
        np.isin(rows[:, M_KIND], (SINK_EXPIRED, SINK_ABORTED))
        & ((total[:, LOST] > 0) | (amounts.max(axis=1) == 0)))
    causes[given_up] = _given_up(
        rows, given_up, causes, np.where(after_stall, MACHINE, RELEASED_LATE), never, is_source)
    return causes


def _given_up(
    rows: Ints, which: Ints, causes: Ints, skipped: Ints, never: Never, is_source: Any
) -> Ints:
    """
    Return the causes of some misses whose jobs were given up.

    :param causes: of all misses.
    :param skipped: their causes if their releases were skipped, and nothing waited.
    """
    found = causes[which]
    kind, job, at, until = rows[which][:, [M_KIND, M_JOB, M_AT, M_UNTIL]].T
    dropped = np.array(
        [key in never.dropped for key in zip(at.tolist(), job.tolist())], dtype=np.bool_)
    skips = is_source[at] & ~dropped
    found[~skips & (dropped | (kind == SINK_EXPIRED))] = LOST
    found[skips] = skipped[which[skips]]
    before = never.waiting(at, until)
    waits = skips & (before >= 0) & (found != MACHINE)
    raised = rows[:, M_KIND] == SINK_FAILED     # which does not say why something waited
    of = dict(zip(zip(*rows[~raised][:, [M_SINK, M_JOB]].T.tolist()), causes[~raised].tolist()))
    found[waits] = [of.get(key, WAITED) for key in zip(
        rows[which[waits], M_SINK].tolist(), before[waits].tolist())]
    return found


def behind(
    parts: Ints, chosen: Ints, runs: dict[int, Spans], on_workers: dict[int, Spans],
    same_group: Any,
) -> dict[int, list[tuple[int, int]]]:
    """
    Return by part the callbacks behind which it waited, and how long each ran, longest first.

    :param chosen: the numbers of the parts.
    :param runs: by callback when it ran; ``on_workers``: when it kept a worker busy by that.
    :param same_group: returns of a vertex and a callback whether they share a group.
    """
    found: dict[int, list[tuple[int, int]]] = {}
    if not len(chosen) or not runs:
        return found
    names = list(runs)
    begins, ends = parts[chosen, P_BEGIN], parts[chosen, P_END]
    times = np.array([each.within(begins, ends) for each in runs.values()])
    waited = parts[chosen, P_CAUSE] == WAITED
    times[:, waited] = [
        each.within(begins[waited], ends[waited]) for each in on_workers.values()]
    grouped = np.flatnonzero(parts[chosen, P_CAUSE] == GROUP)
    for vertex in np.unique(parts[chosen[grouped], P_VERTEX]).tolist():
        others = [i for i, callback in enumerate(names) if not same_group(vertex, callback)]
        mine = grouped[parts[chosen[grouped], P_VERTEX] == vertex]
        times[np.ix_(others, mine)] = 0
    for part, column in zip(chosen.tolist(), times.T):
        order = np.argsort(-column, kind='stable')[:MOST_BEHIND].tolist()
        found[part] = [(names[i], int(column[i])) for i in order if column[i] > 0]
    return found


MOST_BEHIND = 5


def to_explain(found: Found) -> Ints:
    """Return the parts for which to find what they waited behind."""
    parts, rows = found.parts, found.misses
    share = 10 * parts[:, P_NS] >= (rows[:, M_UNTIL] - rows[:, M_RELEASE])[parts[:, P_MISS]]
    which: Ints = np.flatnonzero(np.isin(parts[:, P_CAUSE], _WAITS) & share)
    return which
