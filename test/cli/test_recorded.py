# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verbs `export` and `diff` take every kind of recording that `replay` takes."""

from contextlib import redirect_stdout
import csv
import io

from mddag_executor.cli import main as program
import pytest

from ..replay.recorded import four_jobs, MS
from ..replay.test_ordinary_bags import write_bag

GRAPH = """\
mddag: 1
nodes:
  - node: /camera
    callbacks: [{name: grab, timer: 100ms, publishes: [/image], execution_time: 2ms}]
  - node: /detect
    callbacks: [{name: detect, subscription: /image, deadline: 8ms, execution_time: 4ms}]
"""
OTHER = GRAPH.replace('/camera', '/radar').replace('/detect', '/track')


@pytest.fixture(scope='module')
def files(tmp_path_factory):
    """Give two graphs and a recording of each kind: ten jobs each, but imported four."""
    folder = tmp_path_factory.mktemp('recordings')
    found = {name: folder / name for name in ('graph.yaml', 'other.yaml', 'own.mcap', 'bag')}
    found['graph.yaml'].write_text(GRAPH)
    found['other.yaml'].write_text(OTHER)
    with redirect_stdout(io.StringIO()):
        assert program.main([
            'simulate', str(found['graph.yaml']), '--duration', '1s', '--workers', '2',
            '--trace', str(found['own.mcap'])]) == 0
    write_bag(found['bag'])
    found['imported.mcap'] = four_jobs(folder / 'imported.mcap')
    return {name: str(path) for name, path in found.items()}


def sink(result):
    return result['dags']['/camera']['sinks']['/detect:detect']


@pytest.mark.parametrize(('arguments', 'verdicts'), [
    (['own.mcap'], ['in_time'] * 10),
    (['imported.mcap', 'graph.yaml'], ['in_time'] * 3 + ['late'])])
def test_export(files, arguments, verdicts, tmp_path, call):
    out, words = tmp_path / 'out.csv', [files.get(word, word) for word in arguments]
    assert call('export', *words, '-o', out, '--rows', 'jobs') == (0, f'exported: {out}\n', '')
    with out.open(newline='') as stream:
        assert [row['verdict'] for row in csv.DictReader(stream)] == verdicts
    out = tmp_path / 'out.pftrace'
    assert call('export', *words, '-o', out) == (0, f'exported: {out}\n', '')
    assert b'/detect:detect' in out.read_bytes()


@pytest.mark.parametrize(('arguments', 'medians', 'due'), [
    (['own.mcap', 'imported.mcap'], (6, 5), (10, 4)),       # judged by the own one's declaration
    (['imported.mcap', 'own.mcap'], (5, 6), (4, 10)),
    (['imported.mcap', 'imported.mcap', 'graph.yaml'], (5, 5), (4, 4))])
def test_diff(files, arguments, medians, due, call):
    words = [files.get(word, word) for word in arguments]
    done = call('diff', *words, '--json', '-')
    found = done.result
    assert not done.stderr
    sides = sink(found)['a'], sink(found)['b']
    assert tuple(round(side['response_ns']['median'] / MS) for side in sides) == medians
    assert tuple(side['due'] for side in sides) == due
    assert [found[mark]['imported'] for mark in 'ab'] == [
        word == 'imported.mcap' for word in arguments[:2]]
    lines = call('diff', *words)[1].splitlines()
    assert all(('imported, 2 threads' in line) == found[mark]['imported']
               for mark, line in zip('ab', lines[-3:-1]))


def test_a_part_by_time(files, tmp_path, call):
    """Ten jobs, one each 100 ms: that at `--from` is in the part, that at `--to` is not."""
    part = '--from', '200ms', '--to', '500ms'
    for name, due in (('own.mcap', 3), ('imported.mcap', 2)):
        given = files[name], *(() if name == 'own.mcap' else (files['graph.yaml'],))
        result = call('replay', *given, *part, '--json', '-').result
        assert result['dags']['/camera']['jobs'] == due
        status, output, _ = call('explain', *given, *part)
        assert status == 0 and f'{due} results due' in output
        jobs = tmp_path / 'jobs.csv'
        assert call('export', *given, *part, '--rows', 'jobs', '-o', str(jobs))[0] == 0
        assert len(jobs.read_text().splitlines()) == 1 + due
