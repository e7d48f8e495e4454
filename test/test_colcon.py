# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The package in a colcon workspace: built, tested and used from there.

Without an installation of ROS, the rclpy that colcon's packages find is that of the package index.
"""

from __future__ import annotations

from importlib.util import find_spec
import os
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

TOP = Path(__file__).resolve().parent.parent
NAME = 'mddag_executor'
COLCON = 'import sys; from colcon_core.command import main; sys.exit(main())'

for name in ('colcon_bash', 'colcon_package_selection', 'colcon_ros', 'colcon_test_result'):
    pytest.importorskip(name, reason='colcon is not installed')
pytestmark = pytest.mark.slow

needs_ros2 = pytest.mark.skipif(
    any(find_spec(name) is None for name in ('ros2cli', 'ros2launch', 'ros2pkg', 'ros2run'))
    or shutil.which('ros2') is None, reason='ros2 is not installed here')


@pytest.fixture(scope='module')
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Give a workspace in which this package has been built."""
    place = tmp_path_factory.mktemp('workspace')
    shutil.copytree(
        TOP, place / 'src' / NAME, ignore=shutil.ignore_patterns(
            '.venv*', '.git', '.*_cache', '.hypothesis', '__pycache__', '*.egg-info', 'build',
            'install', 'log', '*.orig'))
    done = colcon(place, 'build', '--packages-select', NAME)
    assert done.returncode == 0 and f'Finished <<< {NAME}' in done.stdout, done.stderr
    assert 'deprecated' not in done.stderr.lower()  # it goes to every user's screen
    return place


def colcon(place: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, '-c', COLCON, *arguments], cwd=place, capture_output=True, text=True,
        timeout=170, check=False, stdin=subprocess.DEVNULL)


def in_workspace(
    place: Path, command: str, folder: Path = Path('/')
) -> subprocess.CompletedProcess[str]:
    """Run a command in a shell that has sourced the workspace."""
    return subprocess.run(
        ['bash', '-c', f'. "{place}/install/setup.bash" && cd "{folder}" && {command}'],
        capture_output=True, text=True, timeout=60, check=False, stdin=subprocess.DEVNULL,
        env={**os.environ, 'COLCON_TRACE': '', 'PYTHON': sys.executable})


def test_what_was_built_is_what_runs(workspace: Path):
    installed = workspace / 'install' / NAME
    share = installed / 'share'
    assert (share / 'ament_index/resource_index/packages' / NAME).is_file()
    assert (share / NAME / 'package.xml').is_file()
    program = installed / 'lib' / NAME / 'mddag'  # where `ros2 run` looks
    done = in_workspace(
        workspace, f'"{sys.executable}" -c "import {NAME}; print({NAME}.__file__)" && '
        'mddag --version && command -v mddag && '
        f'"{program}" graph check "{share}/{NAME}/config/autoware.yaml"')
    assert done.returncode == 0 and 'perception' in done.stdout, done.stderr
    assert done.stdout.startswith(str(installed))
    assert f'\n{installed / "bin" / "mddag"}\n' in done.stdout


@needs_ros2
def test_ros2_finds_and_runs_it(workspace: Path, tmp_path: Path):
    launch = f'ros2 launch {NAME} autoware_demo.launch.py'
    # To all processes, as a terminal does; reading from none, `ros2 launch` sends one more.
    done = in_workspace(
        workspace, f'ros2 run {NAME} mddag --version && ros2 mddag --version && '
        f'{launch} --show-args && '
        f'timeout --kill-after=20 -s INT 5 {launch} utilisation:=0.2 trace:=out.mcap; '
        f'ros2 run {NAME} mddag replay out.mcap', tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    for text in ('mddag ', "'utilisation':", 'sink jobs due', 'process has finished cleanly'):
        assert text in done.stdout
    assert 'Traceback' not in done.stdout + done.stderr


def test_colcon_test_runs_the_tests(workspace: Path):
    done = colcon(
        workspace, 'test', '--packages-select', NAME, '--return-code-on-test-failure',
        '--pytest-args', 'test/msg_graph/test_duration.py')
    assert done.returncode == 0, done.stdout + done.stderr
    done = colcon(workspace, 'test-result', '--all')
    assert done.returncode == 0 and '0 errors, 0 failures' in done.stdout
    assert int(done.stdout.split('Summary: ')[1].split()[0]) > 10
