# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Results as tables: their figures are those of the JSON, and a new file is a new table."""

from collections import Counter
import os
from pathlib import Path
import random

from mddag_executor import replay
from mddag_executor.analysis import result_table, tables
from mddag_executor.analysis.result_table import result_tables
from mddag_executor.core.tally import counts
from mddag_executor.recording.tables import TABLES
from msg_graph import loads
import pytest

from ..sources.helpers import MS, PATHS, SMALL, small, VirtualRun
from .path_systems import random_system, simulated_run

TOP = Path(__file__).resolve().parents[2]
PAGE, MARK = TOP / 'docs' / 'tables.md', '<!-- the results -->\n'


def of_demo(folder):
    return replay(TOP / 'bags' / 'demo_short.mcap')


def of_virtual(folder):
    graph = loads(SMALL.replace('timer: 20ms', 'timer: 20ms, on_late: demote') + PATHS, 's.yaml')
    return replay(VirtualRun(folder / 'run.mcap', graph, seed=5, workers=1).path)


def of_part(folder):
    return replay(VirtualRun(folder / 'run.mcap', small(), seed=8).path, span=(50 * MS, 200 * MS))


def of_paths(folder):
    from mddag_executor.analysis.as_recorded import Replay
    task_set = loads(random_system(random.Random(9)), 'g.yaml')
    return Replay(simulated_run(task_set)[1].recording())


@pytest.fixture(scope='module', params=[of_demo, of_virtual, of_part, of_paths])
def outcome(request, tmp_path_factory):
    return request.param(tmp_path_factory.mktemp('run'))


def rows_of(outcome, name):
    """Return the rows of a table as dictionaries, with names instead of numbers."""
    return outcome.to_arrow(name).to_pylist()


def test_verdicts_and_parts_of_response_times(outcome):
    result, verdicts = outcome.result(), rows_of(outcome, 'verdicts')
    parts = rows_of(outcome, 'response_parts')
    for dag, about in result['dags'].items():
        for sink, found in about['sinks'].items():
            mine = [row for row in verdicts if (row['dag'], row['sink']) == (dag, sink)]
            kinds, every = Counter(row['verdict'] for row in mine), counts(found)
            assert (len(mine), kinds['in_time']) == (every.due, every.in_time)
            assert kinds['late'] + kinds['overdue'] == every.late
            done = [row for row in parts if (row['dag'], row['sink']) == (dag, sink)]
            assert len(done) == found['completed']
            assert sorted((row['job'], row['completed']) for row in done) == sorted(
                (row['job'], row['completed']) for row in mine if row['completed'] is not None)
            if done:
                for name, mean in found['breakdown']['mean'].items():
                    times = [row[name.removesuffix('_ns')] for row in done]
                    assert round(sum(times) / len(times)) == mean
                times = [row['completed'] - row['release'] for row in done]
                assert (min(times), max(times)) == tuple(
                    found['response_ns'][name] for name in ('min', 'max'))


def test_chains(outcome):
    """Each begins with the job's source, if it is known, and the worst ones are those of JSON."""
    chains = {}
    for row in rows_of(outcome, 'chains'):
        mine = chains.setdefault((row['dag'], row['sink'], row['job']), [])
        assert row['place'] == len(mine)
        mine.append(row)
    executions = outcome.recording.executions
    for row in (row for chain in chains.values() for row in chain):
        assert row['start'] == executions['began'][row['execution']]
    for dag, about in outcome.result()['dags'].items():
        for sink, found in about['sinks'].items():
            if found['breakdown'] is not None:
                worst = found['breakdown']['worst']
                links = [{'vertex': row['vertex'], 'ready_ns': row['ready'],
                          'start_ns': row['start'], 'end_ns': row['end'], 'busy_ns': row['busy'],
                          'waiting_group_ns': row['waiting_group'],
                          'waiting_program_ns': row['waiting_program']}
                         for row in chains.get((dag, sink, worst['job']), [])]
                assert links == worst['chain']


def test_causes_of_misses(outcome):
    found = outcome.explanation.result()
    causes, parts = rows_of(outcome, 'causes'), rows_of(outcome, 'miss_parts')
    behind = rows_of(outcome, 'behind')
    assert [{key: row[key] for key in ('dag', 'sink', 'job', 'verdict', 'cause')}
            for row in causes] == [
        {key: job[key] for key in ('dag', 'sink', 'job', 'verdict', 'cause')}
        for job in found['jobs']]
    assert [row['late'] for row in causes] == [job['late_ns'] for job in found['jobs']]
    expected = [part for job in found['jobs'] for part in job['parts']]
    assert [(row['vertex'], row['cause'], row['time']) for row in parts] == [
        (part['vertex'], part['cause'], part['ns']) for part in expected]
    assert [(row['part'], row['callback'], row['time']) for row in behind] == [
        (place, each['callback'], each['ns']) for place, part in enumerate(expected)
        for each in part['behind']]


def test_usage(outcome):
    result = outcome.result()
    found = {row['callback']: row for row in rows_of(outcome, 'usage')}
    assert list(found) == [*result['callbacks'], 'undeclared']
    for name, about in {**result['callbacks'], 'undeclared': result['undeclared']}.items():
        assert about.items() <= {
            key if key in about else f'{key}_ns': value
            for key, value in found[name].items()}.items()


def test_paths_and_what_is_required_of_them(outcome):
    result, flows = outcome.result(), rows_of(outcome, 'flows')
    required = rows_of(outcome, 'requirements')
    for name, path in result['paths'].items():
        mine = [row for row in flows if row['path'] == name]
        assert len(mine) == path['flows']
        assert sum(row['arrival'] is not None for row in mine) == path['arrived']
    for name, about in result.get('requirements', {}).items():
        for what, found in about.items():
            kinds = Counter()
            for row in required:
                if (row['path'], row['requirement']) == (name, what):
                    kinds[row['verdict']] += row['count']
            every = counts(found)
            assert kinds['in_time'] == every.in_time and kinds['not_due'] == every.not_due
            assert kinds['late'] + kinds['overdue'] == every.late


def test_columns_have_units_and_unknown_values_are_null(outcome):
    for name, table in result_tables().items():
        assert outcome.table(name).names == tuple(table.columns)
        arrow = outcome.to_arrow(name)
        assert arrow.column_names == list(table.columns)
        for column, about in table.columns.items():
            unit = (arrow.schema.field(column).metadata or {}).get(b'unit', b'').decode()
            assert unit == about.unit
    numbers, times = (get('verdicts') for get in (outcome.table, outcome.to_arrow))
    assert [time is None for time in times['completed'].to_pylist()] == (
        numbers['completed'] < 0).tolist()


def test_categories_are_names(outcome):
    for name in (*result_tables(), *TABLES):
        for column in outcome.to_arrow(name).columns:
            for chunk in getattr(column, 'chunks', ()):
                names = getattr(chunk, 'dictionary', None)
                assert names is None or '' not in names.to_pylist(), name


def test_arrow_tables_have_the_same_memory():
    outcome = of_demo(None)
    for name, column in (('executions', 'start'), ('verdicts', 'deadline')):
        values = outcome.table(name)[column]
        assert outcome.to_arrow(name)[column].chunk(0).buffers()[1].address == values.ctypes.data


def test_a_table_that_does_not_exist():
    with pytest.raises(KeyError, match=r"no table 'verdict': the tables are behind, causes, "):
        of_demo(None).table('verdict')


JITTER = """
from mddag_executor.analysis.result_table import Column, DAG, ResultTable
from mddag_executor.recording.columns import Table


def _make(replay):
    releases = replay.recording.releases
    return Table({'dag': releases['dag'], 'late': releases['noticed'] - releases['release']})


TABLE = ResultTable('jitter', 'release', {
    'dag': Column('the DAG', names=DAG),
    'late': Column('how late it was noticed', 'ns')}, _make)
"""


def test_a_new_analysis_is_one_file(tmp_path, monkeypatch, call):
    (tmp_path / 'jitter.py').write_text(JITTER)
    monkeypatch.setattr(tables, '__path__', [*tables.__path__, str(tmp_path)])
    result_table.result_tables.cache_clear()
    try:
        found = of_demo(None).to_pandas('jitter')
        assert found.late.min() >= 0 and set(found.dag) > {'control'}
        out = tmp_path / 'tables'
        assert call('export', TOP / 'bags' / 'demo_short.mcap', '-o', f'{out}/').returncode == 0
        assert (out / 'jitter.parquet').exists()
    finally:
        result_table.result_tables.cache_clear()


def page():
    """Return the section of the page about the result tables."""
    parts = []
    for name, table in result_tables().items():
        parts.append(f'### {name}\n\nOne row for each {table.row}.\n\n'
                     '| column | unit | meaning |\n| --- | --- | --- |\n')
        parts += [f'| `{column}` | {about.unit or "-"} | {about.about} |\n'
                  for column, about in table.columns.items()]
        parts.append('\n')
    return ''.join(parts).rstrip('\n') + '\n'


def test_the_page_lists_all_tables():
    """With UPDATE_GOLDEN in the environment, write it."""
    before, mark, after = PAGE.read_text(encoding='utf-8').partition(MARK)
    if os.environ.get('UPDATE_GOLDEN'):
        after = f'\n{page()}'
        PAGE.write_text(before + mark + after, encoding='utf-8')
    assert after == f'\n{page()}', 'run it with UPDATE_GOLDEN=1'
