# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The replay of long traces in compiled code: results as those of the plain one, sooner.

Theory of operation
-------------------
1. Events come as rows of numbers, a chunk at a time (``trace.columns``); ``fast_kernel`` goes
   through them.  Events that are no numbers (who is who, the end) go to the handlers that they
   have in the plain replay, in their order among the others.
2. What the core decides, and the misses that were recorded, are counted in Python, by the objects
   that count them in the plain replay; the sums are put into these objects at the end.
3. Whatever is not as an executor records it (times that run backwards, a DAG that is not there,
   numbers too large for 64 bits), is *declined*: the replay is begun anew, in plain Python, which
   says what is wrong.
4. Memory depends on the open jobs and on the sinks' completions: flows along paths that are over
   are counted and forgotten when their table is full (``path_flows``).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mddag_executor.core import NEVER
from mddag_executor.core.policies import POLICIES
from mddag_executor.core.state import JUDGE_FROM, State
from mddag_executor.replay import fast_work as fw
from mddag_executor.replay.batches import Batch, BatchWatcher
from mddag_executor.replay.chains import Breakdown, Step, Worst
from mddag_executor.replay.drift import WatchedRecording
from mddag_executor.replay.fast_arrays import Declined, grown, Header, make_work, Numbers
from mddag_executor.replay.fast_compile import entries
from mddag_executor.replay.follower import Event, Execution, Follower
from mddag_executor.replay.groups import RecordedGroups
from mddag_executor.replay.judge import Judge, Miss
from mddag_executor.replay.mapping import Mapping
from mddag_executor.replay.own_paths import OwnPaths
from mddag_executor.replay.recording import Recording, TASK_SET
from mddag_executor.replay.usage import Usage
from mddag_executor.simulate.compiled import Empty, Lent
from mddag_executor.trace.columns import Columns
import numpy as np

_MASK = 2 ** 64 - 1
_MDDAG = 'mddag:'         # events that name no entities
_HOSTED = 'mddag:hosted'
_JUDGE_FROM = 'mddag:judge_from'


class FastReplay:
    """
    Replays one trace of this executor.

    The other parameters are those of the plain replay, to which nothing has been told; they are
    filled in.
    """

    def __init__(
        self, recording: Recording, mapping: Mapping, judge: Judge, usage: Usage,
        follower: Follower, paths: OwnPaths, groups: RecordedGroups,
        watcher: BatchWatcher | None = None,
    ) -> None:
        self._watcher = watcher
        self._recording = recording
        self._watched = recording if isinstance(recording, WatchedRecording) else None
        self._mapping = mapping
        self._judge = judge
        self._usage = usage
        self._follower = follower
        self._paths = paths
        self._groups = groups
        self._do = entries()
        self._tables = Lent(judge.tables, list(POLICIES).index('rad'))
        self._state = Empty(len(State._fields))
        self._numbers = Numbers(mapping.task_set)
        self._work, self._header = self._use(
            make_work(mapping, judge, usage, paths, self._numbers))
        self._flows = self._numbers.flows(self._work)
        self._work.scalars[fw.WATCHED] = self._watched is not None
        self._group_numbers: dict[int, int] = {}
        self._known_callbacks: dict[int, tuple[int, int]] = {}
        self._known_publishers: dict[int, tuple[int, int]] = {}
        self._started = False
        self._stale = True      # what Python knows of callbacks and publishers may be new
        self._finished = False

    def _use(self, work: fw.Work) -> tuple[fw.Work, Header]:
        self._work = work
        self._header = Header(*work)
        return work, self._header

    def run(self, progress: Callable[[int], None] | None = None) -> None:
        """
        Replay.

        :raises Declined: where the plain replay should do it; what was filled in is of no use.
        """
        names = set(self._follower.handlers)
        if self._watched is not None:
            names |= self._watched.names()
        self._do['begin_run'](
            self._tables.address, self._state.address, self._judge.skip)
        try:
            count = 0
            for columns in self._recording.columns(names, fw.KINDS, self._do['scan']):
                self._advance(columns)
                count += len(columns.rows)
                if progress is not None:
                    progress(count)
            self._end()
        finally:
            self._do['free_core'](self._state.address)

    def _advance(self, columns: Columns) -> None:
        rows = columns.rows
        if not self._started and len(rows):
            self._begin(rows)
        self._use(self._work._replace(
            rows=rows, pieces=np.empty((len(rows), fw.N_PIECE), dtype=np.int64)))
        i = 0
        while i < len(rows):
            if rows[i, 1] == fw.OTHER:
                self._other(columns.others[rows[i, 2]])
                i += 1
                continue
            if self._stale:
                self._refresh()
            before = i
            i = self._do['advance'](
                self._tables.address, self._state.address, self._header.address, i)
            self._take_away(rows[before:i], before)
            status = self._work.scalars[fw.STATUS]
            if status == fw.DECLINED:
                raise Declined
            if status == fw.TOO_FULL:
                self._grow()

    def _grow(self) -> None:
        if self._paths.book:
            self._flows.make_room(self._work)
        executions = self._state.length(State._fields.index('x_slot'))
        self._use(grown(self._work, executions, self._do['copy_table']))

    def _begin(self, rows: Any) -> None:
        """Learn the process's id from the first events; another one's are declined."""
        numbers = rows[rows[:, 1] != fw.OTHER]
        if len(numbers):
            self._work.scalars[fw.PROCESS_ID] = numbers[0, 3]
            self._started = True

    def _take_away(self, rows: Any, first: int) -> None:
        """
        Count what has been decided, and missed, and ran.

        :param rows: the events that were gone through, of which the first has that number.
        """
        scalars = self._work.scalars
        decisions: Any = self._state.rows(State._fields.index('decisions'), 6)
        if decisions:
            self._judge.tally.add(decisions)
        for side, *miss in self._work.misses[:scalars[fw.N_MISSES]].tolist():
            self._judge.differ(Miss(*miss), side)
        n = scalars[fw.N_PIECES]
        pieces = self._work.pieces[:n]
        if n:
            self._usage.pool.add_many(pieces[:, fw.R_START], pieces[:, fw.R_END])
        if self._watcher is not None:
            self._tell(self._watcher, pieces, decisions, rows, first)

    def _tell(
        self, watcher: BatchWatcher, pieces: Any, decisions: Any, rows: Any, first: int
    ) -> None:
        """Tell who watches."""
        places = np.flatnonzero(rows[:, 1] == fw.RELEASE) if len(rows) else np.empty(0, np.int64)
        releases = rows[places, 4:7] if len(rows) else np.empty((0, 3), dtype=np.int64)
        releases[:, 0] = self._work.map_dag[releases[:, 0]]
        known = releases[:, 0] >= 0
        watcher.take(Batch(
            pieces[:, :fw.R_AT], releases[known],
            np.searchsorted(pieces[:, fw.R_AT], places[known] + first), decisions,
            np.searchsorted(pieces[:, fw.R_DECIDED], np.arange(len(decisions)), side='right')))

    # --- events for Python -----------------------------------------------------------------------

    def _other(self, event: Event) -> None:
        name = event[0]
        if None in event or name in fw.KINDS:
            raise Declined
        if self._watched is not None:
            if name == 'ros2:rcl_publisher_init':
                self._tell_published()      # a handle that is used again means another one
            self._watched.take(event)
            if name != TASK_SET:
                self._work.scalars[fw.LAST] = max(self._work.scalars[fw.LAST], event[1])
        follower, scalars = self._follower, self._work.scalars
        handler = follower.handlers.get(name)
        if handler is None:
            return
        follower.end = int(scalars[fw.FINISH])
        handler(event)
        scalars[fw.FINISH] = follower.end
        scalars[fw.SHUT_DOWN] = follower.shut_down
        if follower.strange:
            raise Declined
        if name == _HOSTED:
            for column, values in self._judge.expected.items():
                self._state.write(State._fields.index(column), values)
        elif name == _JUDGE_FROM:
            scalars_field = State._fields.index('scalars')
            numbers = [number for number, in self._state.rows(scalars_field, 1)]
            numbers[JUDGE_FROM] = self._judge.judge_from
            self._state.write(scalars_field, numbers)
        if follower.shut_down and not self._finished:
            self._finish(follower.end)
        self._stale = self._stale or not name.startswith(_MDDAG)

    def _refresh(self) -> None:
        """Tell the compiled code what is known of callbacks and publishers."""
        self._stale = False
        groups = self._groups.by_callback()
        topics = self._paths.topic_of if self._paths.book else dict[int, str]()
        for callback in {**groups, **topics}:
            group = groups.get(callback, -1)
            number = 0 if group < 0 else \
                1 + self._group_numbers.setdefault(group, len(self._group_numbers))
            topic = self._numbers.topic(topics.get(callback, ''))
            if self._known_callbacks.get(callback) == (number, topic):
                continue
            self._known_callbacks[callback] = number, topic
            self._make_room()
            for column, value in ((fw.C_GROUP, number), (fw.C_TOPIC, topic)):
                self._do['set_callback'](self._header.address, _signed(callback), column, value)
        while len(self._group_numbers) > len(self._work.group_count):
            self._use(self._work._replace(
                group_busy=np.concatenate([self._work.group_busy] * 2),
                group_count=np.concatenate(
                    [self._work.group_count, np.zeros_like(self._work.group_count)])))
        if self._paths.book:
            self._work.scalars[fw.ANY_PUBLISHED] = self._paths.any_published
            for address, topic, node in self._numbers.publishers(self._paths):
                if self._known_publishers.get(address) != (topic, node):
                    self._known_publishers[address] = topic, node
                    self._make_room()
                    self._do['set_publisher'](
                        self._header.address, _signed(address), topic, node)

    def _make_room(self) -> None:
        work = self._work
        if (2 * work.counts[fw.CALLBACKS] + 4 >= len(work.callbacks)
                or 2 * work.counts[fw.PUBLISHERS] + 4 >= len(work.publishers)):
            self._grow()

    # --- the end ---------------------------------------------------------------------------------

    def _finish(self, now: int) -> None:
        self._finished = True
        if not self._do['finish_run'](
                self._tables.address, self._state.address, self._header.address, now):
            raise Declined
        self._take_away(np.empty((0, 1), dtype=np.int64), 0)

    def _end(self) -> None:
        """Put the sums where the plain replay has them."""
        follower, scalars = self._follower, self._work.scalars
        follower.end = int(scalars[fw.FINISH])
        if not follower.shut_down:
            if follower.end == 0:
                follower.end = min(max(0, self._recording.head.time), NEVER - 1)
            self._finish(follower.end)
        begin = int(scalars[fw.BEGIN])
        follower.start = None if begin < 0 else begin
        follower.jobs = int(scalars[fw.JOBS])
        judge = self._judge
        judge.contradictions = int(scalars[fw.CONTRADICTIONS])
        judge.n_recorded = int(scalars[fw.N_RECORDED])
        for dag, count in enumerate(self._work.released.tolist()):
            judge.tally.jobs[dag] += count
        self._end_sinks()
        self._end_use()
        if self._watched is not None:
            self._tell_published()
            self._end_watched(self._watched)
        if self._paths.book:
            self._flows.finish(self._work)
            self._paths.flows = self._flows

    def _end_sinks(self) -> None:
        width = len(self._work.walk)
        for vertex, times in self._judge.chains.sinks.items():
            row = self._work.sinks[vertex].tolist()
            times.completed = row[fw.B_COMPLETED]
            if not times.completed:
                continue
            times.sums = row[fw.B_LAG:fw.B_UNKNOWN + 1]
            times.group = row[fw.B_GROUP]
            steps = self._work.worst[vertex * width:vertex * width + row[fw.W_STEPS]].tolist()
            times.worst = Worst(
                row[fw.W_JOB], row[fw.W_RELEASE], row[fw.W_COMPLETED],
                [Step(step[0], step[fw.K_LEG], Execution(*step[fw.K_READY:fw.K_BUSY + 1]),
                      step[fw.K_GROUP]) for step in steps],
                Breakdown(*row[fw.W_PARTS:fw.W_PARTS + 6]))

    def _end_use(self) -> None:
        for use, row in zip(self._usage.every(), self._work.use.tolist()):
            use.executions, use.busy, use.longest = row[fw.U_RAN:fw.U_LONGEST + 1]
            use.waiting, use.longest_wait = row[fw.U_WAITING:fw.U_LONGEST_WAIT + 1]
            use.group = row[fw.U_GROUP]
        for worker, (took, ran) in enumerate(self._work.workers.tolist()):
            if ran:
                self._usage.by_worker[worker - 1] = took

    def _tell_published(self) -> None:
        """Tell which callbacks have published what, and forget it."""
        pairs = self._work.pairs
        pid = int(self._work.scalars[fw.PROCESS_ID])
        if self._watched is not None:
            for callback, publisher in pairs[pairs[:, 4] != 0, :2].tolist():
                self._watched.published((pid, callback & _MASK), (pid, publisher & _MASK))
        pairs[:] = 0
        self._work.counts[fw.PAIRS] = 0

    def _end_watched(self, watched: WatchedRecording) -> None:
        work, pid = self._work, int(self._work.scalars[fw.PROCESS_ID])
        rows = work.callbacks[work.callbacks[:, 4] != 0].tolist()
        rows.sort(key=lambda row: row[fw.C_ORDER])
        watched.counted(
            {(pid, row[0] & _MASK): row[fw.C_RAN] for row in rows if row[fw.C_RAN]},
            {(pid, row[0] & _MASK): (row[fw.C_DAG] - 1, row[fw.C_VERTEX] - 1)
             for row in rows if row[fw.C_DAG]},
            work.releases.tolist(), int(work.scalars[fw.FIRST]), int(work.scalars[fw.LAST]))


def _signed(number: int) -> int:
    return number - 2 ** 64 if number >= 2 ** 63 else number
