# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The HTML report: figures, tables, hostile names; and what is worse in a second run."""

from html.parser import HTMLParser
import io
from pathlib import Path
import re

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor import Replay, replay
from mddag_executor.analysis.deadlines import Judged
from mddag_executor.analysis.paths import Paths
from mddag_executor.core.state import SINK_IN_TIME, SINK_LATE
from mddag_executor.report import html
from mddag_executor.report.diff import callbacks_table, compare, sinks_table
from mddag_executor.report.html_data import (
    COLOURS,
    histogram,
    label,
    MOST_MISSES,
    packed,
    page_data,
    shown_misses,
    unpacked,
)
from mddag_executor.report.html_tables import html_table, sinks_html
from mddag_executor.report.perfetto import write_perfetto
from mddag_executor.whatif.run_writer import write_trace
import msg_graph
import numpy as np
import pytest

from ..sources.recorded import four_jobs, Recorded
from . import runs


class Page(HTMLParser):
    """Collects elements with their attributes, and text that is shown."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.texts = [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data):
        if self.elements and self.elements[-1][0] not in ('script', 'style'):
            self.texts.append(data)


def written(data):
    file = io.BytesIO()
    html.write(file, data)
    return file.getvalue().decode()


def drawn(data):
    return page_data(data, shown_misses(data.timeline.verdicts))


def test_what_is_in_the_file_is_what_ran(tmp_path):
    found = drawn(html.of_outcome(replay(runs.by_hand(tmp_path / 'run.mcap'))))
    bars = found['executions']
    start = np.cumsum(bars['start']) * 1000
    assert (start / runs.MS).tolist() == [0, 2, 10, 13, 20, 27, 31]
    assert ((start + bars['ran']) / runs.MS).tolist() == [1, 5, 12, 16, 26, 30, 33]
    missed, more, unknown = map(COLOURS.index, ('missed', 'more', 'unknown'))
    assert bars['colour'] == [more, more, more, more, missed, missed, unknown]
    assert [found['workers'][each] for each in bars['worker']] == [
        *['worker 0', 'worker 1'] * 3, 'spare threads']
    assert [found['lines'][found['lineOf'][each]].label for each in bars['name']] == [
        *['driver:tick', 'filter:run'] * 3, 'extra']
    assert [found['declared'] - 1 if each < 0 else each for each in bars['sink']] == [1] * 7
    jobs = found['jobs']
    assert np.cumsum(jobs['job']).tolist() == [0, 1, 2] and jobs['dag'] == [0] * 3
    assert (np.cumsum(jobs['release']) * 1000 / runs.MS).tolist() == [0, 10, 20]
    verdicts, (place,) = found['verdicts'], found['misses']
    verdicts['release'] = (np.cumsum(verdicts['release']) * 1000).tolist()
    assert {name: column[place] for name, column in verdicts.items()} == {
        'sink': 1, 'job': 2, 'release': 20 * runs.MS, 'response': 10 * runs.MS,
        'kind': found['kinds'].index('late')}
    assert found['deadlines'][1] == 8 * runs.MS


class Responses:
    """What a histogram needs of a sink."""

    def __init__(self, deadline_ms, *responses_ms):
        self.relative_deadline_ns = deadline_ms * runs.MS
        self.responses = [ms * runs.MS for ms in responses_ms]


@pytest.mark.parametrize('responses', [
    [5] * 100 + [20_000] * 3 + [60_000] * 2, [5, 60_000], [60_000], [1, 10, 11], [3], [10]])
def test_a_histogram_says_where_each_response_is(responses):
    found = histogram('sink', Responses(10, *responses))
    width, later = found['width'], found['later'] or [0, 0, 0]
    shown = [(place * width / runs.MS, (place + 1) * width / runs.MS, n)
             for place, n in found['bars']]
    for low, high, n in shown:
        assert sum(low < each * (1 + 1e-9) and each * (1 - 1e-9) <= high
                   for each in responses) == n
        assert high <= 10 * (1 + 1e-9) or low >= 10 * (1 - 1e-9)      # in time, or late
    n_later, least, most = later
    assert n_later + sum(n for *_, n in shown) == len(responses)
    if n_later:
        assert sorted(responses)[-n_later] * runs.MS == least
        assert max(responses) * runs.MS == most


def test_each_sink_that_misses_is_in_the_list_of_misses():
    """One sink is late by seconds in many jobs, others by little, or never complete."""
    jobs = [(0, 10_000, 5_000), *[(0, 10, 3_000)] * 600, *((sink, 10, 11) for sink in (1, 2)),
            (3, 10, None), (4, 10, 9)]
    verdicts = np.zeros(len(jobs), dtype=[(name, 'i8') for name in (
        'sink', 'release', 'deadline', 'until', 'completed', 'kind')])
    for row, (sink, deadline, completed) in zip(verdicts, jobs):
        late = completed is None or completed > deadline
        row['sink'], row['deadline'], row['kind'] = sink, deadline, SINK_LATE * late
        row['completed'] = -1 if completed is None else completed
        row['until'] = deadline if completed is None else completed
    assert SINK_IN_TIME == 0
    shown = verdicts[shown_misses(verdicts)]
    assert len(shown) == MOST_MISSES and set(shown['sink'].tolist()) == {0, 1, 2, 3}


def test_a_miss_says_behind_whom_it_waited(tmp_path):
    task_set = msg_graph.loads("""\
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: slow, timer: 100ms, deadline: 100ms, execution_time: 40ms}]}
  - {node: /b, callbacks: [{name: quick, timer: 20ms, deadline: 10ms, execution_time: 1ms}]}
""", 'g.yaml')
    load, run = runs.simulated(task_set, ms=400, workers=1, utilisation=0.45)
    write_trace(tmp_path / 'run.mcap', task_set, load, run)
    outcome = replay(tmp_path / 'run.mcap')
    waited = outcome.table('causes')
    assert {*zip(waited['sink'].tolist(), waited['behind'].tolist())} == {(1, '/a:slow')}
    text = written(html.of_outcome(outcome))
    misses = text[text.index('id="mddag-misses"'):text.index('id="mddag-sinks"')]
    assert '>mostly behind<' in misses
    assert '<td class="text">waited</td><td class="text">a:slow</td>' in misses


def test_bars_of_the_table_have_the_colours_of_the_legend(tmp_path):
    text = written(html.of_outcome(replay(runs.by_hand(tmp_path / 'run.mcap', took=(1, 2, 3)))))
    assert '<i class="least"' in text       # 7 of 8 ms: 12.5 % are left
    legend = text[text.index('class="legend"'):]
    assert '<i class="least"></i>slack below 10 %' in legend


def test_what_is_not_due_is_not_marked_as_bad():
    task_set = runs.autoware()
    data = html.of_run(task_set, *runs.simulated(task_set, ms=50))
    sink = next(iter(next(iter(data.result['dags'].values()))['sinks'].values()))
    sink.update(late=12345, not_due=67890)
    cells = dict(re.findall(r'<td( class="bad")?>(12345|67890)<', sinks_html(data)))
    assert cells == {' class="bad"': '12345', '': '67890'}


def test_a_run_without_graph_shows_its_messages_and_nothing_of_misses(tmp_path):
    path = tmp_path / 'run.mcap'
    four_jobs(path)
    text = written(html.of_outcome(replay(path)))
    assert '0.000' not in text[:text.index('<script')]
    assert 'utilisation by all callbacks</b> 0.037' in text
    assert '<h2>Messages</h2>' in text and '>/detect subscription /image<' in text
    for name in ('mddag-next', 'mddag-previous', 'class="missed"', '<h2>Missed', 'class="gap"'):
        assert name not in text[:text.index('<script')], name


def test_threads_of_imported_recordings_have_the_names_of_their_processes(tmp_path):
    recorded = Recorded(tmp_path / 'run.mcap')
    for pid, tid, name in ((1, 7, 'camera_main'), (2, 9, '')):
        recorded.node(1, f'/n{pid}', pid=pid)
        recorded.timer(11, 1, 100 * runs.MS, pid=pid)
        recorded.run(11, tid, 100 * runs.MS, (100 + pid) * runs.MS, pid=pid)
        if name:
            recorded.add('mddag:process', 0, tid, name, pid=pid)
    outcome = replay(recorded.write())
    assert drawn(html.of_outcome(outcome))['workers'] == [
        'camera_main 1, thread 7', 'process 2, thread 9']
    file = io.BytesIO()
    write_perfetto(file, outcome)
    assert b'camera_main 1, thread 7' in file.getvalue()


def test_what_is_left_out_is_hatched_and_in_the_legend(tmp_path, monkeypatch):
    monkeypatch.setattr('mddag_executor.report.timeline.Timeline.__init__.__defaults__', (20, 5))
    data = html.of_outcome(replay(runs.by_hand(tmp_path / 'run.mcap', took=[2] * 60)))
    assert drawn(data)['gaps'] and '</i>executions left out' in written(data)


def test_a_page_needs_nothing_but_itself_and_hostile_names_stay_text(tmp_path):
    page = Page(written(html.of_outcome(
        replay(runs.by_hand(tmp_path / 'run.mcap', hostile=True)))))
    assert any(tag == 'script' for tag, _ in page.elements)
    for tag, attributes in page.elements:
        assert tag not in ('iframe', 'object', 'embed', 'base')
        for name in ('src', 'href', 'srcset', 'action', 'data'):
            value = attributes.get(name)
            assert value is None or value.startswith('data:'), (tag, value)
    style = Path(html.__file__).with_name('html.css').read_text(encoding='utf-8')
    assert 'url(' not in style and '@import' not in style
    assert not [tag for tag, _ in page.elements if tag == 'img']
    shown = runs.HOSTILE.rpartition('/')[2].replace('\x1b', '\\x1b')
    assert shown in ''.join(page.texts)     # in the title
    assert not any('\x1b' in text for text in page.texts)
    assert all('hacked' not in (value or '')
               for _, attributes in page.elements for value in attributes.values())


@given(st.text())
def test_json_and_cells_hold_any_text(text):
    encoded = packed({'x': text})
    assert unpacked(encoded) == {'x': text}
    assert re.fullmatch('[A-Za-z0-9+/=]+', encoded)
    page = Page(html_table(('a',), [(text,)], 1))
    assert [tag for tag, _ in page.elements] == ['table', 'thead', 'tr', 'th', 'tbody', 'tr', 'td']
    assert len(label(text, 20)) <= 20


def test_a_run_without_anything_has_a_report_too():
    task_set = runs.autoware()
    load, run = runs.simulated(task_set, ms=1, workers=1)
    data = html.of_run(task_set, load._replace(times=[], dags=[], jobs=[]), run)
    assert len(drawn(data)['misses']) == min(MOST_MISSES, data.timeline.n_missed)
    assert '</html>' in written(data)


@pytest.mark.parametrize('others', [(), ('move, timer: 2ms, deadline: 2ms',)])
def test_dags_without_a_deadline_have_a_report(others):
    declared = ('update, timer: 1ms, publishes: [/map]',
                'keep, subscription: /map, deadline: none', *others)
    callbacks = ', '.join(f'{{execution_time: 10us, name: {each}}}' for each in declared)
    task_set = msg_graph.loads(
        f'{{mddag: 1, nodes: [{{node: /n, callbacks: [{callbacks}]}}]}}', 'g.yaml')
    data = html.of_run(task_set, *runs.simulated(task_set, ms=5, workers=1))
    assert len(drawn(data)['lines']) >= len(declared)


@pytest.fixture
def result(tmp_path):
    return replay(runs.by_hand(tmp_path / 'run.mcap')).result()


def slow(p99, most):
    return {'response_ns': {'min': 1, 'median': 2, 'p99': p99, 'max': most}}


MS = runs.MS


@pytest.mark.parametrize(('sink', 'tolerance', 'worse'), [
    ({'late': 2}, None, True), ({'late': 0}, None, False),
    ({'completed': 6, 'late': 2}, None, False),         # the same share
    ({'completed': 6, 'late': 3}, None, True),
    ({'expired': 1}, None, True),
    (slow(11 * MS, 11 * MS), None, False), (slow(11 * MS, 11 * MS), 0.1, False),
    (slow(11 * MS + 1, 12 * MS), 0.1, True), (slow(9 * MS, 12 * MS), 0.0, False),
    ({'response_ns': None}, 0.0, False)])
def test_what_is_worse(result, sink, tolerance, worse):
    before = result['dags']['/driver']['sinks']['/filter:run']
    after = {**result, 'dags': {'/driver': {'sinks': {'/filter:run': {**before, **sink}}}}}
    assert compare(result, after, tolerance)['worse'] is worse


def test_what_only_one_run_has(result, tmp_path):
    graph = runs.GRAPH.replace('deadline: 8ms', 'deadline: 5ms').replace('name: whole', 'name: w')
    other = replay(runs.by_hand(tmp_path / 'other.mcap'), msg_graph.loads(graph)).result()
    assert 'worse, deadline in B 5 ms' in sinks_table(compare(result, other)['dags'])
    lacking = {**result, 'dags': {}, 'callbacks': {}}
    assert 'only in A' in sinks_table(compare(result, lacking)['dags'])
    difference = compare(lacking, result)
    assert 'only in B' in sinks_table(difference['dags']) and not difference['worse']
    assert 'driver:tick' in callbacks_table(difference)


def test_a_report_computes_nothing_twice(tmp_path, call, monkeypatch):
    calls = []
    for owner, name in ((Replay, 'result'), (Paths, 'results'), (Judged, '__init__')):
        method = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *args, method=method, **options: (
            calls.append(method), method(*args, **options))[1])
    done = call('replay', runs.by_hand(tmp_path / 'run.mcap'), '--json', tmp_path / 'a.json',
                '--report', tmp_path / 'r.html')
    assert done.returncode == 0 and len(calls) == len(set(calls)) == 3


def test_a_dag_without_deadlines_has_a_report(tmp_path, call):
    (tmp_path / 'g.yaml').write_text("""\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: log, timer: 20ms, deadline: none, execution_time: 1ms}
      - {name: act, timer: 10ms, deadline: 5ms, execution_time: 1ms}
""")
    done = call('simulate', tmp_path / 'g.yaml', '--duration', '100ms', '--trace',
                tmp_path / 'r.mcap', '--report', tmp_path / 'a.html')
    assert (done.returncode, done.stderr) == (0, '')
    done = call('replay', tmp_path / 'r.mcap', '--report', tmp_path / 'b.html')
    assert (done.returncode, done.stderr) == (0, '')
    assert 'log' in (tmp_path / 'b.html').read_text()


def test_the_verdict_names_the_paths_that_take_longer_than_required(tmp_path, call):
    """Before, it was red, and said that all results were in time."""
    (tmp_path / 'g.yaml').write_text("""\
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: first, timer: 10ms, publishes: [/x], execution_time: 1ms}]}
  - {node: /b, callbacks: [{name: last, subscription: /x, deadline: 8ms, execution_time: 2ms}]}
paths: [{name: ab, callbacks: ['/a:first', '/b:last'], age: 2ms}]
""")
    call('simulate', tmp_path / 'g.yaml', '--duration', '105ms', '--trace', tmp_path / 'r.mcap')
    done = call('replay', tmp_path / 'r.mcap', '--report', tmp_path / 'r.html')
    assert (done.returncode, done.stderr) == (0, '')
    page = (tmp_path / 'r.html').read_text()
    verdict = page[page.index('<div class="verdict bad">'):].partition('</div>')[0]
    assert ('<p>ab: the required age is not met: '
            '11 of 11 outputs later than required (2ms)</p>') in verdict
