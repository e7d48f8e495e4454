# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The options of `mddag run` reach its launch file and its child processes.

launch is not on the package index: `test_colcon.py` runs the file where it is installed.
"""

from dataclasses import dataclass

from mddag_executor.cli import launch_arguments, run
from mddag_executor.cli import main as program
from mddag_executor.errors import UsageError
from mddag_executor.hosting.processes import Part
from mddag_executor.hosting.run_options import option, RunOptions
from mddag_executor.hosting.run_result import RunResult
import pytest


def command(**given):
    names = launch_arguments.arguments()
    assert set(given) <= set(names)
    return launch_arguments.command({**dict.fromkeys(names, ''), **given})


def parsed(words):
    parser, rest = program.find_verb(words)
    return parser.parse(rest)


def test_nodes_and_ros_arguments_are_words():
    assert command() == ['run']
    made = command(nodes="a/b 'c/d --rate 2'", ros_args='-r x:=y', workers='3')
    assert made == ['run', '--node', 'a/b', '--node', 'c/d --rate 2', '--workers', '3',
                    '--ros-args', '-r', 'x:=y']
    with pytest.raises(UsageError, match='quotation'):
        command(nodes="'a/b")
    with pytest.raises(UsageError, match='fail_on_miss:=maybe: .* give true or false'):
        command(fail_on_miss='maybe')


def test_every_argument_is_an_option_that_mddag_run_has():
    given = {'graph': 'graph.yaml', 'policy': 'gedf', 'workers': '2', 'trace': 'run.mcap',
             'processes': '2', 'process': 'p', 'duration': '2s', 'synthetic': 'spin',
             'utilisation': '0.5', 'seed': '4', 'on_late': 'continue', 'diagnostics': 'off',
             'on_exit': 'continue', 'json': 'out.json', 'fail_on_miss': 'true',
             'overwrite': 'yes', 'quiet': 'false', 'ros_args': '-r a:=b'}
    args = parsed(command(**given))
    for name in ('graph', 'policy', 'workers', 'trace', 'processes', 'process', 'synthetic',
                 'utilisation', 'seed', 'on_late', 'on_exit', 'json'):
        assert str(getattr(args, name)) == given[name]
    assert (args.duration, args.diagnostics) == (2_000_000_000, 0)
    assert (args.fail_on_miss, args.overwrite, args.quiet) == (True, True, False)
    assert args.ros_args == ['-r', 'a:=b']


def test_a_new_option_needs_one_line(monkeypatch, tmp_path):
    @dataclass(frozen=True)
    class WithMore(RunOptions):
        limit: str | None = option(None, 'in metres')
        loud: bool = option(False, 'say more', kind='switch')
        only: list[str] = option((), 'a name', kind='several')

    monkeypatch.setattr(run, 'RunOptions', WithMore)
    assert launch_arguments.arguments().items() >= {
        'limit': 'in metres', 'loud': 'true: say more'}.items()
    args = parsed(command(
        graph='graph.yaml', synthetic='sleep', limit='0.5', loud='true', only="'a b' c"))
    given = run.options_of(args)
    assert (given.limit, given.loud, given.only) == ('0.5', True, ['a b', 'c'])

    # a child process: its options come from the folder of the run
    seen = []
    monkeypatch.setattr('mddag_executor.hosting.run_here.run_here',
                        lambda options, *_: seen.append(options) or RunResult({}))
    monkeypatch.setattr('mddag_executor.hosting.processes.belong_to_parent', lambda pid: None)
    monkeypatch.setattr('os._exit', lambda status: None)
    text = 'mddag: 1\nnodes:\n  - {node: /n, callbacks: [{name: t, timer: 9ms, deadline: 9ms}]}'
    Part.make(str(tmp_path), text, given.passed_on())
    child = parsed(['run', 'graph.yaml', '--part', str(tmp_path), '--synthetic', 'sleep',
                    '--process', 'one'])
    run.main(child)
    assert [(each.limit, each.loud, each.only, each.process) for each in seen] == [
        ('0.5', True, ['a b', 'c'], 'one')]
