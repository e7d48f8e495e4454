# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Imported recordings with anything in them: one line about it, never a traceback."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import random
from typing import Any

from mddag_executor.errors import MddagError
from mddag_executor.replay import replay, reschedule
from mddag_executor.trace import EventType, TraceFile, TraceReader
from msg_graph import TaskSet
import pytest

from .recorded import Recorded
from .test_imported import graph, recorded  # noqa: F401

SEEDS = 60
_VALUES = (0, 1, -1, 2 ** 63 - 1, -2 ** 63, 2 ** 64 - 1, 11, 12, 100, 30_012)
_TEXTS = ('', '/', '/camera', 'x' * 5000, '\x1b[2J\n', '/camera\n')


def mutated(source: Path, target: Path, seed: int) -> Path:
    """Write a recording with events left out, doubled, in other places, or with other values."""
    rng = random.Random(seed)
    reader = TraceReader(source)
    events: list[tuple[Any, ...]] = list(reader.layout_events(None))
    with TraceFile(target, overwrite=True) as file:
        for layout, time, pid, tid, *values in _shuffled(events, rng):
            kinds = []
            for place, (field, value) in enumerate(zip(layout.fields, values)):
                kind = 'string' if isinstance(value, str) else \
                    'bool' if isinstance(value, bool) else 'int64'
                if rng.random() < 0.03:
                    if kind == 'string':
                        values[place] = rng.choice(_TEXTS)
                    elif kind == 'int64':
                        values[place] = max(-2 ** 63, min(2 ** 63 - 1, rng.choice(_VALUES)))
                kinds.append((field, kind))
            if rng.random() < 0.01:
                place = rng.randrange(len(kinds)) if kinds else 0
                del kinds[place:place + 1], values[place:place + 1]
            if rng.random() < 0.02:
                time = rng.choice((0, 1, time + 10 ** 9, 2 ** 62, 2 ** 63 - 1))
            provider, _, name = layout.name.partition(':')
            key = file.define(EventType(provider, name, tuple(kinds)))
            file.extend(((key, time, tid, *values),), pid)
    return target


def _shuffled(events: list[tuple[Any, ...]], rng: random.Random) -> Iterator[tuple[Any, ...]]:
    for event in events:
        chance = rng.random()
        if chance < 0.02:
            continue
        yield event
        if chance > 0.98:
            yield rng.choice(events)


@pytest.mark.parametrize('first', range(0, SEEDS, 20))
def test_anything_in_it(
    recorded: Recorded, graph: TaskSet, tmp_path: Path, first: int      # noqa: F811
) -> None:
    source = recorded.write()
    replayed = 0
    for seed in range(first, first + 20):
        path = mutated(source, tmp_path / f'{seed}.mcap', seed)
        try:
            result = replay(path, graph).result()
        except MddagError:
            continue
        replay(path).result()
        try:
            reschedule(path, graph, policy='fifo').result()
        except MddagError as error:
            assert 'execution_time' in str(error)
        replayed += 1
        for dag in result['dags'].values():
            for sink in dag['sinks'].values():
                assert 0 <= sink['completed'] <= dag['jobs']
                response = sink['response_ns']
                assert response is None or 0 <= response['min'] <= response['max']
        for path_result in result['paths'].values():
            for figures in (path_result['data_age'], path_result['reaction_time']):
                assert figures is None or 0 <= figures['min'] <= figures['max']
    assert replayed > 15
