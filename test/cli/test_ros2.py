# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
`ros2 mddag`: the entry point, behind a parser made as ros2cli makes it.

ros2cli is not on the package index. With an installed ROS, `test_colcon.py` runs the real `ros2`.
"""

from __future__ import annotations

import argparse
from importlib.metadata import distribution
from importlib.util import find_spec
import os
from pathlib import Path
import sys
from types import ModuleType, SimpleNamespace

import pytest

GRAPH = """
mddag: 1
nodes:
  - {node: /n, callbacks: [{name: tick, timer: 10ms, deadline: 10ms, execution_time: 1ms}]}
"""


@pytest.fixture
def ros2(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Give what ros2cli does with a command line, in short: parse it, call the command's main."""
    if find_spec('ros2cli') is None:
        command_module = ModuleType('ros2cli.command')
        command_module.CommandExtension = object    # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, 'ros2cli', ModuleType('ros2cli'))
        monkeypatch.setitem(sys.modules, 'ros2cli.command', command_module)
        monkeypatch.delitem(sys.modules, 'mddag_executor.cli.ros2', raising=False)
    entry, = (each for each in distribution('mddag_executor').entry_points
              if each.group == 'ros2cli.command')
    assert entry.name == 'mddag'
    extension = entry.load()()

    def main(*arguments: str) -> int:
        parser = argparse.ArgumentParser('ros2')
        commands = parser.add_subparsers(dest='command')
        extension.add_arguments(commands.add_parser(entry.name), 'ros2 mddag')
        args = parser.parse_args(['mddag', *arguments])
        status: int = extension.main(parser=parser, args=args)
        return status
    return SimpleNamespace(main=main, summary=extension.__doc__)


def test_it_is_the_same_program(
    ros2: SimpleNamespace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    graph = tmp_path / 'graph.yaml'
    graph.write_text(GRAPH)
    assert ros2.main('graph', 'check', str(graph)) == 0
    assert 'deadline' in capsys.readouterr().out
    assert ros2.main('simulate', '--duration', '100ms', '--', str(graph)) == 0
    assert ros2.main('graph', 'check', 'none.yaml') == 2
    assert capsys.readouterr().err.startswith('error: none.yaml: ')
    assert ros2.main() == 2
    assert capsys.readouterr().err.startswith('error: mddag: ')


def test_completion_is_that_of_mddag(
    ros2: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr('mddag_executor.cli.completion.complete', lambda: asked.append(
        (os.environ['COMP_LINE'], os.environ['COMP_POINT'])))
    for name, value in (('_ARGCOMPLETE', '1'), ('COMP_LINE', 'ros2 mddag expl'),
                        ('COMP_POINT', '15')):
        monkeypatch.setenv(name, value)
    ros2.main('graph')
    assert asked[0] == ('mddag expl', '10')
