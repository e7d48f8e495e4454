# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The guards in conftest.py do guard: each is tried on a small test suite of its own."""

from __future__ import annotations

import os
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

HERE = Path(__file__).resolve().parent


@pytest.fixture
def suite(tmp_path: Path) -> Path:
    shutil.copy(HERE / 'conftest.py', tmp_path)
    (tmp_path / 'pytest.ini').write_text(
        '[pytest]\naddopts = --import-mode=importlib -p no:cacheprovider\nmarkers = slow\n')
    return tmp_path


def run(suite: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    # This session may be a part of one that runs side by side.
    env = {k: v for k, v in os.environ.items() if not k.startswith('PYTEST_XDIST')}
    return subprocess.run([sys.executable, '-m', 'pytest', *arguments], cwd=suite, text=True,
                          env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False)


def test_a_thread_that_stays_is_found(suite: Path) -> None:
    (suite / 'test_it.py').write_text(
        'import threading, time\n'
        'def test_stays(no_thread_leak):\n'
        '    threading.Thread(target=time.sleep, args=(20,), daemon=True, name="stayer").start()\n'
        'def test_ends(no_thread_leak):\n'
        '    threading.Thread(target=time.sleep, args=(0.3,)).start()\n')
    result = run(suite)
    assert '2 passed, 1 error' in result.stdout
    assert 'threads left behind' in result.stdout and 'stayer' in result.stdout


def test_an_exception_in_a_thread_fails_the_test(suite: Path) -> None:
    (suite / 'pytest.ini').unlink()
    shutil.copy(HERE.parent / 'pyproject.toml', suite)
    (suite / 'test').mkdir()
    (suite / 'test' / 'test_it.py').write_text(
        'import threading\n'
        'def test_raises():\n'
        '    thread = threading.Thread(target=lambda: 1 / 0)\n'
        '    thread.start()\n'
        '    thread.join()\n')
    result = run(suite)
    assert result.returncode == 1
    assert 'ZeroDivisionError' in result.stdout


def test_fast_ones_come_first(suite: Path) -> None:
    for name in ('live', 'core', 'msg_graph'):
        (suite / name).mkdir()
        (suite / name / 'test_it.py').write_text(
            'import pytest\n'
            '@pytest.mark.slow\n'
            f'def test_slow_{name}(): pass\n'
            f'def test_{name}(): pass\n')
    (suite / 'test_top.py').write_text('def test_top(): pass\n')
    result = run(suite, '--collect-only', '-q')
    names = [line.split('::')[1] for line in result.stdout.splitlines() if '::' in line]
    assert names == ['test_msg_graph', 'test_core', 'test_top', 'test_live',
                     'test_slow_msg_graph', 'test_slow_core', 'test_slow_live']


def test_sessions_have_domains_of_their_own(suite: Path) -> None:
    (suite / 'test_it.py').write_text(
        'import os, time\n'
        'def test_domain():\n'
        '    assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"\n'
        '    print("domain", os.environ["ROS_DOMAIN_ID"])\n'
        '    time.sleep(1)\n')
    sessions = [subprocess.Popen([sys.executable, '-m', 'pytest', '-s'], cwd=suite, text=True,
                                 stdout=subprocess.PIPE) for _ in range(2)]
    domains = set()
    for session in sessions:
        out, _ = session.communicate(timeout=60)
        assert session.returncode == 0, out
        domains |= {line for line in out.splitlines() if 'domain ' in line}
    assert len(domains) == 2


def test_a_context_is_shut_down(suite: Path) -> None:
    (suite / 'test_it.py').write_text(
        'kept = []\n'
        'def test_use(ros_context):\n'
        '    kept.append(ros_context)\n'
        '    assert ros_context.ok()\n'
        'def test_after():\n'
        '    assert not kept[0].ok()\n')
    result = run(suite)
    assert '2 passed' in result.stdout, result.stdout
