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
from typing import Any, TYPE_CHECKING, TypeVar

from mddag_executor.cli import common, options
from mddag_executor.cli.text import Progress
from mddag_executor.errors import InputError, UsageError
from mddag_executor.laboratory.generate_options import option_of, Options
from msg_graph.duration import exact_duration

if TYPE_CHECKING:
    from collections.abc import Iterator

EXAMPLE = """\
mddag generate --utilisation 0.6 --seed 7 -o random.yaml
mddag generate --sets 400 --utilisation 0.1:1.0 --sinks 2:4 --tightness 0.3:1.0 -o sets
mddag evaluate sets --policies rad,gedf,rm,fifo --plot sets.svg"""

_MOST_SETS = 100_000
T = TypeVar('T')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add('-o', '--output', metavar='OUT', default='-',
        help="the declaration ('-': standard output, the default); with --sets a new folder")
    add('--sets', type=options.positive_int, metavar='N',
        help='make N task sets, OUT/set_0000.yaml and so on (default: one, OUT itself)')
    for each in fields(Options):
        default: Any = each.default
        about, shown = each.metadata, default
        if each.name == 'utilisation':
            default = default, default
        elif isinstance(default, tuple):
            shown = ':'.join(dict.fromkeys(map(str, default)))
        if each.name == 'periods_ns':
            shown = ','.join(map(exact_duration, default))
        older = ['--max-dag-utilisation'] if each.name == 'most_per_dag' else []
        what: dict[str, Any] = {'choices': about['choices']} if about['choices'] else {
            'type': _KINDS.get(each.name, options.number), 'metavar': about['metavar']}
        add(option_of(each), *older, dest=each.name, default=default, **what,
            help=f'{about["what"]} (default: {shown})')


def _pair(kind: Callable[[str], T]) -> Callable[[str], tuple[T, T]]:
    def pair(text: str) -> tuple[T, T]:
        low, _, high = text.partition(':')
        return kind(low), kind(high or low)

    return pair


_KINDS: dict[str, Callable[[str], Any]] = {
    **dict.fromkeys(('dags', 'vertices', 'sinks'), _pair(options.positive_int)),
    **dict.fromkeys(('utilisation', 'tightness'), _pair(options.number)),
    'workers': options.workers, 'seed': int,
    'periods_ns': lambda text: tuple(options.list_of(options.duration)(text))}


def main(args: argparse.Namespace) -> int:
    """Make task sets."""
    from mddag_executor.laboratory.generate import generate
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
