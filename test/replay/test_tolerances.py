# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Tolerated misses, and JUnit XML."""

import json
from xml.etree import ElementTree

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core import Tables, Tally
from mddag_executor.core.state import (
    SINK_ABORTED,
    SINK_COMPLETED,
    SINK_EXPIRED,
    SINK_IN_TIME,
    SINK_LATE,
    SINK_MISSED,
)
from mddag_executor.core.tally import counts
from mddag_executor.core.tolerances import not_tolerated
from mddag_executor.report.ci import annotation_lines, junit
from mddag_executor.trace import TraceFile, TraceReader
from msg_graph import loads
import pytest

from .helpers import add_execution

MS = 1_000_000
GRAPH = """\
mddag: 1
nodes:
  - node: /n
    callbacks: [{name: a, timer: 10ms, deadline: 8ms}]
"""


def sink_of(missed):
    """Return the result of a sink whose jobs missed or not, in a tally that is told of them."""
    task_set = loads(GRAPH, 'g.yaml')
    tally = Tally(task_set, Tables.build(task_set))
    decisions = []
    for job, miss in enumerate(missed):
        deadline = job * 10 * MS + 8 * MS
        kind = SINK_IN_TIME
        if miss:
            kind = (SINK_LATE, SINK_MISSED, SINK_ABORTED, SINK_EXPIRED)[job % 4]
        time = deadline + miss if kind in SINK_COMPLETED else -1
        decisions.append((kind, 0, 0, job, deadline, time))
    tally.add(reversed(decisions))      # jobs may complete out of order
    return tally.result()['dags']['/n']['sinks']['/n:a']


@given(st.lists(st.booleans(), max_size=30))
def test_without_a_tolerance_each_miss_counts(missed):
    sink = sink_of(missed)
    assert (counts(sink).due, counts(sink).missed) == (len(missed), sum(missed))
    found = not_tolerated({'/n': {'sinks': {'/n:a': sink}}})
    assert bool(found) == (any(missed) or not missed)


HOSTILE = 'a"]]><&\'\x00\x1b[2J\n\ud800\uffff\u202e</testcase>'


def test_junit_with_hostile_names():
    sinks = {HOSTILE: sink_of([True] * 3), 'good': sink_of([False]), 'none': sink_of([])}
    result = {'dags': {HOSTILE: {'sinks': sinks}}, 'duration_ns': 30 * MS, 'policy': 'rad',
              'workers': 2, 'preemptive': False, 'rescheduled': False, 'warnings': [HOSTILE]}
    broken = not_tolerated(result['dags'])
    assert list(broken) == [(HOSTILE, HOSTILE)]
    root = ElementTree.fromstring(junit(result, broken, HOSTILE))
    suite = root[0]
    assert {key: suite.attrib[key] for key in ('tests', 'failures', 'errors', 'skipped')} == {
        'tests': '3', 'failures': '1', 'errors': '0', 'skipped': '1'}
    bad, good, none = suite.findall('testcase')
    failure = bad.find('failure')
    assert failure.attrib['message'] == '3 of 3 jobs missed the deadline'
    for text in (bad.attrib['name'], bad.attrib['classname'], suite.attrib['name']):
        assert '\\x00' in text and '\\x1b[2J\\n\\ud800' in text
        assert all(c.isprintable() for c in text)
    assert good.find('failure') is None and good.find('skipped') is None
    assert none.find('skipped') is not None


@pytest.fixture
def trace(tmp_path):
    """Give a trace of ten jobs, of which the third and the fourth are late."""
    path = tmp_path / 'run.mcap'
    with TraceFile(path) as file:
        file.add('task_set', 0, 1, 1, GRAPH, 'g.yaml', 'rad', 1, 100 * MS, 64, False)
        for job in range(10):
            release = (job + 1) * 10 * MS
            end = release + (9 if job in (2, 3) else 1) * MS
            file.add('job_release', release, 1, 1, 0, job, release)
            add_execution(file, release, end, 0, 0, job, thread=5, address=7)
            if job in (2, 3):
                file.add('deadline', end, 1, 5, 0, 0, job, release + 8 * MS, end)
        file.add('shutdown', 200 * MS, 1, 1, 200 * MS)
    return path


@pytest.mark.parametrize(('tolerate', 'worst', 'kept'), [
    ('2 of 3', 2, True), ('1 of 2', 2, False), ('2 of 100', 2, True), ('1 of 3', 2, False)])
@pytest.mark.parametrize('mode', [[], ['--reschedule']])
def test_the_declaration_says_what_a_sink_tolerates(
        trace, tmp_path, tolerate, worst, kept, mode, call):
    graph, out = tmp_path / 'g.yaml', tmp_path / 'out.xml'
    graph.write_text(GRAPH.replace('8ms}', f'8ms, tolerate: {tolerate}}}'))
    arguments = 'replay', trace, graph, *mode, '--fail-on-miss'
    status, output, _ = call(*arguments, '--github', '--junit', out)
    assert status == (not kept)
    why = f'{worst} of {tolerate.split()[-1]} jobs in a row missed the deadline, ' \
          f'tolerated: {tolerate}'
    assert (f'::error file={graph},title=Deadline of /n%3Aa::{why}\n' in output) != kept
    failure = ElementTree.parse(out).getroot().find('testsuite/testcase/failure')
    assert (None if failure is None else failure.attrib['message']) == (None if kept else why)
    if not mode:
        header, row = output[output.index('DAG '):].splitlines()[:2]
        assert header.split()[-2:] == ['tolerates', 'worst']
        assert row.split()[-4:] == [*tolerate.split(), str(worst)]
    status, output, _ = call(*arguments, '--json', '-')
    sink = json.loads(output)['dags']['/n']['sinks']['/n:a']
    misses, of = map(int, tolerate.split(' of '))
    assert sink['tolerate'] == {'misses': misses, 'of': of, 'worst': worst}


def test_a_simulation_respects_it(tmp_path, call):
    graph = tmp_path / 'g.yaml'
    late = GRAPH.replace('8ms}', '8ms, execution_time: 9ms}')
    for tolerate, status in (('', 1), (', tolerate: 9 of 10', 1), (', tolerate: 10 of 11', 0)):
        graph.write_text(late.replace('9ms}', f'9ms{tolerate}}}'))
        done = call('simulate', graph, '--duration', '105ms', '--fail-on-miss')
        assert done.returncode == status and (' 10 of 11 ' in done.stdout or status)


def test_annotations_with_hostile_names():
    dags = {'d': {'sinks': {HOSTILE: sink_of([True]), 'none': sink_of([])}}}
    broken = not_tolerated(dags)
    bad, none = annotation_lines(dags, broken, 'a,b:c%.yaml')
    assert bad.startswith('::error file=a%2Cb%3Ac%25.yaml,title=Deadline of a"]]><&')
    assert bad.isprintable() and bad.count('::') == 2
    assert bad.endswith('::1 of 1 job missed the deadline')
    assert none == ('::warning file=a%2Cb%3Ac%25.yaml,title=Deadline of none::'
                    'no job of it was due')


def test_a_failed_job_is_told_wherever_verdicts_are(trace, tmp_path, call):
    """The first job's callback raised, in a run that was in time but for the third and fourth."""
    failed, out = tmp_path / 'failed.mcap', tmp_path / 'out.xml'
    with TraceFile(failed) as file:
        for name, time, pid, thread, *fields in TraceReader(trace).events():
            if name == 'mddag:complete' and fields[3] == 0:
                file.add('fail', time, pid, thread, 0, 0, 0)
                file.add('deadline', time, pid, thread, 0, 0, 0, 18 * MS, -1)
            file.add(name, time, pid, thread, *fields)
    for mode in ([], ['--reschedule']):
        page = tmp_path / 'page.html'
        done = call('replay', failed, *mode, '--junit', out, '--report', page)
        assert (done.returncode, done.stderr) == (0, '')
        assert '2 late, 0 expired, 1 failed\n' in done.stdout
        assert '2 late, 0 expired, 1 failed<' in page.read_text()
        failure = ElementTree.parse(out).getroot().find('testsuite/testcase/failure')
        assert failure is not None and failure.attrib['message'] == (
            '3 of 10 jobs missed the deadline (1 failed: a callback raised)')
        dag = call('replay', failed, *mode, '--json', '-').result['dags']['/n']
        assert dag['ends'] == {'completed': 7, 'late': 2, 'aborted': 0, 'expired': 0, 'failed': 1,
                               'dropped': 0}
        assert dag['sinks']['/n:a']['failed'] == 1
    done = call('diff', trace, failed, '--fail-on-worse')
    assert done.returncode == 1 and '2 late, 0 expired, 1 failed; policy' in done.stdout
    jobs = tmp_path / 'jobs.csv'
    call('export', failed, '-o', jobs, '--rows', 'jobs')
    assert jobs.read_text().count(',failed') == 1


@pytest.mark.parametrize('mode', [[], ['--reschedule']])
def test_a_warm_up_is_left_out(trace, tmp_path, mode, call):
    """The jobs 2 and 3, released 20 ms and 30 ms after the first, are the late ones."""
    for skip, due, late in (('0', 10, 2), ('20ms', 8, 2), ('20001us', 7, 1), ('31ms', 6, 0)):
        arguments = 'replay', trace, *mode, '--skip', skip
        status, out, err = call(*arguments, '--fail-on-miss')
        assert (status, err) == (late > 0, '')
        assert f'{due} results due, {due - late} in time' in out
        assert ('left out: jobs released in the first' in out) == (skip != '0')
        result = call(*arguments, '--json', '-').result
        assert result['dags']['/n']['jobs'] == due
        assert result['dags']['/n']['ends'] == {
            'completed': due - late, 'late': late, 'aborted': 0, 'expired': 0, 'failed': 0,
            'dropped': 0}
        assert result['skip_ns'] == {'0': 0, '20ms': 20 * MS, '20001us': 20_001_000}.get(
            skip, 31 * MS)
    page = tmp_path / 'report.html'
    call(*arguments, '--report', page)
    assert '6 results due, 6 in time (100.00 %)' in page.read_text()


@pytest.mark.parametrize('mode', [[], ['--reschedule']])
def test_where_nothing_was_due_nothing_is_proven(trace, tmp_path, mode, call):
    """A run of the declaration's nodes in which no job came is no run that held its deadlines."""
    empty, out = tmp_path / 'empty.mcap', tmp_path / 'out.xml'
    with TraceFile(empty) as file:
        file.add('task_set', 0, 1, 1, GRAPH, 'g.yaml', 'rad', 1, 100 * MS, 64, False)
        file.add('dispatch', 10, 1, 5, 7, -1, -1, -1, 0, 10, 0)
        file.add('callback_start', 10, 1, 5, 7, False)
        file.add('callback_end', 20, 1, 5, 7)
        file.add('shutdown', 200 * MS, 1, 1, 200 * MS)
    graph = tmp_path / 'g.yaml'
    graph.write_text(GRAPH.replace('8ms}', '8ms, execution_time: 1ms}'))
    arguments = 'replay', empty, graph, *mode
    page = tmp_path / 'page.html'
    status, said, err = call(*arguments, '--fail-on-miss', '--junit', out, '--report', page)
    assert status == 1 and err.count(f'error: {empty}: no job was due at any sink') == 1
    assert 'never due, so not judged: 1 sink: /n:a' in said
    assert 'No job was due at any sink: nothing is proven.' in page.read_text()
    failure = ElementTree.parse(out).getroot().find('testsuite/testcase/failure')
    assert failure is not None and 'no job was due' in failure.attrib['message']
    assert json.loads(call(*arguments, '--json', '-').stdout)['never_due'] == ['/n:a']


def test_a_run_in_which_nothing_was_due_is_no_better(trace, tmp_path, call):
    empty = tmp_path / 'empty.mcap'
    with TraceFile(empty) as file:
        file.add('task_set', 0, 1, 1, GRAPH, 'g.yaml', 'rad', 1, 100 * MS, 64, False)
        file.add('shutdown', 200 * MS, 1, 1, 200 * MS)
    status, out, err = call('diff', trace, empty, '--fail-on-worse')
    assert status == 1 and 'error' not in err and 'worse, never due in B' in out
    status, _, err = call('diff', empty, empty, '--fail-on-worse')
    assert status == 1 and (
        f'error: {empty} and {empty}: no sink was due in both, so nothing was compared: ' in err)
    assert call('diff', empty, empty).returncode == 0
