# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The launch file, on stand-ins for `launch` and `launch_ros` that keep what they are given.

They take what those of Jazzy (launch 3.4, launch_ros 0.26) take, by position and by name. The real
ones run in `test_colcon.py`, where they are installed.
"""

from __future__ import annotations

from dataclasses import dataclass, field, KW_ONLY
import importlib.util
from pathlib import Path
import re
import sys
from types import ModuleType
from typing import Any

from mddag_executor.cli import main as program
import pytest

TOP = Path(__file__).resolve().parent.parent.parent


@dataclass
class Configuration:
    name: str

    def resolve(self, given: dict[str, str]) -> str:
        return given[self.name]


@dataclass
class Joined:
    parts: list[Any]

    def resolve(self, given: dict[str, str]) -> str:
        return str(Path(*(resolved(part, given) for part in self.parts)))


@dataclass
class Share:
    package: str

    def resolve(self, given: dict[str, str]) -> str:
        assert self.package == 'mddag_executor'
        return str(TOP)


@dataclass
class Argument:
    name: str
    _: KW_ONLY
    default_value: Any = None
    description: str | None = None
    choices: list[str] | None = None


@dataclass(kw_only=True)
class Node:
    executable: str
    package: str | None = None
    name: str | None = None
    namespace: str | None = None
    arguments: list[Any] = field(default_factory=list)
    output: str = 'log'

    def command(self, given: dict[str, str]) -> list[str]:
        """Return what is executed, behind the path of the executable."""
        named = [] if self.name is None else ['-r', f'__node:={self.name}']
        return [*(resolved(part, given) for part in self.arguments), '--ros-args', *named]


@dataclass
class Description:
    entities: list[Any]

    def arguments(self) -> list[Argument]:
        return [entity for entity in self.entities if isinstance(entity, Argument)]

    def node(self) -> Node:
        node, = (entity for entity in self.entities if isinstance(entity, Node))
        return node

    def command(self, **given: str) -> list[str]:
        values = dict(given)
        for argument in self.arguments():
            values.setdefault(argument.name, resolved(argument.default_value, values))
        return self.node().command(values)


def resolved(part: Any, given: dict[str, str]) -> str:
    return part if isinstance(part, str) else part.resolve(given)


@pytest.fixture
def description(monkeypatch: pytest.MonkeyPatch) -> Description:
    stand_ins = {
        'launch': {'LaunchDescription': Description},
        'launch.actions': {'DeclareLaunchArgument': Argument},
        'launch.substitutions': {'LaunchConfiguration': Configuration,
                                 'PathJoinSubstitution': Joined},
        'launch_ros': {},
        'launch_ros.actions': {'Node': Node},
        'launch_ros.substitutions': {'FindPackageShare': Share},
    }
    for name, content in stand_ins.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location(
        'autoware_demo_launch', TOP / 'launch' / 'autoware_demo.launch.py')
    assert spec is not None and spec.loader is not None
    launch_file = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(launch_file)
    found = launch_file.generate_launch_description()
    assert isinstance(found, Description)
    return found


def test_it_starts_the_program_where_colcon_puts_it(description: Description) -> None:
    node = description.node()
    assert (node.package, node.executable, node.output) == ('mddag_executor', 'mddag', 'screen')


def test_the_defaults_are_a_command_that_mddag_run_takes(description: Description) -> None:
    assert description.command()[0] == 'run'
    parser, rest = program.find_verb(description.command())
    args = parser.parse(rest)
    # With a name there, every node of the process would get it.
    assert args.ros_args == []
    assert Path(args.graph) == TOP / 'config' / 'autoware.yaml'
    assert Path(args.graph).is_file()
    assert (args.synthetic, args.utilisation) == ('sleep', 0.6)
    assert (args.workers, args.policy) == (7, 'rad')
    assert args.duration == 20_000_000_000
    assert re.fullmatch(r'autoware_demo_\d{4}_[\d_]+-[\d_]+\.mcap', args.trace)


def test_every_argument_reaches_the_command(description: Description) -> None:
    names = [argument.name for argument in description.arguments()]
    assert len(names) == len(set(names)) > 5
    assert all(argument.description for argument in description.arguments())
    command = description.command(**{name: f'value of {name}' for name in names})
    assert sorted(part for part in command if part.startswith('value of')) == sorted(
        f'value of {name}' for name in names)
    for name in names:
        if name != 'graph':
            assert command[command.index(f'--{name}') + 1] == f'value of {name}'
