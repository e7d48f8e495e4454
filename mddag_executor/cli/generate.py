# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `generate`: random multi-deadline, multi-rate DAG sets as ordinary declarations.

Several sets go into a folder, which appears when all of them are written (`common.output_folder`).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from typing import Any

from mddag_executor.cli import common, options
from mddag_executor.cli.text import Progress
from mddag_executor.errors import UsageError
from mddag_executor.laboratory.generate import Options
from mddag_executor.output_rules import check_output

EXAMPLE = """\
mddag generate --utilisation 0.6 --seed 7 -o random.yaml
mddag generate --sets 400 --utilisation 0.1:1.0 --sinks 2:4 --tightness 0.3:1.0 -o sets
mddag evaluate sets --policies rad,gedf,rm,fifo --plot sets.svg"""

_MOST_SETS = 100_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    def add(
        name: str, kind: Callable[[str], Any], metavar: str, what: str, dest: str = ''
    ) -> None:
        field = dest or name[2:].replace('-', '_')
        default = getattr(Options, field)
        shown = ':'.join(map(str, default)) if isinstance(default, tuple) else default
        if field == 'periods_ns':
            shown = ','.join(f'{ns // 10 ** 6}ms' for ns in default)
        parser.add_argument(
            name, type=kind, metavar=metavar, dest=field, default=default,
            help=f'{what} (default: {shown})')

    whole, real = _pair(options.positive_int), _pair(options.number)
    parser.add_argument(
        '-o', '--output', metavar='OUT', default='-',
        help="the declaration ('-': standard output, the default); with --sets a new folder")
    options.add(parser, '--overwrite')
    parser.add_argument('--sets', type=options.positive_int, metavar='N',
                        help='make N declarations, OUT/set_0000.yaml and so on')
    add('--dags', whole, 'N[:N]', 'number of DAGs')
    add('--vertices', whole, 'N[:N]', 'number of callbacks of each DAG')
    add('--sinks', whole, 'N[:N]', 'number of sinks of each DAG, each with its own deadline')
    add('--edge-probability', options.number, 'P',
        'probability of an edge between two callbacks of a DAG')
    add('--or-share', options.number, 'P',
        'share of the callbacks with several predecessors that run once for each message, so '
        'that they are several vertices; the others wait for all of the messages (sync)')
    add('--utilisation', real, 'U[:U]',
        'the load of all DAGs divided by the number of workers; with --sets two bounds, over '
        'which the declarations are spread evenly')
    add('--workers', options.workers, 'M', 'declared number of workers')
    add('--max-dag-load', options.number, 'L', 'largest load of a DAG, in cores', 'most_per_dag')
    add('--periods', lambda text: tuple(options.list_of(options.duration)(text)), 'TIME,TIME…',
        'each DAG gets one of these', 'periods_ns')
    add('--tightness', real, 'F[:F]', 'each deadline divided by the period, drawn in these bounds')
    add('--seed', options.seed, 'N', 'seed; the same seed and options give the same files')


def _pair(kind: Callable[[str], Any]) -> Callable[[str], Any]:
    def pair(text: str) -> tuple[Any, Any]:
        low, _, high = text.partition(':')
        return kind(low), kind(high or low)

    return pair


def main(args: argparse.Namespace) -> int:
    from mddag_executor.laboratory.generate import generate
    every = list(_every(args))
    for each in (every[0], every[-1]):
        each.check()
    if args.sets is None:
        check_output(args.output, is_kept=True, overwrite=args.overwrite)
        common.write_text(args.output, generate(every[0]))
        return 0
    if args.output == '-':
        raise UsageError('--sets: several declarations make a folder: name one with -o OUT')
    names = [f'set_{number:04d}.yaml' for number in range(len(every))]
    common.check_folder(args.output, names)
    with common.output_folder(args.output, names) as folder, Progress(
            'generating', len(every)) as line:
        for number, (name, each) in enumerate(zip(names, every)):
            (folder / name).write_text(generate(each, number), encoding='utf-8')
            line.update(number, f'of {len(every)} declarations')
    return 0


def _every(args: argparse.Namespace) -> Iterator[Options]:
    low, high = args.utilisation if isinstance(args.utilisation, tuple) else (
        args.utilisation, args.utilisation)
    sets = args.sets or 1
    if sets > _MOST_SETS:
        raise UsageError(f'--sets {sets}: it is too many: give at most {_MOST_SETS}')
    if low > high or (low != high and sets == 1):
        raise UsageError(f'--utilisation {low:g}:{high:g}: one declaration has one, and the '
                         'smaller of two comes first: give a number, or low:high with --sets')
    base = Options(**{field.name: getattr(args, field.name) for field in fields(Options)
                      if field.name != 'utilisation'})
    for number in range(sets):
        share = number / (sets - 1) if sets > 1 else 0.0
        yield replace(base, utilisation=round(low + (high - low) * share, 9))
