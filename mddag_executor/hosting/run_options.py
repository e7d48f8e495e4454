# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The options of a run: one table for Python, the command line, launch file and child processes.

Each field of ``RunOptions`` is an option.  Its metadata is what the parser of `mddag run` needs;
the launch file is made from the parser, and a process of several gets all options that are not
``of_the_run``.  So a new option is a new field.  This module imports nothing heavy: the parser
needs it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
import os
from pathlib import Path
from typing import Any, TYPE_CHECKING

from mddag_executor.errors import UsageError
from mddag_executor.output_rules import check_output

if TYPE_CHECKING:
    from msg_graph import TaskSet
    from typing_extensions import Self

Spec = str | Callable[[], Any]
"""A SPEC as on the command line, or the function or class itself."""
MODES = ('sleep', 'spin', 'native', 'mixed')
_MOST_DIGITS = 9


def option(default: Any, meaning: str = '', *, of_the_run: bool = False, **how: Any) -> Any:
    """
    Declare an option.

    :param meaning: its help; '' if all verbs that have the option share it.
    :param of_the_run: it belongs to the run as a whole, or each process of several has its own.
    :param how: what else the parser needs: see ``cli.run``.
    """
    return field(default=default, metadata={'help': meaning, 'of_the_run': of_the_run, **how})


@dataclass(frozen=True)
class RunOptions:
    """
    What to run, and how: the options of `mddag run`, with the same names and defaults.

    Times are text such as ``20s``, or ns.

    :param nodes: each as after ``--node``, or the function or class itself: a subclass of
        ``rclpy.node.Node``, a function that returns nodes, or a ``main()`` that spins.
    :param graph: the declaration: the path of a YAML file, or a ``msg_graph.TaskSet``; None:
        nothing is judged.
    :raises UsageError: when an option is wrong, or two do not fit together.
    """

    nodes: Sequence[Spec] = option(
        (), 'run this node: package/executable (unmodified, as ros2 run does), module:function '
        'or module:NodeClass; quote a node and its arguments as one word: '
        "'pkg/exe --rate 2'; repeat the option for more nodes",
        flag='--node', kind='several', metavar='SPEC', group='what', of_the_run=True)
    synthetic: str | None = option(
        None, 'make the nodes from the declaration; for the declared execution times their '
        "callbacks sleep, compute in Python (spin), compute without Python's lock (native), or do "
        'one of the three, drawn for each callback (mixed)', choices=MODES, group='what',
        of_the_run=True)
    utilisation: float | None = option(None, only='with --synthetic: ')
    seed: int = option(0, only='with --synthetic: ')
    duration: int | str | None = option(
        None, 'end after this time, for instance 20s; with --synthetic, it begins after a warm-up '
        'of 1 s (default: run until Ctrl-C)', kind='duration', metavar='TIME')
    concurrent: Sequence[str] = option(
        (), 'let the callbacks of this node overlap with others of its program, even if the '
        'program spins in a single thread; repeat the option for more nodes',
        kind='several', metavar='NAME')
    policy: str = option('rad')
    workers: int | None = option(None)
    on_late: str = option('demote')
    diagnostics: int | str | None = option(
        '1s', "how often to publish the executor's state on /diagnostics, for mddag top and other "
        "tools; 'off': never (default: 1s)", kind='time or off', metavar='TIME')
    trace: str | os.PathLike[str] | None = option(
        None, 'record the run to this file; if the run has several processes, each records to '
        'OUT.NAME.mcap, or to NAME.mcap in OUT if that is a directory', kind='trace',
        metavar='OUT.mcap', of_the_run=True)
    processes: int | str | os.PathLike[str] | None = option(
        None, 'run the nodes in N processes (1: in this one), or in those of a YAML file with '
        '`processes:` (default: those of the declaration)', kind='input',
        metavar='N|FILE', group='several processes', of_the_run=True)
    process: str | None = option(
        None, 'run only the nodes of this declared process, for a launch file that starts each '
        'process; give the --node options of these nodes only', metavar='NAME',
        group='several processes', of_the_run=True)
    on_exit: str = option(
        'end', 'when one of several processes ends by itself, end the run, or continue without it '
        '(default: end)', choices=('end', 'continue'), group='several processes', of_the_run=True)
    graph: str | os.PathLike[str] | TaskSet | None = option(
        None, "the declaration, a YAML file ('-': standard input); with --node it may be left "
        'out: then nothing is judged, and a declaration can be drafted from the trace',
        flag='graph', kind='input', metavar='GRAPH', of_the_run=True)
    overwrite: bool = option(False)
    ros_args: Sequence[str] = option(())

    def __post_init__(self) -> None:
        """Check the options."""
        if isinstance(self.nodes, str) or callable(self.nodes):
            raise UsageError(f'nodes={self.nodes!r}: give a list, even for one node')
        if bool(self.nodes) == (self.synthetic is not None):
            raise UsageError('nodes: give nodes to run, or synthetic, and not both')
        if self.synthetic not in (None, *MODES):
            raise UsageError(f'synthetic={self.synthetic!r}: give one of {", ".join(MODES)}')
        if self.on_exit not in ('end', 'continue'):
            raise UsageError(f'on_exit={self.on_exit!r}: give end or continue')
        for name, least in (('workers', 1), ('seed', 0)):
            value = getattr(self, name)
            if value is not None and (type(value) is not int or value < least):
                raise UsageError(f'{name}={value!r}: give an integer from {least} up')
        for name in ('duration', 'diagnostics'):
            self._set(name, _nanoseconds(name, getattr(self, name)))
        for name in ('nodes', 'concurrent', 'ros_args'):
            self._set(name, tuple(getattr(self, name) or ()))
        if self.trace is not None:
            self._set('trace', os.fspath(self.trace))
        if self.processes is not None:
            self._set('processes', str(self.processes))
        n_processes = self.n_processes
        if self.process is not None and n_processes is not None:
            raise UsageError(f'--process {self.process}: with --processes {self.processes} no '
                             'process has a name of its own: name a file')
        needs_graph = next((name for name in ('synthetic', 'processes', 'process')
                            if getattr(self, name) not in (None, '1')), None)
        if self.graph is None and needs_graph is not None:
            raise UsageError(
                f'--{needs_graph}: it needs the nodes of a declaration: give a GRAPH')
        if self.synthetic is None and self.utilisation is not None:
            raise UsageError(
                '--utilisation: it scales synthetic nodes only: add --synthetic or leave it out')

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    @property
    def n_processes(self) -> int | None:
        """Return the number of processes that is given; None: none is, or a file is."""
        return number_of_processes(None if self.processes is None else str(self.processes))

    @property
    def seconds(self) -> float | None:
        """Return the duration."""
        return None if self.duration is None else int(self.duration) / 1e9

    @property
    def specs(self) -> list[str]:
        """Return the nodes as on the command line."""
        return [spec if isinstance(spec, str) else spec_of(spec) for spec in self.nodes]

    @property
    def graph_name(self) -> str:
        """Return the name of the declaration for messages."""
        if self.graph is None or isinstance(self.graph, (str, os.PathLike)):
            return os.fspath(self.graph or '')
        return self.graph.file

    def task_set(self) -> TaskSet:
        """
        Return the declaration with the processes of the run; without any if this is the only one.

        :raises msg_graph.GraphError: when it is invalid.
        """
        from msg_graph import EMPTY_TASK_SET, load
        from msg_graph.edit import load_processes, with_processes
        from msg_graph.yamltext import decode
        if self.graph is None:
            task_set = EMPTY_TASK_SET
        elif isinstance(self.graph, (str, os.PathLike)):
            task_set = load(os.fspath(self.graph))
        else:
            task_set = self.graph
        if self.processes is not None and self.n_processes is None:
            name = str(self.processes)
            text = decode(Path(name).read_bytes(), name)
            return with_processes(task_set, load_processes(text, name, task_set))
        if self.n_processes is not None and task_set.processes:
            return replace(task_set, processes=())
        return task_set

    def passed_on(self) -> dict[str, Any]:
        """Return the options that each process of several gets."""
        return {each.name: getattr(self, each.name) for each in fields(self)
                if not each.metadata['of_the_run']}

    def of_part(self, passed_on: dict[str, Any], task_set: TaskSet) -> Self:
        """Return the options of a process of several, with those that it gets."""
        return replace(self, graph=task_set, **passed_on)

    def check_trace(self) -> Path | None:
        """Return the absolute path of the trace, as nodes may change folders, if it may be one."""
        if self.trace is None:
            return None
        check_output(os.fspath(self.trace), is_kept=True, overwrite=self.overwrite)
        return Path(self.trace).absolute()


def number_of_processes(given: str | None) -> int | None:
    """
    Return the number that `--processes N|FILE` gives; None: none is given, or a file is.

    :raises UsageError: if it is 0, or more than any declaration has nodes.
    """
    if given is None or not (given.isascii() and given.isdecimal()):
        return None
    digits = given.lstrip('0')
    if not digits or len(digits) > _MOST_DIGITS:
        raise UsageError(f'--processes {given[:2 * _MOST_DIGITS]}: '
                         f'give {"fewer" if digits else "1 or more"}, or a file')
    return int(digits)


def spec_of(target: Any) -> str:
    """Return the SPEC of a function or class."""
    name = getattr(target, '__qualname__', type(target).__name__)
    return f'{getattr(target, "__module__", "?")}:{name}'


def _nanoseconds(name: str, given: Any) -> int | None:
    try:
        if given == 'off' and name == 'diagnostics':
            return 0
        if isinstance(given, str):
            from msg_graph import parse_duration
            return parse_duration(given)
    except ValueError as error:
        raise UsageError(f'{name}={given!r}: {error}') from None
    if given is None or isinstance(given, int) and not isinstance(given, bool) and given >= 0:
        return given
    raise UsageError(f"{name}={given!r}: give a time such as '20s', or nanoseconds")
