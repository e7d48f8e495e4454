# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `generate`: random multi-deadline, multi-rate DAG sets as ordinary declarations.

Several sets go into a folder, which appears when all of them are written, and not before.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import fields, replace
import os
from pathlib import Path
import shutil
from typing import TYPE_CHECKING

from mddag_executor.cli import common, options
from mddag_executor.cli.text import Progress
from mddag_executor.errors import InputError, UsageError
from mddag_executor.generate import BASES, METHODS, Options

if TYPE_CHECKING:
    from collections.abc import Iterator

EXAMPLE = """\
mddag generate --utilisation 0.6 --seed 7 -o random.yaml
mddag generate --sets 400 --utilisation 0.1:1.0 --sinks 2:4 --tightness 0.3:1.0 -o sets
mddag evaluate sets --policies rad,gedf,rm,fifo --plot sets.svg"""

_MOST_SETS = 100_000
_DEFAULT = Options()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add('-o', '--output', metavar='OUT', default='-',
        help="the declaration ('-': standard output, the default); with --sets a new folder")
    add('--sets', type=options.positive_int, metavar='N',
        help='make N task sets, OUT/set_0000.yaml and so on (default: one, OUT itself)')
    add('--utilisation', type=_numbers, default=(0.5, 0.5), metavar='U[:U]',
        help='utilisation: the load of all DAGs divided by the workers, with mean execution '
        'times; with --sets two bounds, over which the sets are spread evenly (default: 0.5)')
    add('--workers', type=options.positive_int, default=_DEFAULT.workers, metavar='M',
        help='declared number of workers (default: %(default)s)')
    _add_pair(add, '--dags', options.positive_int, _DEFAULT.dags, 'number of DAGs')
    _add_pair(add, '--vertices', options.positive_int, _DEFAULT.vertices,
              'number of callbacks of each DAG')
    _add_pair(add, '--sinks', options.positive_int, _DEFAULT.sinks,
              'number of sinks of each DAG, each with its own deadline')
    add('--edge-probability', type=options.number, default=_DEFAULT.edge_probability, metavar='P',
        help='probability of an edge between two callbacks of a DAG (default: %(default)s)')
    add('--or-share', type=options.number, default=_DEFAULT.or_share, metavar='P',
        help='share of the callbacks with several predecessors that run once for each message '
        '(OR), and so are several vertices; the others join the messages (default: %(default)s)')
    add('--method', choices=METHODS, default=_DEFAULT.method,
        help='how the utilisation is distributed over DAGs and callbacks: Dirichlet-rescale or '
        'UUniFast(-Discard) (default: %(default)s)')
    add('--max-dag-load', '--max-dag-utilisation', type=options.number, dest='most_per_dag',
        default=_DEFAULT.most_per_dag, metavar='L',
        help='the largest load of one DAG, in cores; the second name is the older one '
        '(default: %(default)s)')
    add('--periods', type=_periods, default=_DEFAULT.periods_ns, dest='periods_ns',
        metavar='TIME,TIME…',
        help='each DAG gets one of these (default: 10ms,20ms,50ms,100ms,200ms)')
    add('--tightness', type=_numbers, default=_DEFAULT.tightness, metavar='F[:F]',
        help='each deadline divided by its base, drawn between the bounds (default: 0.5:1.0)')
    add('--deadline-of', choices=BASES, default=_DEFAULT.deadline_of,
        help="the base: the DAG's period, or the longest path to the sink (default: %(default)s)")
    add('--spread', type=options.number, default=_DEFAULT.spread, metavar='F',
        help='execution times are uniform within this share of their mean on either side '
        '(default: %(default)s, constant)')
    options.add_seed(
        parser, 'seed; the same seed and options give the same files', int, _DEFAULT.seed)


def _add_pair(
    add: Callable[..., object], option: str, kind: Callable[[str], int], default: tuple[int, int],
    what: str,
) -> None:
    def pair(text: str) -> tuple[int, int]:
        low, _, high = text.partition(':')
        return kind(low), kind(high or low)

    shown = f'{default[0]}' if default[0] == default[1] else f'{default[0]}:{default[1]}'
    add(option, type=pair, default=default, metavar='N[:N]', help=f'{what} (default: {shown})')


def _numbers(text: str) -> tuple[float, float]:
    low, _, high = text.partition(':')
    return options.number(low), options.number(high or low)


def _periods(text: str) -> tuple[int, ...]:
    return tuple(options.list_of(options.duration)(text))


def main(args: argparse.Namespace) -> int:
    """Make task sets."""
    from mddag_executor.generate import generate
    every = list(_every(args))
    for each in (every[0], every[-1]):
        each.check()
    if args.sets is None:
        common.check_output(args.output)
        common.write_text(args.output, generate(every[0]))
        return 0
    target = _check_folder(args.output)
    part = target.with_name(f'.{target.name}.{os.getpid()}.part')
    part.mkdir()
    try:
        with Progress('generating', len(every)) as line:
            for number, each in enumerate(every):
                text = generate(each, number)
                (part / f'set_{number:04d}.yaml').write_text(text, encoding='utf-8')
                line.update(number, f'of {len(every)} task sets')
        if target.is_dir():
            target.rmdir()  # it is empty
        part.rename(target)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    return 0


def _every(args: argparse.Namespace) -> Iterator[Options]:
    """Yield the options of each task set."""
    low, high = args.utilisation
    if low > high:
        raise UsageError(
            f'--utilisation {low:g}:{high:g}: the first is larger: write the smaller one first')
    sets = args.sets or 1
    if sets > _MOST_SETS:
        raise UsageError(f'--sets {sets}: it is too many: give at most {_MOST_SETS}')
    if low != high and sets == 1:
        raise UsageError('--utilisation: one task set has one: give a number, or more --sets')
    base = Options(**{
        field.name: getattr(args, field.name) for field in fields(Options)
        if field.name != 'utilisation'})
    for number in range(sets):
        share = number / (sets - 1) if sets > 1 else 0.0
        yield replace(base, utilisation=round(low + (high - low) * share, 9))


def _check_folder(path: str) -> Path:
    """Find out whether a new folder can be made, before the work starts."""
    if path == '-':
        raise UsageError('--sets: several declarations make a folder: name one with -o OUT')
    target = Path(path)
    target = target.parent.resolve() / target.name if target.name else target.resolve()
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(path, 'it is there already, and no empty folder', 'name another one')
    if not target.exists():
        common.check_output(path)
    return target
