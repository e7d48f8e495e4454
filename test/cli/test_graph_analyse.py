# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph analyse`."""

from __future__ import annotations

from collections.abc import Callable
import json
from pathlib import Path
import subprocess

Mddag = Callable[..., subprocess.CompletedProcess[str]]

CONFIG = Path(__file__).resolve().parents[2] / 'config'
GRAPH = """\
mddag: 1
workers: 2
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 10ms, deadline: 5ms, execution_time: {quantiles_us: [1000, 2000, 9000]}}
"""


def test_ci_learns_of_deadlines_that_cannot_hold(call: Mddag) -> None:
    for budget, status in (('mean', 0), ('max', 1)):
        done = call('graph', 'analyse', '-', '--budget', budget, '--fail-on-unschedulable',
                    stdin=GRAPH)
        assert (done.returncode, done.stderr) == (status, '')
        assert ('no scheduler can keep' in done.stdout) == bool(status)


def test_json(call: Mddag) -> None:
    done = call('graph', 'analyse', CONFIG / 'autoware.yaml', '--budget', 'mean', '--workers',
                '5', '--json', '-')
    assert (done.returncode, done.stderr) == (0, '')
    result = json.loads(done.stdout)
    assert (result['workers'], result['budget']) == (5, 'mean')
    assert (round(result['load'], 3), round(result['utilisation'], 3)) == (5.102, 1.02)
    tests = {test['name']: test for test in result['tests']}
    assert len(tests) == 6
    assert 'no execution takes longer' in result['assumptions']
    assert tests['longest path']['verdict'] == 'holds'
    assert tests['utilisation']['verdict'] == 'fails'
    assert {test['verdict'] for test in result['tests'] if test['kind'] == 'sufficient'} == {
        'says nothing'}
    assert all(test['reason'] and test['source'] and test['assumption']
               for test in result['tests'])
