# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What random task sets are asked for, and whether there can be any like that."""

from __future__ import annotations

from dataclasses import dataclass
import math

from mddag_executor.errors import MddagError
from mddag_executor.text import counted
from msg_graph.duration import DAY

METHODS = ('dirichlet', 'uunifast')
BASES = ('period', 'path')
LEAST_NS = 1_000
"""The shortest execution time of a callback."""

_MOST_DAGS = 1_000
_MOST_VERTICES = 1_000


class GenerateError(MddagError):
    """Options that no task set can have."""


@dataclass(frozen=True)
class Options:
    """
    What a random task set is like; pairs are the bounds of a uniform draw, both included.

    :ivar dags: number of DAGs.
    :ivar vertices: number of callbacks of a DAG.
    :ivar sinks: number of sinks of a DAG, each with a deadline of its own.
    :ivar edge_probability: of an edge between two callbacks of a DAG.
    :ivar or_share: probability that a callback with several predecessors runs once for each of
        their messages (OR), and does not join them (AND).
    :ivar utilisation: normalised: of all DAGs together, by workers.
    :ivar workers: number of workers, which is declared.
    :ivar method: how the utilisation is dealt out to DAGs, and a DAG's to its callbacks.
    :ivar most_per_dag: the largest load of one DAG, in cores.
    :ivar periods_ns: each DAG gets one of these.
    :ivar tightness: a deadline as a multiple of its base.
    :ivar deadline_of: that base: the DAG's period, or the longest path to the sink.
    :ivar spread: half the width of the uniform distribution of execution times, by their mean.
    :ivar seed: of all draws.
    """

    dags: tuple[int, int] = (8, 8)
    vertices: tuple[int, int] = (5, 15)
    sinks: tuple[int, int] = (1, 3)
    edge_probability: float = 0.2
    or_share: float = 0.0
    utilisation: float = 0.5
    workers: int = 4
    method: str = 'dirichlet'
    most_per_dag: float = 1.0
    periods_ns: tuple[int, ...] = (10_000_000, 20_000_000, 50_000_000, 100_000_000, 200_000_000)
    tightness: tuple[float, float] = (0.5, 1.0)
    deadline_of: str = 'period'
    spread: float = 0.0
    seed: int = 0

    def check(self) -> None:
        """Find out whether a task set can be like that."""
        _bounds('--dags', self.dags, 1, _MOST_DAGS)
        _bounds('--vertices', self.vertices, 1, _MOST_VERTICES)
        _bounds('--sinks', self.sinks, 1, _MOST_VERTICES)
        _bounds('--tightness', self.tightness, 0.0, 1000.0, above=True)
        _number('--edge-probability', self.edge_probability, 0.0, 1.0)
        _number('--or-share', self.or_share, 0.0, 1.0)
        _number('--spread', self.spread, 0.0, 0.99)
        _number('--utilisation', self.utilisation, 0.0, 100.0, above=True)
        _number('--max-dag-load', self.most_per_dag, 0.0, 1000.0, above=True)
        _bounds('--workers', (self.workers, self.workers), 1, 1024)
        for option, value, choices in (('--method', self.method, METHODS),
                                       ('--deadline-of', self.deadline_of, BASES)):
            if value not in choices:
                raise GenerateError(f"{option} '{value}': choose one of {', '.join(choices)}")
        if not self.periods_ns:
            raise GenerateError('--periods: there is none: give some, as 10ms,20ms')
        for period in self.periods_ns:
            _bounds('--periods', (period, period), LEAST_NS, DAY)
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


def _bounds(
    option: str, pair: tuple[float, float], least: float, most: float, above: bool = False
) -> None:
    for value in pair:
        _number(option, value, least, most, above)
    if pair[0] > pair[1]:
        raise GenerateError(
            f'{option} {pair[0]:g}:{pair[1]:g}: the first is larger: write the smaller one first')


def _number(
    option: str, value: float, least: float, most: float, above: bool = False
) -> None:
    if math.isfinite(value) and least <= value <= most and not (above and value == least):
        return
    lower = f'above {least:g}' if above else f'from {least:g}'
    raise GenerateError(f'{option} {value:g}: it is out of range: give {lower} to {most:g}')
