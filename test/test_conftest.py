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
    (tmp_path / '.ci').mkdir()
    (tmp_path / '.ci' / 'tools').write_text("echo 'zither libzither zither-strings'\n")
    (tmp_path / 'test').mkdir()
    shutil.copy(HERE / 'conftest.py', tmp_path / 'test')
    (tmp_path / 'test' / 'pytest.ini').write_text(
        '[pytest]\naddopts = --import-mode=importlib -p no:cacheprovider\nmarkers =\n'
        ' slow\n needs\n')
    return tmp_path / 'test'


def run(suite: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    # This session may be a part of one that runs side by side, or in continuous integration.
    env = {k: v for k, v in os.environ.items() if not k.startswith(('PYTEST_XDIST', 'CI'))}
    return subprocess.run([sys.executable, '-m', 'pytest', *arguments], cwd=suite, text=True,
                          env={**env, **variables}, stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT, check=False)


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
    shutil.copy(HERE.parent / 'pyproject.toml', suite.parent)
    (suite / 'test_it.py').write_text(
        'import threading\n'
        'def test_raises():\n'
        '    thread = threading.Thread(target=lambda: 1 / 0)\n'
        '    thread.start()\n'
        '    thread.join()\n')
    result = run(suite)
    assert result.returncode == 1
    assert 'ZeroDivisionError' in result.stdout


@pytest.mark.parametrize('options', [(), ('-n', '1')], ids=['', 'xdist'])
def test_what_is_left_behind_is_found(suite: Path, options: tuple[str, ...]) -> None:
    (suite / 'test_it.py').write_text(
        'import subprocess, sys, tempfile\n'
        'STAYS = "import time; print(flush=True); time.sleep(123)"\n'
        'def test_leaves(tmp_path):\n'
        '    open(tempfile.gettempdir() + "/forgotten", "w").close()\n'
        '    child = subprocess.Popen([sys.executable, "-c", STAYS], stdout=-1)\n'
        '    child.stdout.readline()\n')
    place = suite / 'tmp'
    place.mkdir()
    result = run(suite, *options, TMPDIR=str(place))
    assert '1 passed, 1 error' in result.stdout
    assert 'time.sleep(123)' in result.stdout and "'forgotten'" in result.stdout
    assert [*place.iterdir()] == []


def test_what_was_not_tested_is_the_last_line(suite: Path) -> None:
    (suite / 'test_it.py').write_text(
        'import pytest\n'
        '@pytest.mark.needs("zither")\n'
        '@pytest.mark.parametrize("string", range(4))\n'
        'def test_tune(string): raise NotImplementedError\n'
        '@pytest.mark.needs("dulcimer")\n'
        'def test_other(): pass\n'
        'def test_import(): pytest.importorskip("dulcimer")\n')
    result = run(suite, '-n', '1')
    assert result.returncode == 0 and '1 passed, 5 skipped' in result.stdout
    assert result.stdout.splitlines()[-1] == (
        'not tested: what zither is needed for (4 tests): '
        'sudo apt install libzither zither-strings')
    result = run(suite, '-n', '1', CI='true')
    assert '1 failed, 1 passed, 4 errors' in result.stdout, result.stdout
    assert 'not tested' not in result.stdout


# --- .ci/tools -----------------------------------------------------------------------------------

@pytest.fixture
def tools(tmp_path: Path) -> Path:
    """Give a folder of programs that are all that `.ci/tools` finds."""
    for name in ('cut', 'env', 'grep', 'tail', 'xargs', 'echo'):
        (tmp_path / name).symlink_to(shutil.which(name) or name)
    for name, text in {
        'python3': 'exit 1',
        'id': 'echo 1000',
        'sudo': 'shift; "$@"',
        'chromedriver': '',
        'google-chrome': '',
    }.items():
        program(tmp_path / name, text)
    return tmp_path


def program(path: Path, text: str) -> None:
    path.write_text(f'#!/bin/sh\n{text}\n')
    path.chmod(0o755)


def install(tools: Path) -> str:
    done = subprocess.run(
        ['/bin/sh', str(HERE.parent / '.ci' / 'tools'), 'install'], env={'PATH': str(tools)},
        text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False)
    assert done.returncode == 0, done.stdout
    return done.stdout


def test_missing_programs_are_installed(tools: Path) -> None:
    log = tools / 'log'
    program(tools / 'apt-get', f'echo "$@" >>{log}; [ -e {tools}/lists ] || '
            f'case "$*" in *update) echo >{tools}/lists;; *) echo E: none; exit 100;; esac')
    said = install(tools)
    assert said.startswith('installing for the tests: ') and said.count('\n') == 1
    assert 'chromium' not in said and said.endswith(' graphviz\n')
    calls = [line.split('-o')[-1].split(maxsplit=1)[1] for line in log.read_text().splitlines()]
    assert calls.count('update') == 1 and calls[-1].endswith(' graphviz')


def test_what_cannot_be_installed_is_one_line(tools: Path) -> None:
    program(tools / 'apt-get', 'echo W: no network; echo E: no such thing; exit 100')
    said = install(tools)
    assert said.count('\n') == 2
    assert said.endswith(' graphviz (E: no such thing): the tests go on without\n')


@pytest.mark.parametrize('name', ['sudo', 'apt-get'])
def test_nothing_is_installed_where_it_may_not(tools: Path, name: str) -> None:
    program(tools / 'apt-get', 'exit 100')
    program(tools / 'sudo', 'exit 1')
    (tools / name).unlink()
    assert install(tools) == ''


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
