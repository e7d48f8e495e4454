# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""HTML reports as files: what is in them, that they need nothing else, that no name breaks out."""

from __future__ import annotations

import base64
from html.parser import HTMLParser
import io
import json
from pathlib import Path
import re
from typing import Any
import zlib

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.replay import replay
from mddag_executor.report import html
from mddag_executor.report.html_data import json_for_html, label, Packer, prepare
from mddag_executor.report.html_tables import Html, html_table, misses_html, worst_html
import numpy as np
import pytest

from . import runs

pytest.importorskip('bokeh', reason='Bokeh is not installed')


def unpack(columns: list[dict[str, Any]], blob: str) -> dict[str, list[int]]:
    """Do what the page's script does."""
    data, at, found = zlib.decompress(base64.b64decode(blob)), 0, {}
    for column in columns:
        n = column['n']
        values = [0] * n
        for plane in range(column['width']):
            for i in range(n):
                values[i] += data[at + i] << 8 * plane
            at += n
        values = [-(u + 1) // 2 if u % 2 else u // 2 for u in values]
        if column['delta']:
            values = np.cumsum(values).tolist() if n else []
        found[column['name']] = values
    assert at == len(data)
    return found


class Page(HTMLParser):
    """Collects elements with their attributes, and text that is shown."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self.scripts: dict[str | None, str] = {}
        self._script: str | None = None
        self._in_script = self._in_style = False
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = dict(attrs)
        self.elements.append((tag, attributes))
        self._in_script, self._in_style = tag == 'script', tag == 'style'
        self._script = attributes.get('id')

    def handle_endtag(self, tag: str) -> None:
        self._in_script = self._in_style = False

    def handle_data(self, data: str) -> None:
        if self._in_script:
            self.scripts[self._script] = self.scripts.get(self._script, '') + data
        elif not self._in_style:
            self.texts.append(data)


def report(path: Path) -> tuple[Page, dict[str, Any]]:
    watch = html.Watch()
    outcome = replay(path, more=watch.of)
    file = io.BytesIO()
    html.write(file, html.of_outcome(outcome, watch))
    page = Page(file.getvalue().decode())
    return page, json.loads(page.scripts['mddag-meta'])


@given(st.lists(st.integers(-2 ** 51, 2 ** 51), max_size=50), st.booleans())
def test_columns_come_back(values: list[int], delta: bool) -> None:
    if delta:
        values = [value >> 2 for value in values]   # differences must fit, too
    packer = Packer()
    packer.add('before', np.array([1, 2, 3]))
    packer.add('values', np.array(values, dtype=np.int64), delta=delta)
    assert unpack(packer.columns, packer.blob()) == {'before': [1, 2, 3], 'values': values}


def test_what_stands_in_the_file_is_what_ran(tmp_path: Path) -> None:
    page, meta = report(runs.by_hand(tmp_path / 'run.mcap'))
    data = unpack(meta['columns'], page.scripts['mddag-data'])
    ms = runs.MS // meta['unit_ns']
    origin = meta['origin_ns']
    assert origin == runs.START + 10 * runs.MS
    # job is stored as the difference to the one before of the same row
    assert data['row'] == [0, 1, 0, 1, 0, 1, 2] and data['job'] == [0, 0, 1, 1, 1, 1, -1]
    assert data['start'] == [t * ms for t in (0, 2, 10, 13, 20, 27, 31)]
    assert data['took'] == [t * ms for t in (1, 3, 2, 3, 6, 3, 2)]
    assert data['wait'] == [t * ms for t in (0, 1, 0, 1, 0, 1, 0)]
    assert data['worker'] == [0, 1, 0, 1, 0, 1, -1]
    assert data['release_time'] == [0, 10 * ms, 20 * ms] and data['release_job'] == [0, 1, 2]
    assert data['verdict_slack'] == [3 * ms, 2 * ms, -2 * ms] and data['verdict_kind'] == [0] * 3
    assert meta['misses'] == [[0, 2]]
    assert [row['name'] for row in meta['rows']] == ['/driver:tick', '/filter:run', 'extra']
    assert meta['rows'][0]['sinks'] == [0] and meta['rows'][2]['sinks'] == []


def test_the_tables_have_the_figures_of_the_replay(tmp_path: Path) -> None:
    page, _ = report(runs.by_hand(tmp_path / 'run.mcap'))
    text = ' '.join(' '.join(page.texts).split())
    assert '3 sink jobs due, 2 in time (66.67 %), 1 late, 0 expired' in text
    assert '/driver filter:run 3 2 66.67 % 1 0 6 ms 10 ms 10 ms 8 ms' in text
    assert '/driver filter:run late 2 0.020000 s 10 ms 2 ms' in text    # the table of misses
    assert '/driver:tick 3 9 ms 3 ms 6 ms 0 ns 0 ns' in text
    bars = [attributes['style'] or '' for tag, attributes in page.elements
            if tag == 'i' and 'width' in (attributes.get('style') or '')]
    assert sum(float(bar.split('%')[0].removeprefix('width:')) for bar in bars) \
        == pytest.approx(100)       # the worst of all fills the scale


def test_misses_stand_by_time_and_worst_jobs_on_one_scale() -> None:
    task_set = runs.autoware()
    load, run = runs.simulated(task_set, ms=1500, utilisation=1.2, preemptive=True)
    data = html.of_run(task_set, load, run)
    text = misses_html(data, prepare(data))
    times = [float(found) for found in re.findall(r'>([0-9.]+) s<', text)]
    assert len(times) > 20 and times == sorted(times)
    page = worst_html(data)
    assert len(set(re.findall(r'<u style="left:([0-9.]+)%"', page))) == 1
    for stack, response, deadline in re.findall(
            r'<div class="stack">(.*?)</div>.*?"response">([^<]*)<.*?"deadline">([^<]*)<', page):
        parts = sum(float(part) for part in re.findall(r'width:([0-9.]+)%', stack))
        line = float(re.search(r'left:([0-9.]+)%', stack)[1])
        assert parts / line == pytest.approx(ms(response) / ms(deadline), rel=0.01)


def ms(text: str) -> float:
    number, unit = text.split()
    return float(number) * {'us': 1e-3, 'ms': 1.0, 's': 1e3}[unit]


def test_a_page_needs_nothing_but_itself(tmp_path: Path) -> None:
    page, _ = report(runs.by_hand(tmp_path / 'run.mcap'))
    assert any(tag == 'script' for tag, _ in page.elements)
    for tag, attributes in page.elements:
        assert tag not in ('iframe', 'object', 'embed', 'base')
        for name in ('src', 'href', 'srcset', 'action', 'data'):
            value = attributes.get(name)
            assert value is None or value.startswith('data:'), (tag, value)
    style = Path(html.__file__).with_name('html.css').read_text(encoding='utf-8')
    assert 'url(' not in style and '@import' not in style


def test_hostile_names_stay_text(tmp_path: Path) -> None:
    page, meta = report(runs.by_hand(tmp_path / 'run.mcap', hostile=True))
    assert not [tag for tag, _ in page.elements if tag == 'img']
    shown = runs.HOSTILE.replace('\x1b', '\\x1b')
    assert meta['rows'][2]['name'] == shown
    assert shown in ''.join(page.texts)     # in the title
    assert not any('\x1b' in text for text in page.texts)
    assert all('hacked' not in (value or '')
               for _, attributes in page.elements for value in attributes.values())


@given(st.text())
def test_json_and_cells_hold_any_text(text: str) -> None:
    encoded = json_for_html({'x': text})
    assert json.loads(encoded) == {'x': text}
    assert not re.search('[<>&]', encoded)
    page = Page(html_table(('a',), [(text,)], 1))
    assert [tag for tag, _ in page.elements] == ['table', 'thead', 'tr', 'th', 'tbody', 'tr', 'td']
    assert len(label(text, 20)) <= 20


def test_markup_is_only_what_says_so() -> None:
    assert '><i></i></td>' in html_table(('a',), [(Html('<i></i>'),)], 0)
    assert '>&lt;i&gt;</td>' in html_table(('a',), [('<i>',)], 0)


def test_end_to_end_times_of_declared_paths(tmp_path: Path) -> None:
    page, _ = report(runs.by_hand(tmp_path / 'run.mcap'))
    watch = html.Watch()
    outcome = replay(runs.by_hand(tmp_path / 'run.mcap'), more=watch.of)
    data = html.of_outcome(outcome, watch)
    assert data.paths == outcome.result()['paths']
    text = ' '.join(' '.join(page.texts).split())
    assert ('worst-with-external-latency' in text) is bool(data.paths)


def test_a_run_without_anything_has_a_report_too() -> None:
    task_set = runs.autoware()
    load, run = runs.simulated(task_set, ms=1, workers=1)
    data = html.of_run(task_set, load._replace(times=[], dags=[], jobs=[]), run)
    assert prepare(data).misses == [] or data.timeline.n_missed
    file = io.BytesIO()
    html.write(file, data)
    assert b'</html>' in file.getvalue()


def test_a_file_stays_small() -> None:
    """Below 20 bytes for an execution, so that a million of them stay below 20 MB."""
    task_set = runs.autoware()
    load, run = runs.simulated(task_set, ms=3000)
    prepared = prepare(html.of_run(task_set, load, run))
    assert prepared.meta['kept'] > 3000
    assert len(prepared.blob) < 15 * prepared.meta['kept']
