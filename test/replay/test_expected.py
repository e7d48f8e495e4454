# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Results of version 1.0.0, to the last digit.

But for what was mended since: rescheduled, a job whose timer skipped it is skipped again
(``virtual_run_rescheduled``).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mddag_executor.cli import main as program
from mddag_executor.core.tally import total
from msg_graph import loads
import pytest

from .helpers import Chances, MS, PATHS, SMALL, VirtualRun
from .recorded import CAMERA, four_jobs
from .test_ordinary_bags import BY_HEADER, write_bag

BAGS = Path(__file__).resolve().parents[2] / 'bags'
EXPECTED = Path(__file__).with_name('expected')
IMPORTED = CAMERA + """\
paths:
  - {name: p, callbacks: ['/camera:grab', '/detect:run']}
"""
RESCHEDULED = '--reschedule --workers 1 --policy fifo --overheads none --skip 50ms'


@pytest.fixture(autouse=True)
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the recordings that are not in the repository."""
    monkeypatch.chdir(tmp_path)
    Path('demo.mcap').symlink_to(BAGS / 'demo_short.mcap')
    Path('four.yaml').write_text(IMPORTED)
    four_jobs(Path('four.mcap'))
    abort = SMALL.replace('timer: 20ms,', 'timer: 20ms, on_late: abort,') + PATHS
    for seed, workers, policy in ((1, 2, 'fifo'), (7, 4, 'fifo')):
        VirtualRun(Path(f'v{seed}.mcap'), loads(abort, 'g.yaml'), seed, workers=workers,
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
     '--overheads 1ms --skip 200ms')])
def test_the_result_is_that_of_version_1(name: str, arguments: str) -> None:
    assert program.main(['replay', *arguments.split(), '--json', 'found.json']) == 0
    expected = json.loads((EXPECTED / f'{name}.json').read_text())
    found = json.loads(Path('found.json').read_text())
    misses = found.pop('misses', None)      # newer than 1.0.0, as what _without_new removes
    _without_new(found)
    assert found == expected
    if misses is not None:
        assert misses['missed'] == total(found['dags']).missed


def _without_new(found: dict[str, Any]) -> None:
    """Remove what version 1 did not count."""
    for key in ('on_late', 'mddag', 'format'):
        found.pop(key, None)
    recorded = found.get('recorded')
    if recorded is not None and 'dags' in recorded:
        _without_new(recorded)
    for dag in found['dags'].values():
        assert dag['ends'].pop('dropped') == 0
        for sink in dag['sinks'].values():
            assert sink.pop('dropped') == 0
