# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Arguments of the verbs: their kinds, and the options that several verbs have.

An option of several verbs is declared here, so that its name, its default and its help are the
same. Like the verbs' modules this one imports nothing heavy.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
import math
from typing import Any, TypeVar

from mddag_executor import defaults
from mddag_executor.errors import UsageError

T = TypeVar('T')
Arguments = argparse._ActionsContainer
"""A parser, or a group of its options."""
_MOST_OFFSET = 10 ** 18


# --- kinds of arguments --------------------------------------------------------------------------

def duration(text: str) -> int:
    """Return the nanoseconds of an argument such as `20s` or `100ms`."""
    return _time(text)


def duration_or_zero(text: str) -> int:
    """Return the nanoseconds of a time that may be zero, which needs no unit."""
    return _time(text, minimum_ns=0)


def _time(text: str, **bounds: int) -> int:
    from msg_graph import parse_duration
    try:
        return parse_duration(text, **bounds)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _number(
    kind: Callable[[str], T], fits: Callable[[T], bool], what: str
) -> Callable[[str], T]:
    def parse(text: str) -> T:
        try:
            value = kind(text)
            if fits(value):
                return value
        except ValueError:
            pass
        raise argparse.ArgumentTypeError(f'{text!r} is not {what}')

    return parse


def workers(text: str) -> int:
    """Return a number of workers."""
    from msg_graph.model import MOST_WORKERS
    return _number(int, lambda value: 1 <= value <= MOST_WORKERS,
                   f'an integer from 1 to {MOST_WORKERS}')(text)


def workers_of(text: str) -> int | dict[str, int]:
    """Return a number of workers, or by process its number of workers."""
    if '=' not in text:
        return workers(text)
    found: dict[str, int] = {}
    for part in text.split(','):
        name, _, number = part.rpartition('=')
        if not name or name in found:
            raise argparse.ArgumentTypeError(
                f'{text!r} is not PROCESS=N,… with a number for each process, such as '
                'control=2,perception=4')
        found[name] = workers(number)
    return found


positive_int = _number(int, lambda value: value >= 1, 'an integer from 1 up')
not_negative_int = _number(int, lambda value: value >= 0, 'an integer from 0 up')
seed = _number(int, lambda value: 0 <= value < 2 ** 64, 'an integer from 0 to 2**64 - 1')
number = _number(float, math.isfinite, 'a number')
positive_float = _number(float, lambda value: 0 < value < math.inf, 'a number above zero')
utilisation = _number(
    float, lambda value: 0 < value <= 1000, 'a number above zero, at most 1000')
not_negative = _number(float, lambda value: 0 <= value < math.inf, 'a number from 0 up')


def share(text: str) -> float:
    """Return the share that `10%` or `0.1` is."""
    number = text.removesuffix('%')
    return not_negative(number) / (1 if number == text else 100)


def list_of(kind: Callable[[str], T]) -> Callable[[str], list[T]]:
    """Return the kind of argument that is several of a kind, with commas between them."""
    return lambda text: [kind(part.strip()) for part in text.split(',')]


def policies(text: str) -> tuple[str, ...]:
    """Return the policies that `--policies` names."""
    from mddag_executor.simulate.policies import policy
    names = [name.strip() for name in text.split(',')]
    for i, name in enumerate(names):
        policy(name)
        if name in names[:i]:
            raise UsageError(f"--policies: '{name}' is listed twice: name each once")
    return tuple(names)


def _offset(text: str) -> tuple[str, int]:
    name, _, time = text.rpartition('=')
    if not name:
        raise argparse.ArgumentTypeError(f'{text!r} is not NAME=TIME, such as control=2.5ms')
    ahead = _time(time.removeprefix('-'), minimum_ns=0, maximum_ns=_MOST_OFFSET)
    return name, -ahead if time.startswith('-') else ahead


# --- files ---------------------------------------------------------------------------------------

class Input(str):
    """A file to read, `-` for standard input."""


class Output(str):
    """A file to write, `-` for standard output; `common.check_files` checks it early."""

    is_kept = False         # see `output_rules`
    checked_early = True


class Report(Output):
    """An HTML file to write."""


class NamedFile(Output):
    """A file to write that cannot be standard output."""


class Declaration(Output):
    """A declaration to write."""

    is_kept = True


class Bag(Output):
    """A bag to write."""

    is_kept = True


class Trace(NamedFile):
    """A trace to write."""

    is_kept = True


class TraceOfRun(Trace):
    """What `run` records to: a trace, or a folder of them, which the verb itself checks."""

    checked_early = False


class Export(Output):
    """What `export` writes: a file or a folder, which the verb itself checks."""

    checked_early = False


# --- options that several verbs have -------------------------------------------------------------

_SHARED: dict[str, dict[str, Any] | Callable[[], dict[str, Any]]] = {
    'graph': {
        'metavar': 'GRAPH', 'type': Input,
        'help': "the declaration, a YAML file ('-': standard input)"},
    '--output': {
        'metavar': 'GRAPH', 'type': Declaration, 'default': '-',
        'help': "the declaration ('-': standard output, the default)"},
    '--json': {
        'metavar': 'FILE', 'type': Output,
        'help': "write the whole result as JSON ('-': to standard output, instead of the tables)"},
    '--report': {
        'metavar': 'OUT.html', 'type': Report,
        'help': 'write tables and pictures of the run as one HTML file that needs no network '
        "('-': to standard output)"},
    '--workers': {
        'type': workers, 'metavar': 'N', 'help': 'threads that run callbacks',
        'otherwise': f"the declaration's, else {defaults.WORKERS}"},
    '--cpus': {
        'type': positive_int, 'metavar': 'C',
        'help': 'number of CPUs that computing callbacks share', 'otherwise': 'enough for all'},
    '--preemptive': {
        'action': argparse.BooleanOptionalAction,
        'help': 'let more urgent callbacks preempt running ones',
        'otherwise': '--no-preemptive'},
    '--execution-times': {
        'metavar': 'FILE', 'type': Input,
        'help': 'JSON {"DAG": {"/node:callback": microseconds}} with fixed execution times, '
        "'-' for standard input", 'otherwise': 'drawn from the declared ones'},
    '--seed': {
        'type': seed, 'default': 0, 'metavar': 'N', 'help': 'seed of the drawn execution times',
        'otherwise': '0'},
    '--policy': lambda: _policy(),
    '--on-late': lambda: _on_late(),
    '--fail-on-miss': {
        'action': 'store_true',
        'help': 'exit with status 1 if more deadlines were missed than are tolerated '
        '(`tolerate:` in the declaration), or no job was due'},
    '--duration': {
        'type': duration, 'default': defaults.DURATION_NS, 'metavar': 'TIME',
        'help': 'virtual time of each run',
        'otherwise': f'{defaults.DURATION_NS // 10 ** 9}s'},
    '--overheads': {
        'type': duration_or_zero, 'default': 0, 'metavar': 'TIME',
        'help': 'time that each dispatch of a callback costs in addition', 'otherwise': '0'},
    '--parallel': {
        'type': positive_int, 'metavar': 'N', 'help': 'how many runs to simulate at a time',
        'otherwise': 'the number of processors'},
    '--utilisation': {
        'type': utilisation, 'metavar': 'U',
        'help': 'scale the execution times to this utilisation: the load of all DAGs divided by '
        'the number of workers'},
    '--from': {
        'type': duration_or_zero, 'metavar': 'TIME', 'dest': 'begin',
        'help': 'only jobs released at this time or later, counted from the first release, for '
        'instance 90s', 'otherwise': 'from the start'},
    '--to': {
        'type': duration, 'metavar': 'TIME', 'dest': 'end',
        'help': 'only jobs released before this time', 'otherwise': 'to the end'},
    '--offset': {
        'type': _offset, 'action': 'append', 'default': [], 'metavar': 'NAME=TIME',
        'help': 'for recordings of several machines: how far the clock of process NAME (that of '
        "RUN.NAME.mcap, or of a trace with this name) is ahead of the first trace's clock, for "
        'instance 2.5ms, or -2.5ms if it is behind',
        'otherwise': 'estimated from messages in both directions'},
    '--overwrite': {
        'action': 'store_true', 'help': 'replace an existing recording or declaration'},
    '--ros-args': {
        'nargs': argparse.REMAINDER, 'metavar': '…',
        'help': 'pass the rest of the command line to rclpy.init, for instance -r /from:=/to'},
}


def _policy() -> dict[str, Any]:
    from mddag_executor.core.policies import POLICIES, SIMULATED_ONLY
    return {
        'type': _simulated_policy, 'default': 'rad', 'metavar': 'P',
        'help': f'one of {", ".join((*POLICIES, *SIMULATED_ONLY))}, or MODULE:FUNCTION, which is '
        'one of your own', 'otherwise': 'rad'}


def _simulated_policy(text: str) -> str:
    from mddag_executor.simulate.policies import policy
    return policy(text).name


def live_policy() -> dict[str, Any]:
    """Return how `--policy` of verbs that run callbacks differs: some are simulated only."""
    from mddag_executor.core import POLICIES, policy
    return {
        'type': lambda text: policy(text).name, 'help': f'one of {", ".join(POLICIES)}'}


def _on_late() -> dict[str, Any]:
    from mddag_executor.core.tables import ON_LATE
    return {
        'choices': (*ON_LATE,), 'default': 'continue', 'otherwise': '%(default)s',
        'help': 'how to treat a job that can no longer be in time, if the declaration does not '
        'say it'}


def add(
    parser: Arguments, *names: str, only: str = '', otherwise: str | None = None, **changes: Any
) -> None:
    """
    Declare some of the arguments that have the same meaning in all verbs.

    :param only: what the help begins with, if an option belongs to another one.
    :param otherwise: the default in words; the value of the option is None then.
    :param changes: other arguments of ``add_argument`` than usual.
    """
    for name in names:
        shared = _SHARED[name]
        kept = {**(shared() if callable(shared) else shared), **changes}
        default = kept.pop('otherwise', None)
        if otherwise is not None:
            default, kept['default'] = otherwise, None
        kept['help'] = only + kept['help'] + ('' if default is None else f' (default: {default})')
        parser.add_argument(*(('-o', name) if name == '--output' else (name,)), **kept)


def reject_options(args: argparse.Namespace, names: Iterable[str], why: str) -> None:
    """Refuse options that are given."""
    for name in names:
        if getattr(args, name) is not None:
            raise UsageError(f'--{name.replace("_", "-")}: {why}')


def add_recording(parser: argparse.ArgumentParser, what: str) -> None:
    """Declare `TRACE… [GRAPH]` (see `common.recording_and_graph`); `what`: TRACE's help."""
    parser.add_argument(
        'trace', metavar='TRACE', nargs='+', type=Input,
        help=f'{what}; if a run had several processes, name the traces of all')
    parser.add_argument(
        'graph', metavar='GRAPH', nargs='?', type=Input,
        help="the declaration to judge by, a .yaml or .yml file ('-': standard input; "
        'default: the one that the trace was recorded with)')
    add(parser, '--offset')
