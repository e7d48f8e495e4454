# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Runs in which deadlines are missed for one known reason, and what is told of them."""

from dataclasses import dataclass, field
from functools import partial

from hypothesis import example, given
from hypothesis import strategies as st
from mddag_executor.core.tally import counts, total
from mddag_executor.replay import open_recording, replay, reschedule
from mddag_executor.replay.causes import CAUSES
from msg_graph import loads
import pytest

from ..conftest import examples
from .helpers import Chances, MS, ns, small, START_TIME, VirtualRun, Written

QUIET = Chances(0, 0, 0, 0, 0, 0, 0)
VICTIM = """\
mddag: 1
nodes:
  - {node: /sensor, callbacks: [{name: tick, timer: 50ms, publishes: [/data]}]}
  - {node: /victim, callbacks: [{name: use, subscription: /data, deadline: 12ms}]}
"""
HEAVY = VICTIM + """\
  - node: /heavy
    callbacks:
      - {name: first, dag: first, timer: 100ms, deadline: 90ms}
      - {name: second, dag: second, timer: 100ms, deadline: 90ms}
"""
SYNC = """\
mddag: 1
nodes:
  - {node: /sensor, callbacks: [{name: tick, timer: 50ms, publishes: [/data, /more]}]}
  - {node: /victim, callbacks: [{name: use, sync: [/data, /image], deadline: 22ms}]}
  - {node: /camera, callbacks: [{name: take, subscription: /more, publishes: [/image]}]}
"""
TICK, USE, FIRST, SECOND = range(4)


@dataclass
class Planned(VirtualRun):
    """
    A run in virtual time in which callbacks take what is planned.

    :ivar times: by vertex (modulo its number) what it takes; the last one: every fifth time.
    :ivar legs: of a sync only the last message takes time.
    :ivar late: releases that are noticed late, every fifth: by how much.
    :ivar slow: how long every fifth message takes.
    :ivar stops: every so often, for so long, nothing goes on, which is recorded.
    :ivar groups: by vertex its callback group; ``holds``: which hold the interpreter.
    :ivar computes: at most so much of each execution is CPU time, if it is recorded.
    """

    chances: Chances = field(default_factory=lambda: QUIET)
    duration: int = 10_000 * MS
    longest: int = MS
    times: dict[int, tuple[int, int]] = field(default_factory=dict)
    legs: int = 1
    late: int = 0
    slow: int = 0
    stops: tuple[int, int] | None = None
    groups: dict[int, int] = field(default_factory=dict)
    holds: bool = False
    computes: int = 0

    def cpu(self, work, took):
        return (min(took, self.computes), True) if self.computes else (-1, False)

    def took(self, work):
        usual, fifth = self.times.get(work.vertex, (MS // 2, MS // 2))
        took = fifth if work.job % 5 == 4 else usual
        if work.vertex == USE and work.leg < self.legs - 1:
            took = 10_000
        return self._shifted(self._now + took) - self._now

    def _start(self, work, worker, now):
        self._now = now
        super()._start(work, worker, now)

    def lag(self, dag, job):
        return self.late if job % 5 == 4 and dag == 0 else 20_000

    def way(self, work):
        return self.slow if self.slow and work.job % 5 == 4 else 50_000

    def _at(self, time, action):
        super()._at(self._shifted(time), action)

    def _shifted(self, time):
        """Return when something happens that would have happened in a stop."""
        if self.stops is None:
            return time
        every, length = self.stops
        into = (time - START_TIME) % every
        return time + every - into if into >= every - length else time

    def _ready(self, slot, dag, job, vertex, leg, now):
        x = self.scheduler.execution(slot, vertex, leg)
        self.scheduler.state.x_group[x] = self.groups.get(vertex, -1)
        self.scheduler.state.x_holds[x] = int(self.holds)
        super()._ready(slot, dag, job, vertex, leg, now)

    def _run(self):
        for group in sorted(set(self.groups.values())):
            assert self.scheduler.new_group() == group
            self.record('add_callback_group', START_TIME, 1, 1, 900 + group, 'mutually_exclusive')
        for vertex, group in self.groups.items():
            self.record('rcl_timer_init', START_TIME, 1, 800 + vertex, 1)
            self.record('rclcpp_timer_callback_added', START_TIME, 1, 800 + vertex,
                        self._address(vertex))
            self.record('callback_group_add_timer', START_TIME, 1, 900 + group, 800 + vertex)
        if self.stops is not None:
            every, length = self.stops
            for end in range(START_TIME + every, START_TIME + self.duration + 1, every):
                self._at(end - 1, partial(self._note_stop, length))
        super()._run()

    def _note_stop(self, length, now):
        self.record('stop', now, 3, now - length, now)


BUSY = {FIRST: (30 * MS, 30 * MS), SECOND: (30 * MS, 30 * MS)}
PLANS = {
    'ran long': (VICTIM, {'times': {USE: (2 * MS, 20 * MS)}}),
    # both heavy ones are released with every second job of the victim
    'waited': (HEAVY, {'times': BUSY}),
    'group': (HEAVY, {'times': BUSY, 'workers': 6, 'groups': {USE: 0, FIRST: 0, SECOND: 0}}),
    'interpreter': (HEAVY, {'times': BUSY, 'workers': 6, 'holds': True, 'policy': 'fifo'}),
    'released late': (VICTIM, {'late': 15 * MS}),
    # the message that comes first is only kept
    'released late, sync': (SYNC, {
        'late': 8 * MS, 'legs': 2, 'times': {USE: (15 * MS, 15 * MS)}}),
    'transport': (VICTIM, {'slow': 15 * MS}),
    'machine': (HEAVY, {'times': {FIRST: (5 * MS, 5 * MS), SECOND: (5 * MS, 5 * MS)},
                        'stops': (2_000 * MS, 300 * MS)}),
    'lost': (VICTIM, {'chances': Chances(0.2, 0.02, 0, 0, 0, 0, 0)}),
    # what takes longer has no more CPU time: others compute, or nothing does
    'interpreter, computing': (HEAVY, {
        'times': {USE: (2 * MS, 20 * MS), FIRST: (85 * MS, 85 * MS)}, 'workers': 6,
        'computes': 2 * MS}),
    'machine, computing': (VICTIM, {'times': {USE: (2 * MS, 20 * MS)}, 'computes': 2 * MS}),
    'ran long, computing': (VICTIM, {'times': {USE: (2 * MS, 20 * MS)}, 'computes': 20 * MS}),
    'failed': (VICTIM, {'chances': Chances(0, 0, 0, 0, 0, 0, 0.2)})}


def explained(path):
    found = replay(path)
    result = found.explanation.result()
    assert len(result['jobs']) == result['missed'] == sum(result['causes'].values())
    assert result['missed'] == total(found.tally.result()['dags']).missed
    return result


@pytest.mark.parametrize('cause', list(PLANS))
def test_the_right_cause_is_told(cause, tmp_path):
    declaration, plan = PLANS[cause]
    path = tmp_path / 'run.mcap'
    Planned(path, loads(declaration, 'g.yaml'), **plan)
    result = explained(path)
    cause, _, computing = cause.partition(', ')
    assert result['missed'] >= 39
    assert result['causes'][cause] >= 0.95 * result['missed'], result['causes']
    if cause == 'machine' and not computing:
        assert len(result['stalls']) == 5
        assert all(295 * MS <= stall['length_ns'] <= 320 * MS for stall in result['stalls'])
        assert sum(stall['misses'] for stall in result['stalls']) == result['causes'][cause]
    else:
        assert not result['stalls']
    for job in result['jobs']:
        if job['verdict'] == 'late':
            assert sum(part['ns'] for part in job['parts']) == \
                job['until_ns'] - job['release_ns']
    if cause in ('waited', 'group', 'interpreter') and not computing:
        behind = {each['callback'] for job in result['jobs'] for part in job['parts']
                  if part['cause'] == cause for each in part['behind'] if each['ns'] > 5 * MS}
        assert behind and behind <= {'/heavy:first', '/heavy:second'}


@examples(8)
@example(903, 2)    # the release after that of a job that failed was skipped
@given(st.integers(0, 10 ** 6), st.sampled_from([1, 2, 4]))
def test_all_misses_of_any_run_are_explained(tmp_path, seed, workers):
    path = tmp_path / 'run.mcap'
    run = VirtualRun(path, small(), seed, workers, duration=400 * MS,
                     chances=Chances(undeclared=1))
    result = explained(path)
    assert result['missed'] == total(run.tally.result()['dags']).missed
    assert {job['cause'] for job in result['jobs']} <= set(CAUSES)
    for job in result['jobs']:
        assert (job['cause'] == 'failed') == (job['verdict'] == 'failed')
        for part in job['parts']:
            assert part['ns'] > 0
            for each in part['behind']:
                assert each['ns'] <= workers * (job['until_ns'] - job['release_ns'])


TWO = """\
mddag: 1
workers: 1
nodes:
  - {node: /a, callbacks: [{name: asks, dag: a, timer: 1s, deadline: 990ms}]}
  - {node: /x, callbacks: [{name: late, dag: x, timer: 1s, deadline: 15ms}]}
"""


@pytest.mark.parametrize(('worker', 'cause'), [(-1, 'machine'), (0, 'waited')])
def test_a_callback_that_has_lent_its_worker_keeps_none_busy(worker, cause, tmp_path):
    # the one waits for the answer to a service call; the other starts 300 ms after it is ready
    trace = Written(tmp_path / 'run.mcap', TWO)
    for job in range(5):
        release = job * 1000
        trace.release(0, job, release)
        trace.run(0, 0, job, release, release + 390, worker=worker, thread=10)
        trace.release(1, job, release + 100)
        trace.run(1, 0, job, release + 400, release + 401, ready=release + 100, thread=11)
    result = explained(trace.end(5000))
    assert result['causes'][cause] == result['missed'] == 5
    mostly, = replay(trace.path).explanation.mostly()
    assert (mostly['cause'], mostly['missed'], mostly['vertex'], mostly['behind']) == (
        cause, 5, '/x:late', '/a:asks' if cause == 'waited' else None)
    assert mostly['ns'] == (290 if cause == 'waited' else 300) * MS
    behind = [{'callback': '/a:asks', 'ns': 290 * MS}] if cause == 'waited' else []
    assert all(job['parts'][0]['behind'] == behind for job in result['jobs'])


@pytest.mark.parametrize('aborted', [False, True])
def test_an_undeclared_callback_may_hold_the_interpreter(aborted, tmp_path, call):
    # one of two workers runs it: the other worker's callback cannot begin before it ends; its next
    # release is skipped; or it never begins, and is aborted
    trace = Written(tmp_path / 'run.mcap', TWO, 2)
    for job in range(5):
        release = job * 1000
        start = release + (25 if aborted else 50)
        trace.piece(-1, -1, -1, release, start)
        trace.release(1, 2 * job, release)
        trace.release(1, 2 * job + 1, release + 20, noticed=release + 25)
        trace.add('expire', release + 25, 1, 2 * job + 1)
        if aborted:
            trace.add('abort', start, 1, 2 * job)
            trace.add('drop', start, 8, 1, 0, 2 * job, 'aborted')
        else:
            trace.run(1, 0, 2 * job, start, start + 1, worker=1, ready=release,
                      computed=(MS, True))
    path = trace.end(5000)
    result = explained(path)
    assert result['causes']['interpreter'] == result['missed'] == 10
    for job in result['jobs']:
        if job['job'] % 2:
            skipped, = job['parts']
            assert (skipped['cause'], skipped['waiting_job']) == ('skipped', job['job'] - 1)
        elif not aborted:
            assert [each['ns'] for each in job['parts'][0]['behind']] == [50 * MS]
    if not aborted:
        assert 'skipped: job 2 had not started' in call('explain', path, '--job', '3').stdout
        assert 'no job 10: choose one from 0 to 9' in call('explain', path, '--job', '10').stderr
        # the miss of the earliest deadline is the first one, though another was known before
        assert 'first miss: /x:late, job 0, 36 ms late' in call('replay', path).stdout
        assert '5 jobs skipped by a timer in the recording: skipped' in call(
            'replay', path, '--reschedule').stdout


def test_a_sync_that_lacks_a_message_did_not_run_long(tmp_path, call):
    # /image has another name in the node
    trace = Written(tmp_path / 'run.mcap', SYNC)
    for job in range(20):
        at = job * 50
        trace.release(0, job, at)
        for place, vertex in enumerate((TICK, 2, USE)):
            trace.run(0, vertex, job, at + place, at + place + 1, whole=vertex != USE)
        trace.add('expire', at + 32, 0, job)
    path = trace.end(2000)
    result = explained(path)
    assert result['causes']['lost'] == result['missed'] == 20
    assert result['jobs'][0]['parts'][-1] == {
        'vertex': '/victim:use', 'cause': 'lost', 'ns': 29 * MS, 'behind': [],
        'topics': ['/image']}
    assert 'lost: /image' in call('explain', path, '--job', '3').stdout


def test_only_misses_in_stops_are_said_to_be_in_them(tmp_path, call):
    # each job's callback starts 20 ms after it was ready, with an idle worker; the machine stood
    # still twice in that of one job, and once in that of another
    trace = Written(tmp_path / 'run.mcap', TWO)
    trace.add('stop', 0, ns(0), ns(0))      # stops are recorded
    for job in range(9):
        release = job * 1000
        trace.release(1, job, release)
        start = release + 20
        if job in (3, 5):
            start += 60
            for first, last in ((10, 35), (40, 70))[job // 5:]:
                trace.add('stop', release + last, ns(release + first), ns(release + last))
        trace.run(1, 0, job, start, start + 1, ready=release)
    path = trace.end(9000)
    assert len(open_recording(path).stops) == 3    # without the empty one
    result = explained(path)
    assert result['causes']['machine'] == result['missed'] == 9
    assert sum(stall['misses'] for stall in result['stalls']) == 2
    for verb in ('explain', 'replay'):
        assert '9 misses: 9 machine\n' in call(verb, path).stdout


def test_what_an_overload_takes_from_less_important_sinks(tmp_path, call):
    graph, trace = tmp_path / 'g.yaml', tmp_path / 'run.mcap'
    graph.write_text("""\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: main, timer: 30ms, deadline: 30ms, execution_time: 20ms, importance: high, dag: a}
      - {name: rest, dag: b, timer: 20ms, deadline: 20ms, execution_time: 10ms}
""")
    call('simulate', graph, '--workers', 1, '--preemptive', '--duration', '3s',
         '--on-late', 'demote', '--trace', trace)
    run = replay(trace)
    sinks = {name: next(iter(dag['sinks'].values()))
             for name, dag in run.result()['dags'].items()}
    assert 'demoted' not in sinks['a'] and sinks['b']['demoted'] > 70
    lines = call('replay', trace, '--skip', '100s').stdout.splitlines()
    assert 'left out: jobs released in the first 100 s, so all of them: the run has only 3 s' \
        in lines
    assert '0 results due, 0 in time (-), 0 late, 0 expired' in lines   # and none demoted
    explained = call('explain', trace, '--json', '-').result
    assert explained['missed'] == explained['causes']['overload'] >= 50  # all there is no time for
    behind = {each['callback'] for job in explained['jobs'] for part in job['parts']
              for each in part['behind']}
    assert '/n:main' in behind
    # the recorded execution times say what is too much, whatever it was recorded with
    in_time = [counts(reschedule(trace, on_late=on_late).result()['dags']['a']['sinks'][
        '/n:main']).in_time for on_late in ('continue', 'demote')]
    assert in_time[0] < 20 and in_time[1] >= 99
