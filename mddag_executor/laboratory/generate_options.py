# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What random task sets are asked for, and whether there can be any like that."""

from __future__ import annotations

from dataclasses import dataclass, Field, field, fields
import math
from typing import Any

from mddag_executor.errors import MddagError
from mddag_executor.text import counted
from msg_graph.duration import DAY
from msg_graph.model import MOST_WORKERS

METHODS = ('dirichlet', 'uunifast')
BASES = ('period', 'path')
LEAST_NS = 1_000
"""The shortest execution time of a callback."""

_MOST_VERTICES = 1_000


class GenerateError(MddagError):
    """Options that no task set can have."""


def _of(
    default: object, metavar: str, what: str, least: float = 0.0, most: float = math.inf, *,
    above: bool = False, option: str = '', choices: tuple[str, ...] = (),
) -> Any:
    """Return a field with all that its option needs; values are from ``least``, or above it."""
    return field(default=default, metadata={
        'metavar': metavar, 'what': what, 'least': least, 'most': most, 'above': above,
        'option': option, 'choices': choices})


@dataclass(frozen=True)
class Options:
    """
    What a random task set is like; pairs are the bounds of a uniform draw, both included.

    What each field means is the help of its option; what it may be is checked by ``check``.
    """

    dags: tuple[int, int] = _of((8, 8), 'N[:N]', 'number of DAGs', 1, 1_000)
    vertices: tuple[int, int] = _of(
        (5, 15), 'N[:N]', 'number of callbacks of each DAG', 1, _MOST_VERTICES)
    sinks: tuple[int, int] = _of(
        (1, 3), 'N[:N]', 'number of sinks of each DAG, each with its own deadline', 1,
        _MOST_VERTICES)
    edge_probability: float = _of(
        0.2, 'P', 'probability of an edge between two callbacks of a DAG', most=1.0)
    or_share: float = _of(
        0.0, 'P', 'share of the callbacks with several predecessors that run once for each '
        'message (OR), and so are several vertices; the others join the messages', most=1.0)
    utilisation: float = _of(
        0.5, 'U[:U]', 'utilisation: the load of all DAGs divided by the workers, with mean '
        'execution times; with --sets two bounds, over which the sets are spread evenly',
        most=100.0, above=True)
    workers: int = _of(4, 'M', 'declared number of workers', 1, MOST_WORKERS)
    method: str = _of(
        'dirichlet', '', 'how the utilisation is distributed over DAGs and callbacks: '
        'Dirichlet-rescale or UUniFast(-Discard)', choices=METHODS)
    most_per_dag: float = _of(
        1.0, 'L', 'the largest load of one DAG, in cores; the second name is the older one',
        most=1000.0, above=True, option='--max-dag-load')
    periods_ns: tuple[int, ...] = _of(
        (10_000_000, 20_000_000, 50_000_000, 100_000_000, 200_000_000), 'TIME,TIME…',
        'each DAG gets one of these', LEAST_NS, DAY, option='--periods')
    tightness: tuple[float, float] = _of(
        (0.5, 1.0), 'F[:F]', 'each deadline divided by its base, drawn between the bounds',
        most=1000.0, above=True)
    deadline_of: str = _of(
        'period', '', "the base: the DAG's period, or the longest path to the sink", choices=BASES)
    spread: float = _of(
        0.0, 'F', 'execution times are uniform within this share of their mean on either side; 0: '
        'constant', most=0.99)
    seed: int = _of(
        0, 'N', 'seed; the same seed and options give the same files', -math.inf)

    def check(self) -> None:
        """Find out whether a task set can be like that."""
        if not self.periods_ns:
            raise GenerateError('--periods: there is none: give some, as 10ms,20ms')
        for each in fields(self):
            option, about, value = option_of(each), each.metadata, getattr(self, each.name)
            if about['choices']:
                if value not in about['choices']:
                    raise GenerateError(
                        f"{option} '{value}': choose one of {', '.join(about['choices'])}")
                continue
            values = value if isinstance(value, tuple) else (value,)
            for one in values:
                _number(option, one, about['least'], about['most'], about['above'])
            if isinstance(value, tuple) and each.name != 'periods_ns':
                low, high = value
                if low > high:
                    raise GenerateError(f'{option} {low:g}:{high:g}: the first is larger: write '
                                        'the smaller one first')
        self._check_together()

    def _check_together(self) -> None:
        least = self.vertices[0]
        if self.sinks[0] > max(1, least - 1):
            raise GenerateError(
                f'--sinks {self.sinks[0]}: a DAG of {counted(least, "vertex", "vertices")} has at '
                f'most {max(1, least - 1)}: give fewer, or more --vertices')
        total = self.utilisation * self.workers
        most = self.dags[0] * self.most_per_dag
        if total > most * (1 + 1e-12):
            raise GenerateError(
                f'--utilisation {self.utilisation:g}: a load of {total:g} does not fit into '
                f'{counted(self.dags[0], "DAG")} of at most {self.most_per_dag:g} on '
                f'{counted(self.workers, "worker")}: give more --dags, or a larger '
                '--max-dag-load')


def option_of(each: Field[Any]) -> str:
    """Return the option that a field of ``Options`` is."""
    return each.metadata['option'] or '--' + each.name.replace('_', '-')


def _number(option: str, value: float, least: float, most: float, above: bool) -> None:
    if math.isfinite(value) and least <= value <= most and not (above and value == least):
        return
    lower = f'above {least:g}' if above else f'from {least:g}'
    raise GenerateError(f'{option} {value:g}: it is out of range: give {lower} to {most:g}')
