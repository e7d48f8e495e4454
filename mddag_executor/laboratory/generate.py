# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Random task sets as text of declarations.

Theory of operation
-------------------
1. Periods and graphs are drawn, then the utilisation is dealt out to the DAGs, and each DAG's time
   for one job to its callbacks.  No execution time is below ``LEAST_NS``.
2. Execution times are whole ns; what rounding leaves goes to the source.  So the sum is what was
   asked for, to half a ns for each DAG.
3. Deadlines are drawn for each sink apart, as multiples of the period or of the longest path (of
   mean execution times), and rounded up to whole us.
4. A task set is drawn from seed and number alone: the same in every file, in any order.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from typing import NamedTuple

from mddag_executor.laboratory.generate_options import GenerateError, LEAST_NS, Options
from mddag_executor.laboratory.shapes import draw_shape, Shape
from mddag_executor.laboratory.shares import deal, Dice
from msg_graph.duration import exact_duration, whole_us


class _Dag(NamedTuple):
    name: str
    period_ns: int
    shape: Shape
    costs: list[int]
    deadlines: list[int]


def generate(options: Options, number: int = 0) -> str:
    """
    Return the declaration of a random task set.

    :param number: which of the task sets of this seed.
    """
    options.check()
    dice = Dice(f'mddag {options.seed} {number}')
    drawn = [
        (dice.pick(options.periods_ns), _shape(dice, options))
        for _ in range(dice.whole(*options.dags))]
    least = [sum(shape.copies) * LEAST_NS / period for period, shape in drawn]
    utilisations = _utilisations(dice, options, least)
    dags = []
    for i, (period, shape) in enumerate(drawn):
        costs = _costs(dice, options.method, shape, round(utilisations[i] * period))
        dags.append(_Dag(
            f'dag_{i}', period, shape, costs, _deadlines(dice, options, period, shape, costs)))
    return '\n'.join(_lines(options, number, dags)) + '\n'


def _shape(dice: Dice, options: Options) -> Shape:
    count = dice.whole(*options.vertices)
    most = max(1, count - 1)
    sinks = dice.whole(min(options.sinks[0], most), min(options.sinks[1], most))
    return draw_shape(dice, count, sinks, options.edge_probability, options.or_share)


def _utilisations(dice: Dice, options: Options, least: list[float]) -> list[float]:
    """Deal out what is above the least utilisation of each DAG."""
    total = options.utilisation * options.workers
    room = [options.most_per_dag - low for low in least]
    if total < sum(least) or min(room) < 0:
        raise GenerateError(
            f'--utilisation {options.utilisation:g}: it leaves a callback less than 1 us: give '
            'more utilisation, longer --periods, or fewer --dags or --vertices')
    shares = deal(dice, options.method, total - sum(least), room)
    return [low + share for low, share in zip(least, shares)]


def _costs(dice: Dice, method: str, shape: Shape, volume: int) -> list[int]:
    """Deal out a DAG's time for one job (ns) to its callbacks, by how often they run."""
    spare = volume - sum(shape.copies) * LEAST_NS
    shares = deal(dice, method, max(0, spare), [float(max(0, spare))] * shape.count)
    costs = [LEAST_NS + round(share / copies) for share, copies in zip(shares, shape.copies)]
    costs[0] += volume - sum(cost * copies for cost, copies in zip(costs, shape.copies))
    for place in range(1, shape.count):
        if costs[0] >= LEAST_NS:
            break
        # Rounding took some ns too many: others have them.
        less = min(costs[place] - LEAST_NS, -(-(LEAST_NS - costs[0]) // shape.copies[place]))
        costs[place] -= less
        costs[0] += less * shape.copies[place]
    return costs


def _deadlines(
    dice: Dice, options: Options, period: int, shape: Shape, costs: list[int]
) -> list[int]:
    """Return the relative deadline (ns) of each sink."""
    lengths = shape.path_lengths(costs)
    deadlines = []
    for sink in range(shape.first_sink, shape.count):
        base = period if options.deadline_of == 'period' else lengths[sink]
        deadlines.append(whole_us(base * dice.number(*options.tightness)))
    return deadlines


def _lines(options: Options, number: int, dags: list[_Dag]) -> Iterator[str]:
    yield f"# Random task set {number} of 'mddag generate', with seed {options.seed}:"
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
            yield from _callback(dag, place, options.spread)


def _callback(dag: _Dag, place: int, spread: float) -> Iterator[str]:
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
    yield f'        execution_time: {_execution_time(dag.costs[place], spread)}'


def _published(dag: _Dag, place: int) -> list[str]:
    """Return a callback's topics: its own if anybody takes it, and those of OR callbacks."""
    shape = dag.shape
    after = [i for i in range(place + 1, shape.count) if place in shape.predecessors[i]]
    own = [f'/{dag.name}/v{place}'] if any(not shape.is_or[i] for i in after) else []
    return own + [f'/{dag.name}/to_v{i}' for i in after if shape.is_or[i]]


def _execution_time(cost: int, spread: float) -> str:
    half = int(cost * spread)
    if half == 0:
        return exact_duration(cost)
    return f'{{quantiles_us: [{(cost - half) / 1000:.3f}, {(cost + half) / 1000:.3f}]}}'
