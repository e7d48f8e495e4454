# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A second simulator, slow and plain, to compare the core with.

It was written from the project's documents (the model, its rules, and the behaviour of the paper's
own program), not from the core, with which it shares no code.  It goes tick by tick through time,
keeps all waiting executions in one unsorted list, and computes everything again each time.

Its reading of the documents:

* At one instant, completions are handled first, by ascending number of the worker.  Each of them
  makes its successors ready, the last one in the list first.  Then releases are handled, in the
  order of the DAGs.  Then executions are started, one by one, as long as one can be started.
  Executions start only at instants at which something happened.  A preempted execution goes to the
  end of the list.
* If a job is released while ``max_active_jobs`` jobs of its DAG are open, the oldest of these
  expires.  Its executions that are ready or running go on, without consequences.
* The executions that wait at a vertex and have never run are the queue of the vertex.  The one
  with the smallest key is the head of the queue, and runs first.  The queue has a place among
  everything that waits: the smallest key of all executions that have been in the queue since one
  of it ran last.  Executions that were dropped since then count as well.
* ``demote`` (``rad``, ``gedf``, ``llf``): suppose that the head would start next, that every
  vertex on the longest path takes its mean time, and that the head is then late for a deadline
  that it leads to.  Then the queue gets the place of its first execution that can be in time, with
  the deadlines that this one can meet (``rad``, ``llf``). If the mean times of all vertices
  together need more than the workers, the executions before it in the queue take their time as
  well.  If no execution can be in time, the queue is ordered as if the job of its head were
  released six relative deadlines later, until one of its executions runs; so are the later
  vertices of that job, and those of a job whose execution is the one that runs.  Once a head was
  late, the queue has no later place than that until one of its executions runs, even if others can
  be in time.  A preempted execution is a queue by itself.
* Suppose that the head of a queue would start next, but another execution of its group has begun
  and not ended.  Then that one has its priority until it ends.  It is not looked at again before
  its place changes, or it is the first one of those that wait when the group is free.
* ``keep: newest`` at a source or sink: of two executions in a queue, the one of the earlier job is
  dropped.  With ``demote``, an execution of a timer that can make none of the deadlines that it
  leads to is dropped when a later one becomes ready.  If a late execution is dropped, its queue
  stays late by the same time.
* ``ros2`` goes by rounds.  When a worker is free and the round has no execution left that it could
  start, the next round begins: the first waiting execution of each callback.  The worker goes
  through the round by kind (timers, subscriptions and syncs, services), then by the callback's
  place in the file.  It leaves an execution out of the round if the execution is blocked when its
  turn comes.  If all executions of a round are blocked, the search ends until something happens.
* ``picas``: a vertex belongs to the path to the sink with the least deadline that it leads to.
  Paths are ordered by that deadline, the period and the index of the DAG; on one path, later
  vertices go first.  A callback with several vertices has the priority of the first of them.
"""

from dataclasses import dataclass, field
from fractions import Fraction
import functools
import math

from msg_graph import Dag, Vertex


def reachable_sinks(dag, index):
    """Return the sinks that a vertex leads to, itself included."""
    successors = dag.vertices[index].successors
    if not successors:
        return {index}
    return set().union(*(reachable_sinks(dag, after) for after in successors))


def paths(dag, index):
    """Yield every path from a vertex to a sink."""
    vertex = dag.vertices[index]
    for after in vertex.successors:
        for path in paths(dag, after):
            yield [vertex, *path]
    if not vertex.successors:
        yield [vertex]


def depth(dag, index):
    """Return how many vertices are on the longest path from the source to a vertex."""
    before = dag.vertices[index].predecessors
    return 1 + max((depth(dag, one) for one in before), default=0)


def mean(vertex):
    declared = vertex.callback.execution_time
    return 0 if declared is None else declared.mean_ns


def laxity(dag, index, sink):
    """Return the deadline of a sink less the mean times of the longest path to it, in ns."""
    return (dag.vertices[sink].deadline_ns or 0) - max(
        sum(map(mean, path)) for path in paths(dag, index) if path[-1].index == sink)


@dataclass(eq=False)
class Job:
    """A job with its sinks' verdicts."""

    dag: Dag
    index: int
    release: int
    done: set[int] = field(default_factory=set)
    outcome: str | None = None
    late: bool = False
    demoted: int | None = None  # the release that counts after that, ns


@dataclass(eq=False)
class Execution:
    """A vertex of a job that is ready or runs."""

    job: Job
    vertex: Vertex
    left: int
    arrival: int
    has_run: bool = False
    lowered: int | None = None  # its priority, if it was preempted and then demoted
    urged: int | None = None  # the least priority of what waits for its group
    running_as: int = 0  # the priority with which it was started


class BruteForce:
    """
    One simulated run; ``misses`` and ``result()`` are its results.

    :ivar events: (tick, 'start' | 'end' | 'preempt', worker, DAG, vertex in its DAG, job).
    """

    def __init__(self, case, horizon, tick, judge, stop, last_release):
        self.case = case
        self.dags = case.task_set.dags
        self.policy = case.policy
        self.tick = tick
        self.running = [None] * case.workers
        self.waiting = []
        # by DAG and vertex: the place of the queue, and the release by which it is late
        self.places = {}
        self.demoted = {}
        # the queues that wait for their group, and their places when they came first
        self.aside = {}
        self.round = []
        self.jobs = []
        self.events = []
        self.misses = []
        self.counts = {
            (dag.index, sink): dict.fromkeys(
                ('completed', 'late', 'overdue', 'expired', 'failed', 'dropped'), 0)
            for dag in self.dags for sink in dag.sinks}
        self.responses = {key: [] for key in self.counts}
        # by DAG, vertex and sink that it leads to: the latest start, ns after the release
        self.laxity = {
            (dag.index, v): {sink: laxity(dag, v, sink) for sink in reachable_sinks(dag, v)}
            for dag in self.dags for v in range(len(dag.vertices))}
        self.is_overloaded = sum(
            mean(v) * 1_000_000 // dag.period_ns
            for dag in self.dags for v in dag.vertices) > case.workers * 1_000_000
        self.sequence = 0
        self.now = 0
        self._simulate(horizon, stop, last_release or horizon)
        if judge == 'horizon' and self.now == horizon:
            self._judge_open()

    def _simulate(self, horizon, stop, last_release):
        for self.now in range(horizon + 1):
            happened = self._complete_all()
            if self.now == horizon:
                return
            for dag in self.dags:
                if self.now < last_release and self.now % self._period(dag) == 0:
                    self._release(dag)
                    happened = True
            if happened:
                while self._hand_out():
                    pass
            if stop and self.misses:
                return
            for execution in self.running:
                if execution is not None:
                    execution.left -= 1

    # --- times and keys --------------------------------------------------------------------------

    def _period(self, dag):
        return dag.period_ns // self.tick

    def _deadline(self, job, sink):
        """Return the absolute deadline of a sink."""
        relative = job.dag.vertices[sink].deadline_ns
        return job.release + relative // self.tick

    def priority(self, execution):
        """Return what decides about preemption."""
        own = execution.lowered
        if own is None:
            own = self._priority(
                execution, {*self.laxity[execution.job.dag.index, execution.vertex.index]})
        return own if execution.urged is None else min(own, execution.urged)

    def _queue(self, key):
        """Return what waits at a vertex of a DAG and has never run, the head first."""
        return sorted((e for e in self.waiting if not e.has_run and self._at(e) == key),
                      key=self.key)

    @staticmethod
    def _at(execution):
        return execution.job.dag.index, execution.vertex.index

    def _place_of(self, execution):
        """Return where an execution that waits comes among all others."""
        return self.key(execution) if execution.has_run else self.places[self._at(execution)]

    def _demotes(self, dag):
        return dag.on_late == 'demote' and self.policy in ('rad', 'gedf', 'llf')

    def _demote(self, execution):
        """Move back what would start next, if it is late; return whether it moved."""
        if not self._demotes(execution.job.dag) or not self._late_sinks(execution, 0):
            return False
        queue = [execution] if execution.has_run else self._queue(self._at(execution))
        lowest = None
        for ahead, each in enumerate(queue):
            within = {*self._starts(each)} - self._late_sinks(each, ahead)
            if within:
                lowest = self._priority(each, within)
                break
        if lowest is None:
            lowest = self._late_priority(execution, not execution.has_run)
        elif not execution.has_run and (ahead > 0 or self._at(execution) in self.demoted):
            lowest = min(lowest, self._aged_priority(execution))
        if execution.urged is not None:
            lowest = min(lowest, execution.urged)
        place = self._place_of(execution)
        if lowest <= place[0]:
            return False
        if execution.has_run:
            execution.lowered = lowest
        else:
            self.places[self._at(execution)] = (lowest, *place[1:])
        return True

    def _starts(self, execution):
        return self.laxity[self._at(execution)]

    def _late_sinks(self, execution, ahead):
        """Return the sinks at which an execution cannot be in time, behind others."""
        job, vertex = execution.job, execution.vertex
        begin = (self.now - job.release) * self.tick
        if execution.has_run:
            done = self.case.ticks[job.dag.index][vertex.index] - execution.left
            begin -= max(0, done) * self.tick
        if self.is_overloaded:
            begin += ahead * mean(vertex)
        return {sink for sink, start in self._starts(execution).items() if begin > start}

    def _late_priority(self, execution, in_queue):
        """Return the priority six deadlines after the execution or its queue was late first."""
        job, key = execution.job, self._at(execution)
        since = [each for each in (job.demoted, self.demoted.get(key) if in_queue else None)
                 if each is not None] or [self._later(job)]
        if job.demoted is None:
            job.demoted = min(since)
        if in_queue:
            self.demoted[key] = min(since)
        return self._released_at(execution, min(since))

    def _aged_priority(self, execution):
        """Return the priority six deadlines after the head of the queue was late first."""
        since = self.demoted.setdefault(self._at(execution), self._later(execution.job))
        return self._released_at(execution, since)

    def _later(self, job):
        deadline = max(job.dag.vertices[s].deadline_ns or 0 for s in job.dag.sinks)
        return self.now * self.tick + 6 * deadline

    def _released_at(self, execution, release):
        """Return the priority of an execution if its job had been released at a time, ns."""
        unit = 1 if self.policy == 'llf' else self.tick
        return self._priority(execution, {*self._starts(execution)}) + (
            release - execution.job.release * self.tick) // unit

    def _priority(self, execution, sinks):
        job = execution.job
        if self.policy == 'rad':
            return min(self._deadline(job, sink) for sink in sinks)
        if self.policy == 'gedf':
            return max(self._deadline(job, sink) for sink in job.dag.sinks)
        if self.policy == 'rm':
            return self._period(job.dag)
        if self.policy == 'dm':
            sinks = {*self.laxity[job.dag.index, execution.vertex.index]}
            return min(self._deadline(job, sink) for sink in sinks) - job.release
        if self.policy == 'llf':  # in ns: declared execution times need not be multiples of a tick
            starts = self.laxity[job.dag.index, execution.vertex.index]
            return job.release * self.tick + min(starts[sink] for sink in sinks)
        if self.policy == 'wc':
            return job.index
        if self.policy == 'ros2':
            return self._place(execution.vertex.callback)
        if self.policy == 'picas':
            return self._fixed_priorities()[execution.vertex.callback.key]
        assert self.policy == 'fifo'
        return execution.arrival

    def _place(self, callback):
        """Return the place of a callback in the wait set: timers come first."""
        every = self.case.task_set.callbacks
        return callback.kind != 'timer', every.index(callback)

    @functools.cache  # noqa: B019
    def _fixed_priorities(self):
        """Return the priority of each callback, by its name."""
        order = sorted(
            (min(dag.vertices[s].deadline_ns for s in reachable_sinks(dag, v.index)),
             dag.period_ns, dag.index, -depth(dag, v.index), v.index, v.callback.key)
            for dag in self.dags for v in dag.vertices)
        first = {}
        for place, entry in enumerate(order):
            first.setdefault(entry[-1], place)
        return first

    def key(self, execution):
        """Return the order in which ready executions run."""
        job = execution.job
        if self.policy in ('rad', 'gedf', 'llf'):
            ties = (execution.vertex.index, job.dag.index)
        elif self.policy in ('rm', 'dm'):
            ties = (job.index,)
        else:
            ties = ()
        return (self.priority(execution), *ties, execution.arrival)

    # --- jobs ------------------------------------------------------------------------------------

    def _open_jobs(self, dag):
        return [job for job in self.jobs if job.dag is dag and job.outcome is None]

    def _release(self, dag):
        of_dag = self._open_jobs(dag)
        if dag.max_active_jobs is not None and len(of_dag) == dag.max_active_jobs:
            self._give_up(of_dag[0], 'expired')
        job = Job(dag, sum(job.dag is dag for job in self.jobs), self.now)
        self.jobs.append(job)
        self._ready(job, dag.vertices[dag.source])

    def _ready(self, job, vertex):
        new = Execution(job, vertex, self.case.ticks[job.dag.index][vertex.index], self._arrival())
        key = self._at(new)
        self.waiting.append(new)
        self.places[key] = min(self.key(new), self.places.get(key, self.key(new)))
        queue = self._queue(key)
        if vertex.callback.keep == 'newest':
            self._drop(sorted(queue, key=lambda e: e.job.index)[:-1])
        elif vertex.callback.kind == 'timer':
            for older in reversed(queue[:queue.index(new)]):
                if self._is_late(older):
                    self._drop([older])

    def _is_late(self, execution):
        return self._demotes(execution.job.dag) and (
            self._late_sinks(execution, 0) == {*self._starts(execution)})

    def _drop(self, dropped):
        for old in dropped:
            job, sink = old.job, old.vertex.index
            late, key = self._is_late(old), self._at(old)
            if late or self._queue(key)[0] is old:
                self.aside.pop(key, None)
            self.waiting.remove(old)
            self._call_next(old)
            if late:
                lowest = self._late_priority(old, True)
                after = self.key(self._queue(key)[0])
                self.places[key] = (min(lowest, after[0]), *after[1:])
            if job.outcome is not None:
                continue
            if old.vertex.predecessors:
                job.done.add(sink)
                job.late = True
                self.counts[job.dag.index, sink]['dropped'] += 1
                self._miss(job, sink, None)
                if not self._open_sinks(job):
                    job.outcome = 'dropped'
            else:
                self._give_up(job, 'dropped')

    def _arrival(self):
        self.sequence += 1
        return self.sequence

    def _open_sinks(self, job):
        return [sink for sink in job.dag.sinks if sink not in job.done]

    def _give_up(self, job, outcome):
        job.outcome = outcome
        for sink in self._open_sinks(job):
            self.counts[job.dag.index, sink][outcome] += 1
            self._miss(job, sink, None)

    def _miss(self, job, sink, completed):
        self.misses.append({
            'dag': job.dag.name, 'vertex': job.dag.vertices[sink].name, 'job': job.index,
            'deadline_ns': self._deadline(job, sink) * self.tick,
            'completed_ns': completed and completed * self.tick})

    def _judge_open(self):
        overdue = []
        for dag in self.dags:
            for job in self._open_jobs(dag):
                for sink in self._open_sinks(job):
                    if self._deadline(job, sink) <= self.now:
                        self.counts[dag.index, sink]['late'] += 1
                        self.counts[dag.index, sink]['overdue'] += 1
                        overdue.append((job, sink))
        for job, sink in sorted(overdue, key=lambda each: self._deadline(*each)):
            self._miss(job, sink, None)

    # --- completions -----------------------------------------------------------------------------

    def _complete_all(self):
        happened = False
        for worker, execution in enumerate(self.running):
            if execution is not None and execution.left == 0:
                happened = True
                self._note('end', worker, execution)
                self.running[worker] = None
                self._call_next(execution)
                self._complete(execution.job, execution.vertex)
        return happened

    def _complete(self, job, vertex):
        job.done.add(vertex.index)
        if job.outcome is not None:
            return
        if vertex.index in job.dag.sinks:
            self._complete_sink(job, vertex.index)
        if job.outcome is None:
            for after in reversed(vertex.successors):
                if job.done.issuperset(job.dag.vertices[after].predecessors):
                    self._ready(job, job.dag.vertices[after])

    def _complete_sink(self, job, sink):
        late = self.now > self._deadline(job, sink)
        key = job.dag.index, sink
        self.counts[key]['completed'] += 1
        self.responses[key].append(self.now - job.release)
        if late:
            job.late = True
            self.counts[key]['late'] += 1
            self._miss(job, sink, self.now)
        if not self._open_sinks(job):
            job.outcome = 'late' if job.late else 'completed'

    # --- workers ---------------------------------------------------------------------------------

    def _owner(self, execution):
        """Return another execution that has begun and not ended, and holds the group."""
        callback = execution.vertex.callback
        if callback.group is None:
            return None
        begun = [e for e in self.running if e is not None]
        begun += [e for e in self.waiting if e.has_run]
        return next((
            e for e in begun
            if e is not execution and (e.vertex.callback.node, e.vertex.callback.group)
            == (callback.node, callback.group)), None)

    def _first_able(self):
        """Return what may start first; those before it urge the owners of their groups."""
        for each in sorted(self._heads(), key=self._place_of):
            owner, key = self._owner(each), self._at(each)
            if owner is not None and self.aside.get(key) == self.places[key]:
                continue
            if self._demote(each):
                self._call_next(each)
                return self._first_able()
            if owner is None:
                return each
            self.aside[key] = self.places[key]
            place = self.places[key][0]
            if owner in self.running and place < owner.running_as:
                owner.urged = owner.running_as = place
            elif owner not in self.running and place < self.priority(owner):
                owner.urged = place
                return self._first_able()
        return None

    def _call_next(self, execution):
        """Look again at the first queue that waits for a group, if that is free."""
        group = execution.vertex.callback.node, execution.vertex.callback.group
        of_group = [key for key, place in self.aside.items()
                    if place == self.places.get(key) and group == self._group_at(*key)]
        if of_group and self._owner(execution) is None:
            del self.aside[min(of_group, key=self.aside.get)]

    def _group_at(self, dag, vertex):
        callback = self.dags[dag].vertices[vertex].callback
        return callback.node, callback.group

    def _hand_out(self):
        """Hand out one execution; False when that is not possible."""
        if self.policy == 'ros2':
            best = self._next_of_round()
        else:
            best = self._first_able()
        if best is None:
            return False
        if None in self.running:
            self._start(best, self.running.index(None))
            return True
        if not self.case.preemptive:
            return False
        worst, worker = max(
            (e.running_as, w) for w, e in enumerate(self.running) if e is not None)
        if worst <= self._place_of(best)[0]:
            return False
        victim = self.running[worker]
        self._note('preempt', worker, victim)
        self._start(best, worker)
        victim.left += self.case.switch_overhead
        victim.arrival = self._arrival()
        victim.lowered = None
        self.waiting.append(victim)
        return True

    def _heads(self):
        """Return what may start: the head of each queue, and what has run before."""
        queues = {self._at(e) for e in self.waiting if not e.has_run}
        return [*(self._queue(key)[0] for key in queues), *(e for e in self.waiting if e.has_run)]

    def _next_of_round(self):
        """Return what a free worker finds next, in this round or in a new one."""
        if None not in self.running:
            return None
        for new_round in (False, True):
            if new_round:
                by_callback = {}
                for e in self._heads():
                    by_callback.setdefault(e.vertex.callback.key, []).append(self._at(e))
                self.round = [min(each, key=self.places.get) for each in by_callback.values()]
            while self.round:
                key = min(self.round, key=self.places.get)
                self.round.remove(key)
                head = self._queue(key)[0]
                if self._owner(head) is None:
                    return head
        return None

    def _start(self, execution, worker):
        key = self._at(execution)
        self.waiting.remove(execution)
        if execution.has_run:
            execution.running_as = self.priority(execution)
        else:
            execution.running_as = self.places.pop(key)[0]
            self.aside.pop(key, None)
            turn = self.demoted.pop(key, None)
            if turn is not None:
                job = execution.job
                job.demoted = turn if job.demoted is None else min(turn, job.demoted)
            if queue := self._queue(key):
                self.places[key] = self.key(queue[0])
        execution.has_run = True
        execution.left += self.case.dispatch_overhead
        self.running[worker] = execution
        self._note('start', worker, execution)

    def _note(self, kind, worker, execution):
        job, vertex = execution.job, execution.vertex
        self.events.append((self.now, kind, worker, job.dag.index, vertex.index, job.index))

    # --- what came out of it ---------------------------------------------------------------------

    def result(self):
        """Return the part of the result format that concerns jobs and sinks, times in ns."""
        result = {}
        for dag in self.dags:
            outcomes = [job.outcome for job in self.jobs if job.dag is dag]
            ends = ('completed', 'late', 'expired', 'failed', 'dropped')
            result[dag.name] = {
                'jobs': len(outcomes), 'ends': {end: outcomes.count(end) for end in ends},
                'sinks': {dag.vertices[sink].name: self._sink(dag, sink) for sink in dag.sinks}}
        return result

    def _sink(self, dag, sink):
        responses = sorted(self.responses[dag.index, sink])

        def rank(share):
            return responses[math.ceil(share * len(responses)) - 1] * self.tick

        response = {'min': responses[0] * self.tick, 'median': rank(Fraction(1, 2)),
                    'p99': rank(Fraction(99, 100)), 'max': rank(1)} if responses else None
        return {'relative_deadline_ns': dag.vertices[sink].deadline_ns,
                **self.counts[dag.index, sink], 'response_ns': response}

    def first_miss(self):
        """Return the miss of the earliest deadline, in the result format."""
        return min(self.misses, key=lambda miss: miss['deadline_ns'], default=None)
