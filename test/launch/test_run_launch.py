# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The command line that the launch file makes.

launch is not on the package index: `test_colcon.py` runs the file where it is installed.
"""

import importlib.util
from pathlib import Path

from mddag_executor.cli import main as program
import pytest

TOP = Path(__file__).resolve().parent.parent.parent


@pytest.fixture
def launch_file():
    spec = importlib.util.spec_from_file_location(
        'run_launch', TOP / 'launch' / 'run.launch.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def command(launch_file, **given):
    assert set(given) <= set(launch_file.ARGUMENTS)
    return launch_file.command({**dict.fromkeys(launch_file.ARGUMENTS, ''), **given})


def test_nodes_and_ros_arguments_are_words(launch_file):
    assert command(launch_file) == ['run']
    made = command(launch_file, nodes="a/b 'c/d --rate 2'", ros_args='-r x:=y', workers='3')
    assert made == ['run', '--node', 'a/b', '--node', 'c/d --rate 2', '--workers', '3',
                    '--ros-args', '-r', 'x:=y']
    with pytest.raises(ValueError, match='quotation'):
        command(launch_file, nodes="'a/b")


def test_every_argument_is_an_option_that_mddag_run_has(launch_file):
    given = {'graph': 'graph.yaml', 'nodes': '', 'policy': 'gedf', 'workers': '2',
             'trace': 'run.mcap', 'processes': '2', 'duration': '2s', 'synthetic': 'spin',
             'utilisation': '0.5', 'seed': '4', 'fail_on_miss': 'true', 'ros_args': '-r a:=b'}
    assert set(given) == set(launch_file.ARGUMENTS)
    parser, rest = program.find_verb(command(launch_file, **given))
    args = parser.parse(rest)
    for name in set(given) - {'nodes', 'ros_args', 'duration', 'fail_on_miss'}:
        assert str(getattr(args, name)) == given[name]
    assert (args.duration, args.fail_on_miss) == (2_000_000_000, True)
    assert args.ros_args == ['-r', 'a:=b']
