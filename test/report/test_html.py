# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The HTML report: figures, tables, hostile names; and what is worse in a second run."""

from html.parser import HTMLParser
import io
import json
from pathlib import Path
import re

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.replay import replay
from mddag_executor.report import html
from mddag_executor.report.diff import callbacks_table, compare, sinks_table
from mddag_executor.report.html_data import (
    COLOURS,
    json_for_html,
    label,
    MOST_MISSES,
    prepare,
    UNKNOWN,
)
from mddag_executor.report.html_tables import html_table
import msg_graph
import pytest

from . import runs

pytest.importorskip('bokeh', reason='Bokeh is not installed')


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


def test_what_is_in_the_file_is_what_ran(tmp_path):
    prepared = prepare(html.of_outcome(replay(runs.by_hand(tmp_path / 'run.mcap'))))
    found = prepared.executions
    assert found['left'] == pytest.approx([0, 0.002, 0.010, 0.013, 0.020, 0.027, 0.031])
    assert found['right'] == pytest.approx([0.001, 0.005, 0.012, 0.016, 0.026, 0.030, 0.033])
    red, light, grey = (COLOURS.index(each) for each in ('#d7191c', '#9ecae1', UNKNOWN))
    assert found['class'].tolist() == [light, light, light, light, red, red, grey]
    # workers from the top, then spare threads; the misses are below all
    assert found['workers'].tolist() == [3, 2, 3, 2, 3, 2, 1]
    assert found['callbacks'].tolist() == [3, 2, 3, 2, 3, 2, 0]
    missed = [prepared.meta['verdicts'][place] for place in prepared.meta['missed']]
    assert missed == [(1, 0, 2, pytest.approx(0.020), 8 * runs.MS, 10 * runs.MS, 'late')]
    assert prepared.marks['x'] == pytest.approx([0.030])


def test_a_page_needs_nothing_but_itself_and_hostile_names_stay_text(tmp_path):
    file = io.BytesIO()
    html.write(file, html.of_outcome(replay(runs.by_hand(tmp_path / 'run.mcap', hostile=True))))
    page = Page(file.getvalue().decode())
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
    encoded = json_for_html({'x': text})
    assert json.loads(encoded) == {'x': text}
    assert not re.search('[<>&]', encoded)
    page = Page(html_table(('a',), [(text,)], 1))
    assert [tag for tag, _ in page.elements] == ['table', 'thead', 'tr', 'th', 'tbody', 'tr', 'td']
    assert len(label(text, 20)) <= 20


def test_a_run_without_anything_has_a_report_too():
    task_set = runs.autoware()
    load, run = runs.simulated(task_set, ms=1, workers=1)
    data = html.of_run(task_set, load._replace(times=[], dags=[], jobs=[]), run)
    assert len(prepare(data).misses) == min(MOST_MISSES, data.timeline.n_missed)
    file = io.BytesIO()
    html.write(file, data)
    assert b'</html>' in file.getvalue()


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
