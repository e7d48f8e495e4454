# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Kinds of arguments, and options that several verbs have."""

from __future__ import annotations

import argparse
from contextlib import nullcontext
import importlib
from pathlib import Path

from mddag_executor import defaults
from mddag_executor.cli import main as program
from mddag_executor.errors import MddagError
from mddag_executor.simulate import JUDGES, Settings
from mddag_executor.simulate.run import check
from msg_graph import GraphError, loads
import pytest

ONE = 'nodes: [{node: /n, callbacks: [{name: t, timer: 1s, deadline: 1s, execution_time: 1us}]}]\n'


def test_the_number_of_workers() -> None:
    text = 'mddag: 1\nnodes: [{node: /n, callbacks: [{name: a, timer: 1s, deadline: 1s}]}]\n'
    assert defaults.workers(None, loads(text)) == 7
    assert defaults.workers(None, loads(text + 'workers: 3\n')) == 3
    assert defaults.workers(2, loads(text + 'workers: 3\n')) == 2


@pytest.mark.parametrize(('verb', 'option', 'known'), [
    ('simulate', '--judge', JUDGES), ('evaluate', '--judge', JUDGES),
])
def test_choices_are_those_of_the_program(verb: str, option: str, known: tuple[str, ...]) -> None:
    """Verbs name them again, as to import them would make every help slow."""
    parser = argparse.ArgumentParser()
    importlib.import_module(f'mddag_executor.cli.{verb}').add_arguments(parser)
    action, = (each for each in parser._actions if option in each.option_strings)
    assert action.choices is not None
    assert sorted(action.choices) == sorted(known)


def test_the_limit_of_workers_is_the_same_everywhere(tmp_path: Path) -> None:
    from mddag_executor.executor.settings import resolve
    graph = tmp_path / 'g.yaml'
    simulate = ['simulate', str(graph), '--duration', '1us', '--workers']
    for workers, status in ((4096, 0), (4097, 2)):
        refused = nullcontext() if status == 0 else pytest.raises((MddagError, GraphError))
        graph.write_text(f'mddag: 1\nworkers: {workers}\n' + ONE)
        assert program.main(['graph', 'check', str(graph)]) == status
        graph.write_text('mddag: 1\n' + ONE)
        assert program.main([*simulate, str(workers)]) == status
        assert program.main(
            ['generate', '--workers', str(workers), '--utilisation', '0.001', '-o',
             str(tmp_path / 'made.yaml')]) == status
        with refused:
            resolve(str(graph), workers, 1)
        with refused:
            check(Settings(workers=workers))
