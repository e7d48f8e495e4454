# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The sample traces in `bags/` and results that have been the same since version 1.0.0.

But since 2.0.0 the first miss is that of the earliest deadline, some counts are new, and
undeclared callbacks have no overheads either.  Since 3.0.0 paths follow messages that arrived
before their callback ended, and an execution that did not complete takes as long as it ran, or
longer.
"""

import json
import os
from pathlib import Path

from mddag_executor import replay, reschedule
from mddag_executor.cli import main as program
from msg_graph import load, loads
import pytest

from ..sources.bags import BY_HEADER, write_bag
from ..sources.helpers import Chances, MS, PATHS, SMALL, VirtualRun
from ..sources.recorded import CAMERA, four_jobs

TOP = Path(__file__).resolve().parent.parent.parent
DEMO = TOP / 'bags' / 'demo_short.mcap'


def test_the_demo_under_the_shipped_declarations():
    """The declarations may change; as long as they have these callbacks they can judge."""
    def counted(*task_set):
        return {name: (dag['jobs'], [sink['completed'] for sink in dag['sinks'].values()])
                for name, dag in replay(DEMO, *task_set).result()['dags'].items()}

    recorded = counted()
    for name in ('autoware.yaml', 'autoware_multi.yaml'):
        assert counted(load(TOP / 'config' / name)) == recorded


def test_the_demo_rescheduled():
    """As recorded one job was late, for overheads; four workers would not have been enough."""
    same = reschedule(DEMO)
    assert same.tally.first_miss['vertex'].endswith('twist2accel:callback_0')
    assert sum(sink.verdicts()['late'] for sink in same.tally.sinks.values()) == 1
    assert not reschedule(DEMO, overheads=False).tally.missed
    assert reschedule(DEMO, workers=4).tally.missed


EXPECTED = Path(__file__).with_name('expected')
IMPORTED = CAMERA + """\
paths:
  - {name: p, callbacks: ['/camera:grab', '/detect:run']}
"""
RESCHEDULED = '--reschedule --workers 1 --policy fifo --overheads none --from 50ms'


@pytest.fixture(autouse=True)
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path('demo.mcap').symlink_to(DEMO)
    Path('four.yaml').write_text(IMPORTED)
    four_jobs(Path('four.mcap'))
    for seed, workers, policy in ((1, 2, 'fifo'), (7, 4, 'fifo')):
        VirtualRun(Path(f'v{seed}.mcap'), loads(SMALL + PATHS, 'g.yaml'), seed, workers=workers,
                   policy=policy, duration=(400 + 100 * seed) * MS, longest=(3 + 2 * seed) * MS,
                   chances=Chances(undeclared=1))
    Path('other0.yaml').write_text(SMALL.replace('deadline: 18ms', 'deadline: 9ms') + PATHS)
    Path('bagh.yaml').write_text(BY_HEADER)
    write_bag(Path('bag_mcap'))


@pytest.mark.parametrize(('name', 'arguments'), [
    ('demo_short', 'demo.mcap'), ('demo_short_rescheduled', f'demo.mcap {RESCHEDULED}'),
    ('imported', 'four.mcap four.yaml --callbacks'), ('virtual_run', 'v1.mcap'),
    ('virtual_run_rescheduled', f'v1.mcap {RESCHEDULED}'),
    ('virtual_run_other_declaration', 'v7.mcap other0.yaml'),
    ('ordinary_bag', 'bag_mcap bagh.yaml --reschedule --workers 1 --policy rm --preemptive '
     '--overheads 1ms --from 200ms')])
def test_the_result_is_that_of_version_1(name, arguments):
    assert program.main(['replay', *arguments.split(), '--json', 'found.json']) == 0
    found = json.loads(Path('found.json').read_text())
    assert found.pop('mddag')
    path = EXPECTED / f'{name}.json'
    if os.environ.get('UPDATE_GOLDEN'):
        path.write_text(json.dumps(found) + '\n')
    assert found == json.loads(path.read_text())
