# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Nodes of packages that others have published, as they are: fetched from the package index.

Left out where that cannot be reached.
"""

from __future__ import annotations

from pathlib import Path
import subprocess
import sys

from mddag_executor.rerun import rerun
import pytest
from std_msgs.msg import String

from .helpers import MS, START, write_bag

PACKAGES = ('akpub==0.1.0', 'aksub==0.1.1')
THIRD_PARTY = Path(__file__).resolve().parents[2] / 'examples' / 'third_party'
GRAPH = """\
mddag: 1
nodes:
  - node: /num_publisher
    callbacks:
      - {name: tick, timer: 1s, publishes: [/number], execution_time: 1ms, deadline: 50ms}
  - node: /somebody
    callbacks:
      - {name: talk, timer: 100ms, publishes: [/chatter], dag: talk}
  - node: /generic_subscriber
    callbacks:
      - {name: heard, subscription: /chatter, execution_time: 1ms, deadline: 50ms}
  - node: /listener
    callbacks:
      - {name: heard, subscription: /chatter, execution_time: 1ms, deadline: 50ms}
"""


@pytest.fixture(scope='module')
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the packages."""
    folder = tmp_path_factory.mktemp('packages')
    try:
        done = subprocess.run(
            [sys.executable, '-m', 'pip', 'install', '--quiet', '--no-deps', '--retries', '1',
             '--timeout', '10', '--target', str(folder), *PACKAGES],
            capture_output=True, text=True, check=False, timeout=90)
    except subprocess.TimeoutExpired:
        pytest.skip('the package index does not answer')
    if done.returncode != 0:
        pytest.skip(f'the package index cannot be reached: {done.stderr[-200:]}')
    return folder


@pytest.mark.slow
def test_three_public_nodes(
    packages: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.syspath_prepend(str(packages))
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(THIRD_PARTY / 'install'))
    bag = write_bag(tmp_path / 'in.mcap', [
        (i * 100 * MS, '/chatter', String(data=f'hello {i}')) for i in range(60)])
    graph = tmp_path / 'graph.yaml'
    graph.write_text(GRAPH)
    nodes = ['akpub.publisher:run_publisher', 'aksub.subscriber:main', 'their_robot/listener.py']
    results = [rerun(bag, graph, nodes, all_clocks=True) for _ in range(2)]
    assert results[0].digest == results[1].digest
    assert [(each.time - START) // MS for each in results[0].outputs
            if each.topic == '/number'] == [1001, 2001, 3001, 4001, 5001]
    assert results[0].result()['dags']['talk']['sinks']['/generic_subscriber:heard'][
        'completed'] == 60
    assert capsys.readouterr().out.count('heard 60 messages') == 2
    # What reads the time by ``time.time`` gets virtual time, so that there is nothing to warn of.
    assert not results[0].warnings
