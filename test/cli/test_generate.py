# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `generate`: one file or a folder, the same for the same seed, bad input in one line."""

from __future__ import annotations

from pathlib import Path

from mddag_executor.cli import main as program
from msg_graph import load
from msg_graph.model import load_of
import pytest

from .helpers import caller

call = caller('generate')
pytestmark = pytest.mark.usefixtures('folder')


def test_it_passes_the_check(capsys: pytest.CaptureFixture[str]) -> None:
    assert call(capsys, '-o', 'random.yaml', '--or-share', 0.5) == (
        0, '', '')
    assert program.main(['graph', 'check', 'random.yaml']) == 0
    assert '8 DAGs' in capsys.readouterr().out


def test_folder(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / 'again').mkdir()  # an empty one is taken
    for name in ('sets', 'again'):
        status, out, err = call(
            capsys, '--sets', 5, '--utilisation', '0.2:0.6', '--workers', 3, '-o', name)
        assert (status, out, err) == (0, '', '')
    files = sorted((folder / 'sets').iterdir())
    assert [file.name for file in files] == [f'set_{i:04d}.yaml' for i in range(5)]
    for i, file in enumerate(files):
        task_set = load(file)
        total = sum(load_of(dag) or 0 for dag in task_set.dags)
        assert total / 3 == pytest.approx(0.2 + 0.1 * i, abs=1e-5)
        assert file.read_bytes() == (folder / 'again' / file.name).read_bytes()
    assert len({file.read_text() for file in files}) == 5
    assert sorted(path.name for path in folder.iterdir()) == ['again', 'sets']
