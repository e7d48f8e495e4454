# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Required reaction times and data ages: by hand, against slow rules, in each command."""

import json
from pathlib import Path
import random
import re

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor import replay, reschedule
from mddag_executor.analysis.paths import Flows
from mddag_executor.analysis.requirements import Requirements
from mddag_executor.core.state import SINK_IN_TIME, SINK_LATE, SINK_MISSED, SINK_NOT_DUE
from mddag_executor.executor.path_watch import PathWatch
from mddag_executor.recording.recording import Recording
from mddag_executor.recording.run import Run
from msg_graph import loads
from msg_graph.segments import bound, segments
import numpy as np
import pytest

from ..declared_path import imu_to_wheels
from ..sources.helpers import MS, ns, Written
from .path_systems import random_system, simulated_run
from .told import Told

GRAPH = imu_to_wheels(reaction='30ms', age='13ms')


def counts(result):
    """Return by requirement: in time, late, overdue, not due, and the longest time in ms."""
    return {what: (each['completed'] + each['overdue'] - each['late'],
                   each['late'] - each['overdue'],
                   each['overdue'], each.get('not_due', 0),
                   each['response_ns'] and each['response_ns']['max'] / MS)
            for path in result['requirements'].values() for what, each in path.items()}


@pytest.fixture
def simulated(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path('g.yaml').write_text(GRAPH)
    done = call('simulate', 'g.yaml', '--duration', '200ms', '--trace', 'r.mcap', '--json', '-')
    return done.result


def test_a_simulated_path_by_hand(simulated, call):
    """
    Inputs at 0, 10, 20, … are kept at 2, 12, 22, …; outputs begin at 0, 20, 40, … and end 3 later.

    The one at 20 has the input of 10 (age 13), and the one at 40 that of 30.  A change right after
    the input at 0 is in the input of 10, so it is out at 23 (23); one right after 10 at 43 (33).
    Of the changes after 0, 10, … 180, that after 170 is answered by no output, and 200 - 170 is
    just the 30 ms that are allowed: overdue.  The last one is not due yet.
    """
    expected = {'reaction': (9, 8, 1, 0, 33), 'age': (9, 0, 0, 0, 13)}
    assert counts(simulated) == expected
    replayed = call('replay', 'r.mcap', '--json', '-').result
    assert replayed['requirements'] == simulated['requirements']
    again = call('replay', 'r.mcap', '--reschedule', '--json', '-').result
    assert again['requirements'] == again['recorded']['requirements'] == simulated['requirements']
    # without the changes after 0 to 40, and the outputs with the inputs of 10 and 30
    skipped = call('replay', 'r.mcap', '--from', '50ms', '--json', '-').result
    assert counts(skipped) == {'reaction': (6, 6, 1, 0, 33), 'age': (7, 0, 0, 0, 13)}
    assert skipped['paths']['imu_to_wheels']['flows'] == 15
    part = call('replay', 'r.mcap', '--from', '50ms', '--to', '100ms', '--json', '-').result
    assert counts(part) == {'reaction': (2, 3, 0, 0, 33), 'age': (3, 0, 0, 0, 13)}


def test_verdicts_in_ci(simulated, call):
    done = call('replay', 'r.mcap', '--fail-on-miss', '--junit', 'j.xml', '--github')
    assert done.returncode == 1
    why = '9 of 18 reactions later than required (30ms)'
    assert f'::error title=path imu_to_wheels%3A reaction::{why}' in done.stdout
    xml = Path('j.xml').read_text()
    assert re.search(r'classname="path imu_to_wheels" name="reaction".*\n\s*<failure message="'
                     + re.escape(why), xml)
    assert 'tests="4" failures="1"' in xml
    # each second one is late
    for tolerate, status in ('1 of 2', 0), ('1 of 3', 1):
        Path('t.yaml').write_text(f'{GRAPH}    tolerate: {tolerate}\n')
        assert call('replay', 'r.mcap', 't.yaml', '--fail-on-miss').returncode == status


def test_a_path_with_nothing_due_fails(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path('g.yaml').write_text(GRAPH)
    status, _, err = call('simulate', 'g.yaml', '--duration', '15ms', '--fail-on-miss')
    assert (status, err) == (
        1, 'error: g.yaml: path imu_to_wheels: no reaction was due, as its first callback hardly '
        'ran, path imu_to_wheels: no age was judged, as no output was based on an input: record '
        'for longer, or see with mddag replay where the data of the path ends\n')


def test_explain_and_diff(simulated, call):
    done = call('explain', 'r.mcap')
    lines = done.stdout.splitlines()
    at = lines.index('Path imu_to_wheels, reaction: 8 late, 1 without output, on average and in '
                     'the worst case:')
    assert [re.split('  +', line)[-1] for line in lines[at + 2:at + 8]] == [
        '20 ms', '1 ms', '1 ms', '8 ms', '2 ms', '1 ms']
    parts = json.loads(call('explain', 'r.mcap', '--json', '-').stdout)['requirements']
    of = parts['imu_to_wheels']['reaction']
    assert sum(part['worst_ns'] for part in of['parts']) == 33 * MS
    assert {part['part'] for part in of['parts']} == {
        'waiting for an input that arrives', 'executing', 'waiting for its next job'}
    Path('slow.yaml').write_text(GRAPH.replace('timer: 20ms', 'timer: 40ms'))
    call('simulate', 'slow.yaml', '--duration', '200ms', '--trace', 'slow.mcap')
    done = call('diff', 'r.mcap', 'slow.mcap', '--fail-on-worse')
    assert done.returncode == 1
    assert 'worse in B: 0 sinks, 1 requirement of paths' in done.stdout


def test_a_dead_path_is_late(tmp_path):
    told = Told(tmp_path / 'a.mcap', GRAPH)
    for at in range(0, 200, 10):
        told.ran('/imu:sample', at, at + 2, sends=[(at + 1, '/imu')])
        if at < 100:
            told.ran('/fuse:on_imu', at + 2, at + 3, at + 1, '/imu')
    for at in range(5, 200, 20):
        told.ran('/fuse:estimate', at, at + 2, sends=[(at + 1, '/pose')])
        if at < 100:
            told.ran('/wheels:drive', at + 2, at + 4, at + 1, '/pose')
    found = counts(replay(told.write(), told.task_set).result())
    # the run ends at 192; the outputs at 9, 29, 49, 69 and 89 have the inputs of 0, 20, … 80
    assert found == {'reaction': (8, 0, 9, 0, 29), 'age': (5, 0, 4, 0, 9)}


def test_what_waited_at_the_end_was_no_input(tmp_path):
    """The executor records it as dispatched without a worker; a run does not count it either."""
    trace = Written(tmp_path / 'r.mcap', GRAPH, workers=1)
    trace.release(0, 0, 0)
    trace.run(0, 0, 0, 0, 1)
    trace.run(0, 1, 0, 1, 2)
    trace.release(0, 1, 10)
    trace.add('dispatch', 100, 1000, 0, 0, 1, -1, ns(10), 0)
    found = replay(trace.end(100)).result()['requirements']['imu_to_wheels']['reaction']
    assert (found['completed'], found['late']) == (0, 0)


def test_what_is_published_early_is_rescheduled_as_it_was(tmp_path):
    """Another worker runs the callback that a message starts before the publisher has ended."""
    trace = Written(tmp_path / 'r.mcap', GRAPH, workers=2)
    for job, at in enumerate((0, 20, 40)):
        trace.release(0, job, at)
        trace.run(0, 0, job, at, at + 5)
        trace.run(0, 1, job, at + 2, at + 4, worker=1)
        trace.release(1, job, at + 10)
        trace.run(1, 0, job, at + 10, at + 13)
        trace.run(1, 1, job, at + 11, at + 12, worker=1)
    path = trace.end(60)
    for result in replay(path).result(), reschedule(path, workers=2).result():
        assert counts(result) == {'reaction': (0, 2, 0, 0, 32), 'age': (3, 0, 0, 0, 12)}


def test_outputs_that_do_not_come_for_years_are_only_counted(tmp_path):
    """As in a trace with a damaged time: there are 50 thousand million of them."""
    told = Told(tmp_path / 'a.mcap', GRAPH + '    tolerate: 2 of 5\n')
    for at in (0, 10 ** 12):
        told.ran('/imu:sample', at, at + 2, sends=[(at + 1, '/imu')])
    told.ran('/fuse:on_imu', 2, 3, 1, '/imu')
    told.ran('/fuse:estimate', 5, 7, sends=[(6, '/pose')])
    told.ran('/wheels:drive', 7, 9, 6, '/pose')
    outcome = replay(told.write(), told.task_set)
    age = next(iter(outcome.result()['requirements'].values()))['age']
    assert age['overdue'] == age['late'] == pytest.approx(10 ** 12 / 20, rel=1e-6)
    assert age['tolerate']['worst'] == 5
    assert outcome.table('requirements')['count'].tolist()[-1] == age['overdue']


RARE = """\
mddag: 1
nodes:
  - node: /a
    callbacks:
      - {name: look, timer: 10ms, may_publish: [/alarm], execution_time: 1ms}
      - {name: stop, subscription: /alarm, deadline: 10ms, execution_time: 1ms}
paths:
  - {name: p, callbacks: ['/a:look', '/a:stop'], reaction: 25ms, age: 10ms}
"""


def test_what_is_not_published_is_not_due(tmp_path):
    told = Told(tmp_path / 'a.mcap', RARE)
    for at in range(0, 100, 10):
        seen = at in (30, 60)
        told.ran('/a:look', at, at + 2, sends=[(at + 1, '/alarm')] * seen)
        if seen:
            told.ran('/a:stop', at + 2, at + 4, at + 1, '/alarm')
    outcome = replay(told.write(), told.task_set)
    assert counts(outcome.result()) == {
        'reaction': (2, 0, 0, 7, 14), 'age': (2, 0, 0, 0, 4)}


def test_a_run_finds_what_is_not_due_and_goes_on_later(tmp_path):
    """The input at 30 leads to an output at 47; those at 40 publish nothing until then."""
    told = Told(tmp_path / 'a.mcap', RARE)
    watch = PathWatch(told.task_set, None)
    look, stop = 0, 1
    for at in range(0, 100, 10):
        seen = at == 30
        told.ran('/a:look', at, at + 2, sends=[(at + 1, '/alarm')] * seen)
        watch.begun(at, look, at * MS)
        watch.ended(at, look, at, at * MS, (at + 2) * MS, (), {'/alarm'} if seen else set(), 0)
        watch.left(at)
        if seen:
            told.ran('/a:stop', at + 2, at + 17, at + 1, '/alarm')
            watch.begun('stop', stop, (at + 2) * MS)
    watch.ended('stop', stop, 30, 32 * MS, 47 * MS, (), None, 0)
    watch.left('stop')
    found = {'requirements': watch.result(92 * MS, 0)}
    expected = {'reaction': (0, 1, 0, 8, 27), 'age': (0, 1, 0, 0, 17)}
    assert counts(found) == expected
    assert counts(replay(told.write(), told.task_set).result()) == expected
    # a coroutine begins with its first piece
    watch.begun('later', look, 100 * MS)
    watch.paused('later', look, 100, 100 * MS, 101 * MS, ())
    watch.begun('later', look, 120 * MS)
    watch.ended('later', look, 100, 120 * MS, 121 * MS, (), {'/alarm'}, 0)
    watch.left('later')
    watch.ended('stop', stop, 100, 121 * MS, 123 * MS, (), None, 0)
    watch.left('stop')
    assert counts({'requirements': watch.result(130 * MS, 0)})['age'] == (0, 2, 0, 0, 23)


TOPIC = RARE.replace('may_publish: [/alarm]', 'publishes: [/alarm], deadline: none').replace(
    'subscription: /alarm', 'timer: 10ms, reads: [/alarm]')


def test_a_run_reads_a_topic_when_it_is_published():
    """The reader begins at 5, after the publication at 1 and before the writer's end at 9."""
    watch = PathWatch(loads(TOPIC, 'g'), None)
    look, stop = 0, 1
    watch.begun('look', look, 0)
    watch.begun('stop', stop, 5 * MS)
    watch.ended('stop', stop, 0, 5 * MS, 6 * MS, (), None, 0)
    watch.left('stop')
    watch.ended('look', look, 0, 0, 9 * MS, [('/alarm', MS)], None, 0)
    watch.left('look')
    assert counts({'requirements': watch.result(10 * MS, 0)})['age'] == (1, 0, 0, 0, 6)


# --- against slow rules ----------------------------------------------------------------------

TIMES = st.integers(0, 60)
FLOW = st.tuples(TIMES, st.sampled_from(['lost', 'arrived', 'silent']), st.integers(0, 30))


def slow_reactions(flows, sampled, required, until):
    """Return the results of rules 1 and 2, by searching all flows."""
    inputs = sorted({begin for begin, _, _ in flows})
    found = []
    for number, begin in enumerate(inputs):
        if sampled and not number:
            continue
        since = inputs[number - 1] if sampled else begin
        later = [flow for flow in flows if flow[0] >= begin]
        ends = [b + took for b, how, took in later if how == 'arrived']
        silences = [b + took for b, how, took in later if how == 'silent']
        own = any(b == begin and how == 'arrived' for b, how, _ in later)
        if not own and silences and min(silences) <= min(ends, default=10 ** 9):
            found.append((SINK_NOT_DUE, since))
        elif ends:
            late = min(ends) - since > required
            found.append((SINK_LATE if late else SINK_IN_TIME, since, min(ends)))
        elif since + required <= until:
            found.append((SINK_MISSED, since))
    return found


class Rule:
    def __init__(self, sampled):
        self.sampled = sampled


@given(st.lists(FLOW, max_size=25), st.booleans(), st.integers(1, 40), st.integers(40, 100))
def test_reactions_are_those_of_slow_rules(flows, sampled, required, until):
    recording = Recording(Run('r', None, loads(RARE, 'g'), None, judged_until=until))
    requirements = Requirements(recording, None)
    begin = np.array([b for b, _, _ in flows], dtype=np.int64)
    end, silent = (np.array([b + took if how == which else -1 for b, how, took in flows],
                            dtype=np.int64) for which in ('arrived', 'silent'))
    table = requirements._reactions(
        Flows(begin, end, begin, end, silent, np.arange(len(flows))), Rule(sampled), required)
    assert [row[:2] if row[2] == -1 else row[:3] for row in table.tolist()] == slow_reactions(
        flows, sampled, required, until)
    for _, _, ended, step, _ in table.tolist():
        assert ended == -1 or end[step] == ended


# --- random systems, simulated ---------------------------------------------------------------

def watched(task_set, recording, chance):
    """Return what the executor would find in a run whose threads report late and in any order."""
    watch = PathWatch(task_set, None)
    rows = recording.executions
    vertices = task_set.vertices
    reports = []
    for row in np.flatnonzero((rows['end'] >= 0) & (rows['start'] >= 0)).tolist():
        vertex, start, end = (int(rows[name][row]) for name in ('vertex', 'start', 'end'))
        if vertex in watch.vertices:
            reports += [(start - chance.randrange(MS), row),
                        (end + chance.randrange(30 * MS), row)]
    begun = set()
    for now, row in sorted(reports):
        vertex, job, start, end = (
            int(rows[name][row]) for name in ('vertex', 'job', 'start', 'end'))
        if row not in begun:
            begun.add(row)
            watch.begun(row, vertex, now)
        else:
            sent = [(topic, end) for topic in vertices[vertex].callback.publishes]
            watch.ended(row, vertex, job, start, end, sent, None, -2 ** 62)
            watch.left(row)
        if not chance.randrange(50):    # it changes nothing
            watch.result(now, -2 ** 62)
    return watch.result(recording.run.judged_until, -2 ** 62)


@pytest.mark.parametrize('seeds', [
    range(40), pytest.param(range(40, 1040), marks=pytest.mark.nightly)])
def test_live_verdicts_and_bounds_in_random_systems(seeds):
    bounded = 0
    for seed in seeds:
        task_set = loads(random_system(random.Random(seed)), f'{seed}.yaml')
        result, run = simulated_run(task_set)
        found = run.requirements()
        if not found:
            continue
        assert watched(task_set, run.recording(), random.Random(seed)) == (
            found['requirements']), seed
        for what, each in found['requirements']['p'].items():
            if not result['deadline_missed'] and each['response_ns'] is not None:
                limit = bound(task_set, task_set.paths[0], what)
                assert each['response_ns']['max'] <= limit, (seed, what)
                bounded += len(segments(task_set, task_set.paths[0])) > 1
    assert bounded > len(seeds) // 4


# --- what is published sometimes, with executions that overtake each other --------------------

SOMETIMES = """\
mddag: 1
nodes:
  - node: /a
    callbacks:
      - {name: look, timer: 10ms, publishes: [/seen]}
  - node: /b
    callbacks:
      - {name: pick, subscription: /seen, may_publish: [/alarm]}
  - node: /c
    callbacks:
      - {name: stop, subscription: /alarm, deadline: 10ms}
paths:
  - name: p
    callbacks: ['/a:look', '/b:pick', '/c:stop']
    reaction: 25ms
    age: 20ms
    tolerate: 1 of 5
"""
PICKS = {
    'started': SOMETIMES,
    'taken': SOMETIMES.replace('subscription: /seen', 'timer: 10ms, reads: [/seen]').replace(
        'publishes: [/seen]', 'publishes: [/seen], deadline: none'),
    'kept': SOMETIMES.replace(
        '{name: pick, subscription: /seen', """{name: keep, subscription: /seen, deadline: none}
      - {name: pick, timer: 10ms, reads: [keep]""").replace("'/b:pick'", "'/b:keep', '/b:pick'")}
"""How the callback that may publish gets its data: by a message, a topic, or a variable."""


def overtaking(told, chance, how):
    """
    Tell a run in which executions overtake each other, and half of the picks publish nothing.

    Return the executions: callback, job, start, end, and when they published which topic.
    """
    ran, sent = [], set()

    def run(key, job, start, message=None, topic=None, publishes=None):
        sends, end = [], start
        while (key, end) in sent or end == start:   # one after the other
            end = start + chance.randrange(1, 40)
        sent.add((key, end))
        if publishes is not None:
            free = [at for at in range(start, end + 1) if (publishes, at) not in sent]
            sends = [(at, publishes) for at in free[:1]]
            sent.update((publishes, at) for at, _ in sends)
        told.ran(key, start, end, message, topic, sends)
        ran.append((key, job, start, end, sends))
        return end, sends[0][0] if sends else None

    def pick(job, start, *message):
        _, at = run('/b:pick', job, start, *message,
                    publishes='/alarm' if chance.random() < 0.5 else None)
        if at is not None:
            run('/c:stop', job, at + chance.randrange(20), at, '/alarm')

    for job in range(40):
        _, at = run('/a:look', job, 10 * job, publishes='/seen')
        if at is None:
            continue
        message = at + chance.randrange(25), at, '/seen'
        if how == 'started':
            pick(job, *message)
            continue
        if how == 'kept':
            run('/b:keep', job, *message)
        pick(job, 10 * job + chance.randrange(10))
    return ran


@pytest.mark.parametrize('how', PICKS)
def test_live_verdicts_are_those_of_the_replay_if_executions_overtake_each_other(tmp_path, how):
    for seed in range(25):
        chance = random.Random(seed)
        told = Told(tmp_path / f'{seed}.mcap', PICKS[how])
        ran = overtaking(told, chance, how)
        replayed = replay(told.write(), told.task_set).result()
        watch = PathWatch(told.task_set, None)
        vertex = {each.callback.key: v for v, each in enumerate(told.task_set.vertices)}
        reports = []
        for number, (_, _, start, end, _) in enumerate(ran):
            reports += [(start * MS - 1, False, number),
                        (end * MS + chance.randrange(30 * MS), True, number)]
        for now, is_end, number in sorted(reports):
            key, job, start, end, sends = ran[number]
            if not is_end:
                watch.begun(number, vertex[key], now)
                continue
            watch.ended(number, vertex[key], job, start * MS, end * MS, [
                (topic, at * MS) for at, topic in sends if topic in watch.topics],
                {topic for _, topic in sends} if key == '/b:pick' else None, 0)
            watch.left(number)
        until = max(end for _, _, _, end, _ in ran) * MS
        assert watch.result(until, 0) == replayed['requirements'], seed
