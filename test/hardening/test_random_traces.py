# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Traces that are sound as files and say anything: every verb uses or refuses them, no traceback.

The events are those of `test/sources/test_fuzz.py`: left out, doubled, in other places, with other
values; and some are of another run. One trace in eight is made of a recorded run, the others of a
small simulated one. `HARDENING_EXAMPLES=10000` tries that many.
"""

import os
from pathlib import Path
import random
import tempfile

from mddag_executor.cli import main as program
from mddag_executor.trace import read_events, TraceFile
from mddag_executor.trace.schema import EVENTS
import pytest

from ..sources.helpers import PATHS, SMALL
from ..sources.lies import tell_lies
from .verbs import run

EXAMPLES = int(os.environ.get('HARDENING_EXAMPLES', '32'))
BATCHES = 2
BAG = Path(__file__).resolve().parents[2] / 'bags' / 'demo_short.mcap'
VERBS = (
    ('replay', 'run.mcap'), ('replay', 'run.mcap', '--json', '-'),
    ('replay', 'run.mcap', '--reschedule', '--workers', '2'),
    ('replay', 'run.mcap', '--reschedule', '--policy', 'ros2'),
    ('diff', 'run.mcap', 'run.mcap'), ('export', 'run.mcap', '-o', 'out.csv'),
    ('graph', 'from-trace', 'run.mcap', '-o', 'graph.yaml'),
)


@pytest.fixture(scope='module')
def runs(tmp_path_factory):
    """Give the events of a small run and the first ones of a recorded run, entities and all."""
    folder = tmp_path_factory.mktemp('run')
    (folder / 'graph.yaml').write_text(
        SMALL.replace('timer: 10ms', 'timer: 10ms, on_late: demote') + PATHS)
    assert program.main(('simulate', str(folder / 'graph.yaml'), '--duration', '60ms', '--workers',
                         '1', '--trace', str(folder / 'run.mcap'))) == 0
    return [events_of(folder / 'run.mcap', 10_000), events_of(BAG, 150)]


def events_of(path, most):
    """Return the events of a trace, up to so many that jobs consist of."""
    found, at_work = [], 0
    for event in read_events(path):
        kind = EVENTS[event['_name']]
        names = tuple(name for name, _ in kind.fields)
        at_work += kind.name in ('dispatch', 'job_release', 'complete', 'rclcpp_publish')
        found.append(((event['_name'], names), event['_timestamp'], event['_vpid'], event['_vtid'],
                      *(event.get(name, 0) for name in names)))
        if at_work > most:
            break
    return found


def used(seed):
    """Give run.mcap to all verbs; return how many used it."""
    return sum(run(*verb, about=f'seed {seed}')[0] != 2 for verb in VERBS)


@pytest.mark.filterwarnings('ignore')
@pytest.mark.parametrize('batch', range(BATCHES))
def test_events_that_lie(runs, batch):
    count = 0
    seeds = range(batch * EXAMPLES // BATCHES, (batch + 1) * EXAMPLES // BATCHES)
    for seed in seeds:
        rng, events = random.Random(seed), [*runs[seed % 8 == 0]]
        for _ in range(rng.choice((0, 0, 1, 5))):
            events.insert(rng.randrange(len(events)), rng.choice(runs[0] + runs[1]))
        with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as here:
            here.chdir(folder)
            tell_lies(events, 'run.mcap', rng)
            count += used(seed)
    # Most lies leave a run that can be judged.
    assert count > len(seeds) * len(VERBS) // 3


@pytest.mark.parametrize('period', [2**63 - 1, 86_400_000_000_001, 999, 0, -1, -2**63])
def test_a_timer_that_no_declaration_could_have(runs, tmp_path, monkeypatch, period):
    """Such a period becomes a blank to fill in (a traceback before)."""
    monkeypatch.chdir(tmp_path)
    with TraceFile('run.mcap') as file:
        for (name, _), time, pid, tid, *values in runs[1]:
            if name == 'ros2:rcl_timer_init':
                values[1] = period
            if not name.startswith('mddag:'):
                file.add(name, time, pid, tid, *values)
    assert used(period) > 0
    assert str(period) not in Path('graph.yaml').read_text().split('FILL IN')[0]
