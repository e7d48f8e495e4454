# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Tolerated misses, failed jobs and runs without a job, wherever verdicts are shown."""

import json
from xml.etree import ElementTree

from mddag_executor.core.tally import SinkTally
from mddag_executor.core.tolerances import not_tolerated
from mddag_executor.report.ci import annotation_lines, junit
import pytest

from ..sources.helpers import MS, ns, Written

GRAPH = """\
mddag: 1
nodes:
  - {node: /n, callbacks: [{name: a, timer: 10ms, deadline: 8ms}]}
"""
MODES = pytest.mark.parametrize('mode', [[], ['--reschedule']])
HOSTILE = 'a"]]><&\'\x00\x1b[2J\n\ud800\uffff\u202e</testcase>'


def sink_of(*responses):
    tally = SinkTally(8 * MS, None)
    for response in responses:
        tally.done(response * MS, response > 8)
    return tally.result()


def test_junit_and_annotations_with_hostile_names():
    sinks = {HOSTILE: sink_of(9, 10, 11), 'good': sink_of(8), 'none': sink_of()}
    result = {'dags': {HOSTILE: {'sinks': sinks}}, 'duration_ns': 30 * MS, 'policy': 'rad',
              'workers': 2, 'preemptive': False, 'rescheduled': False, 'warnings': [HOSTILE]}
    broken = not_tolerated(result['dags'])
    assert list(broken) == [(HOSTILE, HOSTILE)]
    suite = ElementTree.fromstring(junit(result, broken, {}, HOSTILE))[0]
    assert {key: suite.attrib[key] for key in ('tests', 'failures', 'errors', 'skipped')} == {
        'tests': '3', 'failures': '1', 'errors': '0', 'skipped': '1'}
    bad, good, none = suite.findall('testcase')
    assert bad.find('failure').attrib['message'] == '3 of 3 jobs missed the deadline'
    for text in (bad.attrib['name'], bad.attrib['classname'], suite.attrib['name']):
        assert '\\x00' in text and '\\x1b[2J\\n\\ud800' in text
        assert all(c.isprintable() for c in text)
    assert good.find('failure') is None and good.find('skipped') is None
    assert none.find('skipped') is not None

    bad, none = annotation_lines(result, broken, {}, 'a,b:c%.yaml')
    assert bad.startswith('::error file=a%2Cb%3Ac%25.yaml,title=Deadline of a"]]><&')
    assert bad.isprintable() and bad.count('::') == 2
    assert bad.endswith('::3 of 3 jobs missed the deadline')
    assert none == ('::warning file=a%2Cb%3Ac%25.yaml,title=Deadline of none::'
                    'no job of it was due')


def failure_in(path):
    failure = ElementTree.parse(path).getroot().find('testsuite/testcase/failure')
    return None if failure is None else failure.attrib['message']


def record(path, failed=()):
    """Record ten jobs, of which the third and the fourth are late."""
    trace = Written(path, GRAPH)
    for job in range(10):
        release = (job + 1) * 10
        end = release + (9 if job in (2, 3) else 1)
        trace.release(0, job, release)
        if job in failed:
            trace.add('fail', end, 0, 0, job)
            trace.add('deadline', end, 0, 0, job, ns(release + 8), -1)
        trace.run(0, 0, job, release, end)
        if job in (2, 3):
            trace.add('deadline', end, 0, 0, job, ns(release + 8), ns(end))
    return trace.end(200)


@pytest.fixture
def trace(tmp_path):
    return record(tmp_path / 'run.mcap')


@pytest.fixture
def empty(tmp_path):
    """Give a run of the declaration's nodes in which no job came."""
    trace = Written(tmp_path / 'empty.mcap', GRAPH)
    trace.piece(-1, -1, -1, 10, 20)
    return trace.end(200)


@pytest.mark.parametrize(('tolerate', 'kept'), [('2 of 3', True), ('1 of 2', False)])
@MODES
def test_the_declaration_says_what_a_sink_tolerates(
        trace, graph, tmp_path, tolerate, kept, mode, call):
    out = tmp_path / 'out.xml'
    graph.write_text(GRAPH.replace('8ms}', f'8ms, tolerate: {tolerate}}}'))
    arguments = 'replay', trace, graph, *mode
    assert call(*arguments, '--fail-on-miss', '--junit', out).returncode == (not kept)
    misses, of = map(int, tolerate.split(' of '))
    assert failure_in(out) == (None if kept else (
        f'2 of {of} jobs in a row missed the deadline, tolerated: {tolerate}'))
    result = call(*arguments, '--json', '-').result
    assert result['dags']['/n']['sinks']['/n:a']['tolerate'] == {
        'misses': misses, 'of': of, 'worst': 2}


def test_a_simulation_respects_it(graph, call):
    late = GRAPH.replace('8ms}', '8ms, execution_time: 9ms}')
    for tolerate, status in (('', 1), (', tolerate: 9 of 10', 1), (', tolerate: 10 of 11', 0)):
        graph.write_text(late.replace('9ms}', f'9ms{tolerate}}}'))
        done = call('simulate', graph, '--duration', '105ms', '--fail-on-miss')
        assert done.returncode == status and (' 10 of 11 ' in done.stdout or status)


@MODES
def test_a_failed_job_is_told_wherever_verdicts_are(trace, tmp_path, mode, call):
    """The first job's callback raised, in a run that was in time but for the third and fourth."""
    failed, out = record(tmp_path / 'failed.mcap', failed=[0]), tmp_path / 'out.xml'
    page, jobs = tmp_path / 'page.html', tmp_path / 'jobs.csv'
    done = call('replay', failed, *mode, '--junit', out, '--report', page)
    assert (done.returncode, done.stderr) == (0, '')
    assert '2 late, 0 expired, 1 failed\n' in done.stdout
    assert '2 late, 0 expired, 1 failed<' in page.read_text()
    assert failure_in(out) == '3 of 10 jobs missed the deadline (1 failed: a callback raised)'
    dag = call('replay', failed, *mode, '--json', '-').result['dags']['/n']
    assert {end: n for end, n in dag['ends'].items() if n} == {
        'completed': 7, 'late': 2, 'failed': 1}
    assert dag['sinks']['/n:a']['failed'] == 1
    if not mode:
        done = call('diff', trace, failed, '--fail-on-worse')
        assert done.returncode == 1 and '2 late, 0 expired, 1 failed; policy' in done.stdout
        call('export', failed, '-o', jobs, '--rows', 'jobs')
        assert jobs.read_text().count(',failed') == 1


@MODES
def test_where_nothing_was_due_nothing_is_proven(empty, graph, tmp_path, mode, call):
    graph.write_text(GRAPH.replace('8ms}', '8ms, execution_time: 1ms}'))
    arguments = 'replay', empty, graph, *mode
    out, page = tmp_path / 'out.xml', tmp_path / 'page.html'
    status, said, err = call(*arguments, '--fail-on-miss', '--junit', out, '--report', page)
    assert status == 1 and err.count(f'error: {empty}: no job was due at any sink') == 1
    assert 'never due, so not judged: 1 sink: /n:a' in said
    assert 'No job was due at any sink: nothing is proven.' in page.read_text()
    assert 'no job was due' in failure_in(out)
    done = call(*arguments, '--json', '-')
    assert done.returncode == 2 and json.loads(done.stdout)['never_due'] == ['/n:a']


def test_a_run_in_which_nothing_was_due_is_no_better(trace, empty, call):
    status, out, err = call('diff', trace, empty, '--fail-on-worse')
    assert status == 1 and 'error' not in err and 'worse, never due in B' in out
    status, _, err = call('diff', empty, empty, '--fail-on-worse')
    assert status == 1 and (
        f'error: {empty} and {empty}: no sink was due in both, so nothing was compared: ' in err)
    assert call('diff', empty, empty).returncode == 0


@pytest.mark.parametrize('key, status', [('sporadic: true', 0), ('once: true', 0), ('', 1)])
def test_a_sink_that_need_not_be_due_is_not_worse_when_it_was_not(tmp_path, call, key, status):
    """In the second run nothing has released it: the button was not pressed."""
    works = GRAPH.replace('8ms}', '8ms, execution_time: 1ms}')
    pressed = works + ('  - node: /button\n    callbacks:\n      - {name: press, timer: 20ms, '
                       f'{key + ", " if key else ""}deadline: 8ms, execution_time: 1ms}}\n')
    runs = []
    for name, text in (('both', pressed), ('works', works)):
        graph, trace = tmp_path / f'{name}.yaml', tmp_path / f'{name}.mcap'
        graph.write_text(text)
        assert call('simulate', graph, '--duration', '100ms', '--trace', trace).returncode == 0
        runs.append(trace)
    done = call('diff', *runs, tmp_path / 'both.yaml', '--fail-on-worse')
    assert done.returncode == status
    assert ('worse, never due in B' if status else '  never due in B') in done.stdout
