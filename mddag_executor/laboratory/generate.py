# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Random task sets as text of declarations.

Theory of operation
-------------------
1. Periods and graphs are drawn, then the load is distributed to the DAGs, and each DAG's time for
   one job to its callbacks.  No execution time is below ``LEAST_NS``.
2. Execution times are integers of ns; the source gets the remainder of rounding.  So their sum is
   the given load, to half a ns for each DAG.
3. The deadline of each sink is drawn as a multiple of the period, and rounded up to whole us.
4. A task set depends on its seed and number only.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
import math
from typing import NamedTuple

from mddag_executor.errors import UsageError
from mddag_executor.laboratory.shapes import draw_shape, Shape
from mddag_executor.laboratory.shares import Dice, dirichlet_rescale
from mddag_executor.text import counted
from msg_graph.duration import DAY, exact_duration, round_up_deadline
from msg_graph.model import MOST_WORKERS

LEAST_NS = 1_000
"""The shortest execution time of a callback."""
_LEAST_ABOVE_0 = 5e-324
# field: option, least and most value
_RANGES: dict[str, tuple[str, float, float]] = {
    'dags': ('--dags', 1, 1_000),
    'vertices': ('--vertices', 1, 1_000),
    'sinks': ('--sinks', 1, 1_000),
    'edge_probability': ('--edge-probability', 0, 1),
    'or_share': ('--or-share', 0, 1),
    'utilisation': ('--utilisation', _LEAST_ABOVE_0, 100),
    'workers': ('--workers', 1, MOST_WORKERS),
    'most_per_dag': ('--max-dag-load', _LEAST_ABOVE_0, 1_000),
    'periods_ns': ('--periods', LEAST_NS, DAY),
    'tightness': ('--tightness', _LEAST_ABOVE_0, 1_000),
}


@dataclass(frozen=True)
class Options:
    """
    What a random task set is like; pairs are the bounds of a uniform draw, both included.

    :ivar vertices: number of callbacks of each DAG; ``sinks``: of its sinks.
    :ivar edge_probability: of an edge between two callbacks of a DAG.
    :ivar or_share: share of the callbacks with several predecessors that run once for each
        message (OR), and so are several vertices; the others join the messages.
    :ivar utilisation: the load of all DAGs divided by the workers.
    :ivar most_per_dag: the largest load of one DAG, in cores.
    :ivar periods_ns: each DAG gets one of these.
    :ivar tightness: each deadline divided by the period of its DAG.
    """

    dags: tuple[int, int] = (8, 8)
    vertices: tuple[int, int] = (5, 15)
    sinks: tuple[int, int] = (1, 3)
    edge_probability: float = 0.2
    or_share: float = 0.0
    utilisation: float = 0.5
    workers: int = 4
    most_per_dag: float = 1.0
    periods_ns: tuple[int, ...] = (
        10_000_000, 20_000_000, 50_000_000, 100_000_000, 200_000_000)
    tightness: tuple[float, float] = (0.5, 1.0)
    seed: int = 0

    def check(self) -> None:
        """Check that there can be such a task set, or raise UsageError."""
        for name, (option, least, most) in _RANGES.items():
            value = getattr(self, name)
            values = value if isinstance(value, tuple) else (value,)
            for one in values:
                if not (math.isfinite(one) and least <= one <= most):
                    lower = 'above 0' if least == _LEAST_ABOVE_0 else f'{least:g}'
                    raise UsageError(
                        f'{option} {one:g}: it is out of range: give {lower} to {most:g}')
            if name != 'periods_ns' and values[0] > values[-1]:
                raise UsageError(f'{option} {values[0]:g}:{values[-1]:g}: the first is larger: '
                                 'write the smaller one first')
        vertices, dags = self.vertices[0], self.dags[0]
        if self.sinks[0] > max(1, vertices - 1):
            raise UsageError(
                f'--sinks {self.sinks[0]}: a DAG of {counted(vertices, "vertex", "vertices")} has '
                f'at most {max(1, vertices - 1)}: give fewer, or more --vertices')
        load = self.utilisation * self.workers
        if load > dags * self.most_per_dag * (1 + 1e-12):
            raise UsageError(
                f'--utilisation {self.utilisation:g}: a load of {load:g} does not fit into '
                f'{counted(dags, "DAG")} of at most {self.most_per_dag:g}: give more --dags, or a '
                'larger --max-dag-load')


class _Dag(NamedTuple):
    name: str
    period_ns: int
    shape: Shape
    costs: list[int]
    deadlines: list[int]


def generate(options: Options, number: int = 0) -> str:
    """Return the declaration of a random task set, that of this number for the seed."""
    options.check()
    dice = Dice(f'mddag {options.seed} {number}')
    drawn = [
        (dice.pick(options.periods_ns), _shape(dice, options))
        for _ in range(dice.whole(*options.dags))]
    least = [sum(shape.copies) * LEAST_NS / period for period, shape in drawn]
    utilisations = _utilisations(dice, options, least)
    dags = []
    for i, (period, shape) in enumerate(drawn):
        costs = _costs(dice, shape, round(utilisations[i] * period))
        deadlines = [round_up_deadline(period * dice.number(*options.tightness))
                     for _ in range(shape.first_sink, shape.count)]
        dags.append(_Dag(f'dag_{i}', period, shape, costs, deadlines))
    return '\n'.join(_lines(options, number, dags)) + '\n'


def _shape(dice: Dice, options: Options) -> Shape:
    count = dice.whole(*options.vertices)
    most = max(1, count - 1)
    sinks = dice.whole(min(options.sinks[0], most), min(options.sinks[1], most))
    return draw_shape(dice, count, sinks, options.edge_probability, options.or_share)


def _utilisations(dice: Dice, options: Options, least: list[float]) -> list[float]:
    """Distribute the load above the least one of each DAG."""
    total = options.utilisation * options.workers
    room = [options.most_per_dag - low for low in least]
    if total < sum(least) or min(room) < 0:
        raise UsageError(
            f'--utilisation {options.utilisation:g}: it leaves a callback less than 1 us: give '
            'more utilisation, longer --periods, or fewer --dags or --vertices')
    shares = dirichlet_rescale(dice, total - sum(least), room)
    return [low + share for low, share in zip(least, shares)]


def _costs(dice: Dice, shape: Shape, volume: int) -> list[int]:
    """Distribute a DAG's time for one job (ns) to its callbacks, by how often they run."""
    spare = volume - sum(shape.copies) * LEAST_NS
    shares = dirichlet_rescale(dice, max(0, spare), [float(max(0, spare))] * shape.count)
    costs = [LEAST_NS + round(share / copies) for share, copies in zip(shares, shape.copies)]
    costs[0] += volume - sum(cost * copies for cost, copies in zip(costs, shape.copies))
    for place in range(1, shape.count):
        if costs[0] >= LEAST_NS:
            break
        # Rounding made the others some ns too long.
        less = min(costs[place] - LEAST_NS, -(-(LEAST_NS - costs[0]) // shape.copies[place]))
        costs[place] -= less
        costs[0] += less * shape.copies[place]
    return costs


def _lines(options: Options, number: int, dags: list[_Dag]) -> Iterator[str]:
    yield f"# Random declaration {number} of 'mddag generate', with seed {options.seed}:"
    for field in fields(options):
        value = getattr(options, field.name)
        if isinstance(value, tuple):
            value = (', ' if field.name == 'periods_ns' else ' to ').join(map(str, value))
        if field.name != 'seed':
            yield f'# {field.name}: {value}'
    yield 'mddag: 1'
    yield f'workers: {options.workers}'
    yield 'nodes:'
    for dag in dags:
        yield f'  - node: /{dag.name}'
        yield '    callbacks:'
        for place in range(dag.shape.count):
            yield from _callback(dag, place)


def _callback(dag: _Dag, place: int) -> Iterator[str]:
    shape = dag.shape
    before = shape.predecessors[place]
    yield f'      - name: v{place}'
    if place == 0:
        yield f'        timer: {exact_duration(dag.period_ns)}'
        yield f'        dag: {dag.name}'
    elif len(before) == 1 or shape.is_or[place]:
        topic = f'to_v{place}' if shape.is_or[place] else f'v{before[0]}'
        yield f'        subscription: /{dag.name}/{topic}'
    else:
        yield '        sync:'
        yield from (f'          - /{dag.name}/v{p}' for p in before)
    topics = _published(dag, place)
    if topics:
        yield '        publishes:'
        yield from (f'          - {topic}' for topic in topics)
    if place >= shape.first_sink:
        yield f'        deadline: {exact_duration(dag.deadlines[place - shape.first_sink])}'
    yield f'        execution_time: {exact_duration(dag.costs[place])}'


def _published(dag: _Dag, place: int) -> list[str]:
    """Return a callback's topics: its own if it has subscribers, and those of OR callbacks."""
    shape = dag.shape
    after = [i for i in range(place + 1, shape.count) if place in shape.predecessors[i]]
    own = [f'/{dag.name}/v{place}'] if any(not shape.is_or[i] for i in after) else []
    return own + [f'/{dag.name}/to_v{i}' for i in after if shape.is_or[i]]
