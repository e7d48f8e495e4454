# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Verdicts from tables are those of the driver, of the scheduler core, and of each part."""

from dataclasses import FrozenInstanceError, replace
from pathlib import Path
import re
import tempfile

from hypothesis import example, given
from hypothesis import strategies as st
from mddag_executor import open_recording, Replay, ReplayError, reschedule
from mddag_executor.analysis.deadlines import Judged
from mddag_executor.core import NEVER
from mddag_executor.core.state import DROP, JOB_END, SINK_NOT_DUE
from mddag_executor.core.tally import total
from mddag_executor.recording.tables import ABORTED, EXPIRED, FAILED, TABLES, WITHDRAWN
from msg_graph import loads
import numpy as np
import pytest

from ..conftest import examples
from ..sources.helpers import Chances, declarations, MS, PATHS, SMALL, VirtualRun
from .graphs import TWO_RATES
from .oracle import Oracle
from .told import Told

DEMO = Path(__file__).resolve().parents[2] / 'bags' / 'demo_short.mcap'


def check(recording, skip=0):
    judged, oracle = Judged(recording, skip), Oracle(recording, skip)
    assert judged.tally.result() == oracle.tally.result()
    expected = [each for each in oracle.decisions
                if each[0] not in (JOB_END, DROP, SINK_NOT_DUE)]
    columns = ('kind', 'dag', 'sink', 'job', 'deadline', 'completed')
    found = judged.verdicts[list(columns)].tolist()
    if any(callback.driven_by for callback in recording.task_set.callbacks):
        found, expected = sorted(found), sorted(expected)   # one execution completes several jobs
    assert found == expected


@given(st.integers(0, 2**32), st.data())
@examples(25)
def test_verdicts_of_any_tables(seed, data):
    """Tables that no executor records: ends and completions in any order, twice, or of no job."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'run.mcap')
        VirtualRun(path, loads(SMALL + PATHS, 'g.yaml'), seed, duration=150 * MS,
                   chances=Chances(undeclared=1))
        recording = open_recording(path)
    generator = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    tables = [recording.releases, recording.executions, recording.job_ends]
    tables = [table[generator.integers(0, len(table), len(table))] if place and len(table)
              else table.copy() for place, table in enumerate(tables)]
    orders = np.concatenate([table['order'][table['order'] >= 0] for table in tables])
    ranks = generator.permutation(len(orders)) if data.draw(st.booleans()) else \
        np.argsort(np.argsort(orders, kind='stable'), kind='stable')
    at = 0
    for table in tables:
        known = table['order'] >= 0
        table['order'][known] = 2 * ranks[at:at + int(known.sum())]
        at += int(known.sum())
    tables[2]['reason'] = generator.choice([EXPIRED, ABORTED, FAILED, WITHDRAWN], len(tables[2]))
    releases = tables[0][np.argsort(tables[0]['order'])]
    for dag in np.unique(releases['dag']).tolist():     # jobs are released by their numbers
        mine = releases['dag'] == dag
        releases['job'][mine] = np.sort(releases['job'][mine])
    hosted = [] if data.draw(st.booleans()) else [
        (-1, 0, frozenset(generator.choice(
            5, int(generator.integers(0, 5)), replace=False).tolist()))]
    start = recording.start or 0
    changed = replace(
        recording, columns=replace(
            recording.columns, releases=releases, executions=tables[1], job_ends=tables[2]),
        run=replace(
            recording.run, hosted=hosted,
            judged_order=int(generator.integers(0, len(orders) + 1)) * 2 - 1,
            judge_from=start + 50 * MS if data.draw(st.booleans()) else -NEVER))
    check(changed, data.draw(st.sampled_from([0, 30 * MS])))


def verdicts(replay):
    columns = ['kind', 'dag', 'sink', 'job', 'release', 'deadline', 'completed']
    return sorted(replay.judged.verdicts[columns].tolist())


def links(table, column, other, *names):
    rows = table[column]
    return other[list(names)][rows[rows >= 0]].tolist()


def chains_of(jobs):
    """Return of misses what does not depend on other jobs."""
    return sorted(
        (each['sink'], each['job'], list(dict.fromkeys(part['vertex'] for part in each['parts'])))
        for each in jobs)


def check_parts(recording, borders):
    whole = Replay(recording)
    start = recording.start or 0
    found = []
    for begin, end in zip(borders, borders[1:]):
        part = Replay(recording.cut(begin, end))
        of_part = verdicts(part)
        found += of_part
        assert all(start + begin <= each[4] < start + end for each in of_part)
        assert part.chains.breakdown().keys() == {each[2] for each in of_part if each[6] >= 0}
        expected = [each for each in whole.explanation.result()['jobs'] if start + begin <= each[
            'release_ns'] < start + end]
        assert chains_of(part.explanation.result()['jobs']) == chains_of(expected)
        assert not part.judged.contradictions
        check_rows(recording, part.recording, start + begin, start + end)
    assert sorted(found) == verdicts(whole)


def check_rows(whole, part, begin, end):
    """All that ran within the part is in it, and rows refer to what they did."""
    ran = whole.executions
    inside = ran[(ran['start'] >= begin) & (ran['start'] < end) & (ran['end'] < end)]
    columns = ['callback', 'dag', 'vertex', 'job', 'start', 'end', 'worker', 'completes']
    missing = set(inside[columns].tolist()).difference(part.executions[columns].tolist())
    assert not missing
    by = ('callback', 'start', 'end')
    sent = whole.publications[np.isin(whole.publications['time'], part.publications['time'])]
    assert set(links(part.publications, 'execution', part.executions, *by)) <= set(
        links(sent, 'execution', whole.executions, *by))
    assert (part.publications['execution'] < len(part.executions)).all()
    for time, row in part.publications[['time', 'execution']].tolist():
        if row >= 0:
            assert part.executions['start'][row] <= time <= part.executions['end'][row]


def check_counts(run, outcome):
    assert outcome.warnings == []
    result = outcome.result()
    expected = run.tally.result()
    total = 0
    for dag in result['dags'].values():
        for sink in dag['sinks'].values():
            del sink['slack_ns']
            total += check_breakdown(sink.pop('breakdown'), sink)
    assert total == pytest.approx(sum(run.responses), rel=1e-6)
    assert {key: result[key] for key in expected} == expected
    assert (result['policy'], result['workers'], result['preemptive']) == (
        run.policy, run.workers, False)
    for key, use in result['callbacks'].items():
        assert use['executions'] == run.executions[key]
        assert use['busy_ns'] == run.busy[key]
        assert use['waiting_ns'] == run.waited[key]
    assert sum(result['dropped'].values()) == run.drops
    assert result['worker_use']['use'] <= 1


def check_breakdown(breakdown, sink):
    """Compare the parts of the response times with them; return the sum of all."""
    if breakdown is None:
        return 0
    worst = breakdown['worst']
    parts = [worst[key] for key in breakdown['mean']]
    assert sum(parts) == worst['completed_ns'] - worst['release_ns'] == sink['response_ns']['max']
    assert worst['chain'][-1]['end_ns'] == worst['completed_ns']
    assert min(parts) >= 0
    return sink['completed'] * sum(breakdown['mean'].values())


# d runs before b is known to be silent, and before c completes
EARLY = """\
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: cb, timer: 10ms, publishes: [/a]}]}
  - {node: /b, callbacks: [{name: cb, subscription: /a, may_publish: [/b]}]}
  - {node: /c, callbacks: [{name: cb, sync: [/a, /b], publishes: [/c]}]}
  - {node: /d, callbacks: [{name: cb, subscription: /c, publishes: [/d]}]}
  - {node: /e, callbacks: [{name: cb, sync: [/a, /d], deadline: 3ms}]}
"""


@given(declarations(), st.integers(0, 2**32), st.integers(1, 4),
       st.sampled_from(['rad', 'fifo', 'rm']), st.integers(1, 25),
       st.sampled_from([0, 70 * MS]), st.lists(st.integers(1, 150), max_size=3, unique=True))
@examples(25)
@example(SMALL, 1, 2, 'rad', 8, 0, [])
@example(SMALL + PATHS, 1, 2, 'rad', 20, 0, [40, 90])
@example(EARLY, 1, 2, 'fifo', 1, 0, [])
def test_any_run(text, seed, workers, policy, longest, skip, borders):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'run.mcap')
        run = VirtualRun(path, loads(text, 'g.yaml'), seed, workers, policy,
                         longest=longest * MS, shut_down=seed % 3 > 0)
        recording = open_recording(path)
        if run.shut_down:
            check_counts(run, Replay(recording))
        check(recording, skip)
        try:
            other = open_recording(path, loads(SMALL, 'other.yaml'))
        except ReplayError as error:
            assert 'none of the callbacks' in str(error)
        else:
            check(other, skip)
    length = recording.end - (recording.start or 0)
    inner = [border * MS for border in sorted(borders) if border * MS < length]
    check_parts(recording, [0, *inner, 2 ** 62])


def test_a_bag_and_its_parts():
    recording = open_recording(DEMO)
    check(recording)
    check_parts(recording, [0, 200 * MS, 210 * MS, 900 * MS, 1400 * MS, 2 ** 62])
    part = recording.cut(200 * MS, 500 * MS)
    assert part.start == (recording.start or 0) + 200 * MS
    assert 0 < len(part.executions) < len(recording.executions) / 2
    for begin, end in ((-1, 5), (5, 5)):
        with pytest.raises(ValueError, match='is not a range of time'):
            recording.cut(begin, end)
    with pytest.raises(ReplayError, match='it ends 1.4.. s after its first release'):
        recording.cut(10 ** 12, 2 ** 62)


def test_a_part_that_is_rescheduled_has_the_results_of_the_part():
    part = open_recording(DEMO).cut(500 * MS, 600 * MS)
    before, after = Replay(part), reschedule(part)
    assert [sum(each.tally.jobs) for each in (before, after)] == [20, 20]
    assert total(after.result()['dags']).due == total(before.result()['dags']).due == 37
    computed = Replay(after.computed().recording(7))
    assert computed.tally.result()['dags'] == after.tally.result()['dags']
    assert 0 < after.result()['worker_use']['use'] < 1


def test_a_recording_in_a_program(tmp_path):
    recording = open_recording(DEMO)
    graph = tmp_path / 'graph.yaml'
    graph.write_text(recording.task_set.text)
    for path in (graph, str(graph)):
        judged = open_recording(DEMO, path)
        assert judged.task_set.file == str(graph)
        assert (judged.executions == recording.executions).all()
    assert re.fullmatch(
        r'<Recording .*demo_short\.mcap: 1\.4\d\d s, \d+ jobs, \d+ executions>', repr(recording))
    with pytest.raises(KeyError, match="no table 'nope': the tables are releases, executions, "):
        recording.to_pandas('nope')
    table = recording.executions.copy()
    table['end'][0] = -1    # a missing value rounds no other
    changed = replace(recording, columns=replace(recording.columns, executions=table))
    ends = changed.to_pandas('executions').end
    assert ends.isna()[0] and ends[1:].tolist() == recording.executions['end'][1:].tolist()


def test_a_finished_recording_is_not_written(tmp_path):
    path = tmp_path / 'run.mcap'
    VirtualRun(path, loads(SMALL, 'g.yaml'), 0)
    for recording in (open_recording(path), reschedule(path).computed().recording(),
                      open_recording(path).cut(0, 100 * MS),
                      open_recording(path, loads(SMALL, 'other.yaml'))):
        for name, kind in TABLES.items():
            for column in kind.names:
                with pytest.raises(ValueError, match='read-only'):
                    getattr(recording, name)[column] = 0
        for each, field in ((recording, 'run'), (recording.run, 'end'),
                            (recording.columns, 'releases')):
            with pytest.raises(FrozenInstanceError):
                setattr(each, field, None)


@pytest.mark.parametrize('has_stamps', [True, False])
def test_an_imported_sync_of_two_rates(tmp_path, has_stamps):
    """Two scans wait, and the first boxes are fused with the older one."""
    told = Told(tmp_path / 'a.mcap', TWO_RATES)
    for at in 0, 100:
        told.ran('/lidar:read', at, at + 2, sends=[(at + 1, '/points', has_stamps * (at + 5))])
        told.ran('/fusion:fuse', at + 3, at + 4, at + 1, '/points')
    for at, scan in (130, 0), (200, 100):
        told.ran('/boxes:find', at, at + 2, sends=[(at + 1, '/boxes', at)])
        told.ran('/fusion:fuse', at + 3, at + 10, at + 1, '/boxes',
                 [(at + 9, '/fused', has_stamps * (scan + 5))])
        told.ran('/brake:stop', at + 11, at + 12, at + 9, '/fused')
    result = Replay(open_recording(told.write(), told.task_set)).result()
    response = result['dags']['/lidar']['sinks']['/brake:stop']['response_ns']
    assert (response['min'] // MS, response['max'] // MS) == (112 if has_stamps else 42, 142)
    assert result.get('guessed', {}) == ({} if has_stamps else {'/fusion:fuse': 1})


def test_a_sync_that_waited_for_another_topic_says_so(tmp_path):
    """Its driving message was there: no message was on its way for so long."""
    told = Told(tmp_path / 'a.mcap', TWO_RATES.replace('150ms', '30ms'))
    told.ran('/lidar:read', 0, 2, sends=[(1, '/points', 5)])
    told.ran('/fusion:fuse', 3, 4, 1, '/points')
    told.ran('/boxes:find', 130, 132, sends=[(131, '/boxes', 130)])
    told.ran('/fusion:fuse', 133, 140, 131, '/boxes', [(139, '/fused', 5)])
    told.ran('/brake:stop', 141, 142, 139, '/fused')
    result = Replay(open_recording(told.write(), told.task_set)).explanation.result()
    assert {cause: n for cause, n in result['causes'].items() if n} == {'other topic': 1}
    job, = result['jobs']
    assert [(p['vertex'], p['ns'] // MS) for p in job['parts'] if p['cause'] == 'other topic'] == [
        ('/fusion:fuse', 129)]
