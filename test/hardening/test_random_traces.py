# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Traces that are sound as files and say anything: every verb uses or refuses them, no traceback.

`test/replay/test_fuzz.py` damages the bytes of traces. Here each event is whole and of a known
kind, but what it says makes no sense: events are left out, doubled, swapped, and their fields
changed into the numbers and texts that hurt most. One in eight is made of a recorded run, the
others of a small simulated one. `HARDENING_EXAMPLES=10000` tries that many.
"""

import os
from pathlib import Path
import random
import tempfile

from mddag_executor.cli import main as program
from mddag_executor.trace import read_events, TraceFile
from mddag_executor.trace.cdr import FieldType
from mddag_executor.trace.schema import EVENTS
import pytest

from .verbs import run

EXAMPLES = int(os.environ.get('HARDENING_EXAMPLES', '32'))
BATCHES = 2
BAG = Path(__file__).resolve().parents[2] / 'bags' / 'demo_short.mcap'
TEXTS = ['', 'rad', 'ros2', '/n', '/n:tick', '0,1', '-1', '9' * 30, ',,,', '\x1b[2J', '../..',
         'x' * 999, 'mddag: 1', '{}', '<b>', '/trace/../x', 'timer', 'on_tick@dag']
NUMBERS = [0, 1, 2, -1, -2, 7, 2**31 - 1, -2**31, 2**32, 2**53, 2**62, 2**63 - 1, -2**63]
VERBS = (
    ('replay', 'run.mcap'), ('replay', 'run.mcap', '--json', '-'),
    ('replay', 'run.mcap', '--reschedule', '--workers', '2'),
    ('replay', 'run.mcap', '--reschedule', '--policy', 'ros2'),
    ('diff', 'run.mcap', 'run.mcap'), ('export', 'run.mcap', '-o', 'out.csv'),
    ('graph', 'from-trace', 'run.mcap', '-o', 'graph.yaml'),
)


GRAPH = """
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: tick, timer: 10ms, publishes: [/a, /b], execution_time: 2ms, dag: d}
      - {name: left, subscription: /a, publishes: [/c], execution_time: 3ms}
      - {name: right, subscription: /b, execution_time: 1ms, deadline: 9ms}
  - node: /m
    callbacks:
      - {name: both, sync: [/c, /b], deadline: 10ms, execution_time: 1ms}
      - {name: other, timer: 7ms, deadline: 7ms, execution_time: 3ms, on_late: abort, dag: e}
paths:
  - {name: whole, callbacks: ['/n:tick', '/n:left', '/m:both']}
"""


@pytest.fixture(scope='module')
def runs(tmp_path_factory):
    """Give the events of a small run and the first ones of a recorded run, entities and all."""
    folder = tmp_path_factory.mktemp('run')
    (folder / 'graph.yaml').write_text(GRAPH)
    assert program.main(('simulate', str(folder / 'graph.yaml'), '--duration', '60ms', '--workers',
                         '2', '--trace', str(folder / 'run.mcap'))) == 0
    return [rows_of(folder / 'run.mcap', 10_000), rows_of(BAG, 150)]


def rows_of(path, most):
    """Return the events of a trace, up to so many that jobs consist of."""
    found, at_work = [], 0
    for event in read_events(path):
        kind = EVENTS[event['_name']]
        at_work += kind.name in ('dispatch', 'job_release', 'complete', 'rclcpp_publish')
        found.append((event['_name'], event['_timestamp'], event['_vpid'], event['_vtid'],
                      [event.get(name, 0) for name, _ in kind.fields]))
        if at_work > most:
            break
    return found


def changed(rows, dice):
    """Return the events with a few that lie."""
    rows = list(rows)
    for _ in range(dice.choice((1, 1, 2, 5, 40))):
        at, to = dice.randrange(len(rows)), dice.randrange(len(rows))
        how = dice.randrange(8)
        name, time, pid, tid, values = rows[at]
        if how == 0:
            del rows[at]
        elif how == 1:
            rows.insert(to, rows[at])
        elif how == 2:
            rows[at], rows[to] = rows[to], rows[at]
        elif how == 3:
            rows[at] = (name, max(0, dice.choice(NUMBERS)), pid, tid, values)
        elif how == 4:
            name = dice.choice(list(EVENTS))
            values = [lie(kind, dice) for _, kind in EVENTS[name].fields]
            rows.insert(at, (name, time, dice.choice((pid, 0, -1)), tid, values))
        elif EVENTS[name].fields:
            place, values = dice.randrange(len(values)), [*values]
            # what it cannot say, or what another event of the kind says there
            values[place] = lie(EVENTS[name].fields[place][1], dice) if how < 7 else \
                dice.choice([row[4][place] for row in rows if row[0] == name])
            rows[at] = (name, time, pid, tid, values)
    return rows


def lie(kind, dice):
    """Return a value of an unexpected type."""
    if kind == 'string':
        return dice.choice(TEXTS)
    if kind == 'bool':
        return dice.random() < 0.5
    if kind.startswith(('int', 'uint')):
        bits = int(kind.lstrip('uint'))
        low, high = (0, 2**bits - 1) if kind[0] == 'u' else (-2**(bits - 1), 2**(bits - 1) - 1)
        return min(high, max(low, dice.choice(NUMBERS)))
    assert FieldType.parse(kind) and kind.startswith('float'), kind
    return dice.choice((0.0, float('nan'), float('inf'), -1e308))


def give(rows, seed):
    """Give a trace to all verbs; return how many used it."""
    used = 0
    with TraceFile('run.mcap') as file:
        for name, time, pid, tid, values in rows:
            file.add(name, time, pid, tid, *values)
    for verb in VERBS:
        used += run(*verb, about=f'seed {seed}')[0] != 2
    return used


@pytest.mark.filterwarnings('ignore')
@pytest.mark.parametrize('batch', range(BATCHES))
def test_events_that_lie(runs, batch):
    used = 0
    first = batch * EXAMPLES // BATCHES
    last = (batch + 1) * EXAMPLES // BATCHES
    for seed in range(first, last):
        with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as here:
            here.chdir(folder)
            used += give(changed(runs[seed % 8 == 0], random.Random(seed)), seed)
    # Most lies leave a run that can be judged.
    assert used > (last - first) * len(VERBS) // 3


@pytest.mark.parametrize('period', [2**63 - 1, 86_400_000_000_001, 999, 0, -1, -2**63])
def test_a_timer_that_no_declaration_could_have(runs, tmp_path, monkeypatch, period):
    """Such a period becomes a blank to fill in (seeds 872 and 1152 found a traceback)."""
    monkeypatch.chdir(tmp_path)
    lying = [(name, time, pid, tid, [values[0], period] if name == 'ros2:rcl_timer_init'
              else values) for name, time, pid, tid, values in runs[1]
             if not name.startswith('mddag:')]
    assert give(lying, 0) > 0
    assert str(period) not in Path('graph.yaml').read_text().split('FILL IN')[0]
