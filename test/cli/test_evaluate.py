# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verbs `evaluate` and `generate`: pictures, several declarations, Ctrl-C."""

import json
import os
from pathlib import Path
import signal
import subprocess
import sys

from mddag_executor.simulate import compiled
from msg_graph import load
from msg_graph.model import load_of
import pytest

from ..conftest import wait_for_run


@pytest.mark.parametrize(('ending', 'start'), [
    ('png', b'\x89PNG'), ('svg', b'<?xml'), ('pdf', b'%PDF')])
def test_figure(graph, tmp_path, call, ending, start):
    """It is a picture of that kind, and the same for the same runs."""
    pictures = []
    for name in (f'one.{ending}', f'two.{ending.upper()}'):
        done = call('evaluate', graph, graph, '--runs', 20, '--plot', name, '--parallel', 1)
        assert done.returncode == 0
        pictures.append((tmp_path / name).read_bytes())
    assert pictures[0].startswith(start) and pictures[0] == pictures[1]
    if ending == 'svg':
        for text in (b'normalised utilisation', b'acceptance ratio', b'2 declarations'):
            assert text in pictures[0]


@pytest.mark.parametrize('core', ['plain', 'compiled', 'compiling'])
def test_interrupted(graph, core):
    """Ctrl-C: the exit status is 130, and what is done is written as a whole."""
    if core != 'plain':
        pytest.importorskip('llvmlite', reason='llvmlite is not there')
    if core == 'compiled':
        compiled.prepare()
    with subprocess.Popen(
            [sys.executable, '-m', 'mddag_executor', 'evaluate', str(graph), '--runs', '10000000',
             '--parallel', '1', '--json', 'out.json', '--plot', 'out.png'],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
            env={**os.environ, 'MDDAG_PLAIN': '1' if core == 'plain' else '',
                 **({'XDG_CACHE_HOME': str(graph.parent)} if core == 'compiling' else {})},
    ) as process:

        def seconds():
            fields = Path(f'/proc/{process.pid}/stat').read_text().rpartition(')')[2].split()
            return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')

        wait_for_run(process, lambda: seconds() > (1 if core == 'compiling' else 3))
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=120)
    assert process.returncode == 130
    if core == 'compiling':
        assert (out, err) == ('', 'warning: interrupted: 0 of 10000000 runs are done\n')
        return
    result = json.loads(Path('out.json').read_text())
    assert err == f"warning: interrupted: {result['runs']} of 10000000 runs are done\n"
    assert 0 < result['runs'] < 10000000 and result['interrupted'] is True
    assert Path('out.png').stat().st_size > 5000 and f"{result['runs']} runs in" in out


def test_several_sets(folder, call):
    """Of loads that are spread evenly; an empty folder is replaced."""
    (folder / 'sets').mkdir()
    assert call('generate', '--sets', 5, '--utilisation', '0.2:0.6', '--workers', 3,
                '-o', 'sets') == (0, '', '')
    files = sorted((folder / 'sets').iterdir())
    assert [file.name for file in files] == [f'set_{i:04d}.yaml' for i in range(5)]
    for i, file in enumerate(files):
        total = sum(load_of(dag) or 0 for dag in load(file).dags)
        assert total / 3 == pytest.approx(0.2 + 0.1 * i, abs=1e-5)
    assert os.listdir() == ['sets']
