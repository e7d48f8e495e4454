# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verbs `evaluate` and `generate`: pictures, several declarations, Ctrl-C."""

import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from msg_graph import load
from msg_graph.model import load_of
import pytest

GRAPH = """\
mddag: 1
workers: 1
nodes:
  - node: /n
    callbacks:
      - {name: a, timer: 10ms, dag: a, deadline: 5ms, execution_time: 2500us}
      - name: b
        timer: 20ms
        dag: b
        deadline: 20ms
        execution_time: {quantiles_us: [10000, 10000, 14000, 14000], percent: [0, 50, 50.01, 100]}
"""


@pytest.mark.parametrize(('ending', 'start'), [
    ('png', b'\x89PNG'), ('svg', b'<?xml'), ('pdf', b'%PDF')])
def test_figure(graph, tmp_path, call, ending, start):
    """It is a picture of that kind, and the same for the same runs."""
    pictures = []
    for name in ('one', 'two'):
        path = tmp_path / f'{name}.{ending.upper() if name == "two" else ending}'
        assert call('evaluate', graph, '--runs', 20, '--plot', path, '--jobs', 1)[0] == 0
        pictures.append(path.read_bytes())
    assert pictures[0].startswith(start) and len(pictures[0]) > 5000
    assert pictures[0] == pictures[1]
    if ending == 'svg':
        for text in (b'normalised utilisation', b'acceptance ratio'):
            assert b'<!-- ' + text in pictures[0]


def group_seconds(group):
    """Return the processor time that the processes of a group have taken so far."""
    total = 0.0
    for file in Path('/proc').glob('[0-9]*/stat'):
        try:
            fields = file.read_text().rpartition(')')[2].split()
        except OSError:  # it has ended
            continue
        if int(fields[2]) == group:
            total += (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')
    return total


def interrupted_after(folder, seconds, *arguments):
    """Press Ctrl-C, which goes to all processes of the terminal; return what was said."""
    process = subprocess.Popen(
        [sys.executable, '-m', 'mddag_executor', 'evaluate', *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder,
        start_new_session=True, env={**os.environ, 'NUMBA_DISABLE_JIT': '1'})  # not compiled
    begin = time.monotonic()
    while group_seconds(process.pid) < seconds and time.monotonic() < begin + 30:
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130
    with pytest.raises(ProcessLookupError):  # no process of the group is left
        for _ in range(50):
            os.killpg(process.pid, 0)
            time.sleep(0.1)
    return out, err


def test_interrupted(graph, tmp_path):
    """Ctrl-C: the exit status is 130, and what is done is written as a whole."""
    out, err = interrupted_after(
        tmp_path, 2, str(graph), '--runs', '500000', '--jobs', '1', '--json',
        'out.json', '--plot', 'out.png')
    result = json.loads((tmp_path / 'out.json').read_text())
    assert err == f"warning: interrupted: {result['runs']} of 500000 runs are done\n"
    assert 0 < result['runs'] < 500000 and result['interrupted'] is True
    assert (tmp_path / 'out.png').stat().st_size > 5000
    assert f"{result['runs']} runs in" in out


def test_several_graphs(graph, tmp_path, call):
    """A folder's declarations come by name; the bins begin at 0.05; each is counted."""
    (tmp_path / 'sets').mkdir()
    (tmp_path / 'sets' / 'b.yaml').write_text(GRAPH.replace('14000', '2000').replace(
        '10000', '1000'))
    (tmp_path / 'sets' / 'a.yaml').write_text(GRAPH.replace('workers: 1', 'workers: 2'))
    (tmp_path / 'sets' / 'notes.txt').write_text('no declaration')
    status, out, err = call('evaluate', graph, 'sets', '--runs', 20, '--policies', 'rad',
                            '--no-preemptive', '--json', 'out.json', '--plot', 'out.svg')
    assert (status, err) == (0, '')
    assert '60 runs of 3 task sets in' in out
    result = json.loads((tmp_path / 'out.json').read_text())
    assert result['bins'] == [round(0.05 * i, 2) for i in range(1, 21)]
    assert sum(result['counts']) == 60
    names = [Path(each['graph']).name for each in result['graphs']]
    assert names == ['graph.yaml', 'a.yaml', 'b.yaml']
    assert [each['workers'] for each in result['graphs']] == [1, 2, 1]
    assert [each['runs'] for each in result['graphs']] == [20, 20, 20]
    assert [each['accepted']['rad'] for each in result['graphs']][1:] == [20, 20]
    assert 0 < result['graphs'][0]['accepted']['rad'] < 20
    assert result['graphs'][1]['utilisation'] < 0.5 < result['graphs'][0]['utilisation']
    assert b'3 task sets' in (tmp_path / 'out.svg').read_bytes()


pytestmark = pytest.mark.usefixtures('folder')


def test_folder(folder, call):
    (folder / 'again').mkdir()  # an empty one is taken
    for name in ('sets', 'again'):
        assert call('generate', '--sets', 5, '--utilisation', '0.2:0.6', '--workers', 3,
                    '-o', name) == (0, '', '')
    files = sorted((folder / 'sets').iterdir())
    assert [file.name for file in files] == [f'set_{i:04d}.yaml' for i in range(5)]
    for i, file in enumerate(files):
        task_set = load(file)
        total = sum(load_of(dag) or 0 for dag in task_set.dags)
        assert total / 3 == pytest.approx(0.2 + 0.1 * i, abs=1e-5)
        assert file.read_bytes() == (folder / 'again' / file.name).read_bytes()
    assert len({file.read_text() for file in files}) == 5
    assert sorted(path.name for path in folder.iterdir()) == ['again', 'sets']
