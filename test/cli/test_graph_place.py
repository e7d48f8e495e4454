# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph place`."""

from __future__ import annotations

from collections.abc import Callable
import json
from pathlib import Path
import subprocess

import pytest

Mddag = Callable[..., subprocess.CompletedProcess[str]]
GRAPH = """\
mddag: 1  # the robot
nodes:
  - node: /a
    callbacks: [{name: t, timer: 100ms, deadline: 40ms, execution_time: 30ms}]
  - node: /b
    callbacks: [{name: t, timer: 100ms, deadline: 40ms, execution_time: 30ms}]
  - node: /c
    callbacks: [{name: t, timer: 100ms, deadline: 100ms, execution_time: 10ms}]
"""


def test_times_of_a_recorded_run(graph: Path, call: Mddag) -> None:
    Path('times.json').write_text(json.dumps(
        {f'/{n}': {f'/{n}:t': us} for n, us in (('a', 45_000), ('b', 5_000), ('c', 40_000))}))
    recorded = call('simulate', 'graph.yaml', '--execution-times', 'times.json', '--trace',
                    'run.mcap', '--duration', '1s')
    assert recorded.returncode == 0, recorded.stderr
    run = call('graph', 'place', 'graph.yaml', '--processes', '2', '--trace', 'run.mcap',
               '-o', 'placed.yaml', '--json', 'out.json')
    assert run.returncode == 0, run.stderr
    result = json.loads(Path('out.json').read_text())
    assert sorted(result['loads']) == pytest.approx([0.45, 0.45], abs=0.01)
