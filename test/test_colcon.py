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
    # What is there goes to every user's screen.
    assert [line for line in done.stderr.splitlines()
            if 'previously-included' in line or 'deprecated' in line.lower()] == []
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
    program = installed / 'lib' / NAME / 'mddag'  # where `ros2 run` looks
    done = in_workspace(workspace, f'"{program}" --version')
    assert (done.returncode, done.stdout[:6]) == (0, 'mddag '), done.stderr
    done = in_workspace(workspace, 'mddag --version && command -v mddag')
    assert done.stdout.splitlines()[1:] == [str(installed / 'bin' / 'mddag')], done.stderr
    done = in_workspace(
        workspace, f'"{sys.executable}" -c "import {NAME}; print({NAME}.__file__)"')
    assert done.stdout.startswith(str(installed))
    done = in_workspace(workspace, f'"{program}" graph check "{installed}/share/{NAME}/config/'
                                   'autoware.yaml"')
    assert done.returncode == 0 and 'perception' in done.stdout


def test_what_others_look_up_is_installed(workspace: Path):
    share = workspace / 'install' / NAME / 'share'
    assert (share / 'ament_index/resource_index/packages' / NAME).is_file()
    for name in ('package.xml', 'launch/autoware_demo.launch.py', 'config/autoware.yaml'):
        assert (share / NAME / name).is_file()


@needs_ros2
def test_ros2_finds_and_runs_it(workspace: Path, tmp_path: Path):
    def said(command: str) -> str:
        done = in_workspace(workspace, command, tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    assert said(f'ros2 pkg executables {NAME}') == f'{NAME} mddag\n'
    assert said(f'ros2 pkg prefix --share {NAME}').startswith(str(workspace / 'install'))
    assert said(f'ros2 run {NAME} mddag --version').startswith('mddag ')
    assert said('ros2 mddag --version').startswith('mddag ')
    assert NAME not in said('ros2 --help') and ' mddag ' in said('ros2 --help')
    launch = f'ros2 launch {NAME} autoware_demo.launch.py'
    assert "'utilisation':" in said(f'{launch} --show-args')
    text = said(f'{launch} duration:=1s utilisation:=0.2 trace:=out.mcap')
    assert 'sink jobs due' in text and 'process has finished cleanly' in text
    assert said(f'ros2 run {NAME} mddag replay out.mcap')


@needs_ros2
def test_ctrl_c_ends_ros2_launch_and_what_it_started(workspace: Path, tmp_path: Path):
    # To all processes, as a terminal does; reading from none, `ros2 launch` sends one more.
    done = in_workspace(
        workspace, f'timeout --kill-after=20 -s INT 5 ros2 launch {NAME} autoware_demo.launch.py '
        'utilisation:=0.2 trace:=out.mcap', tmp_path)
    assert 'sink jobs due' in done.stdout and 'process has finished cleanly' in done.stdout
    assert 'Traceback' not in done.stdout + done.stderr
    replayed = in_workspace(workspace, f'ros2 run {NAME} mddag replay out.mcap', tmp_path)
    assert (replayed.returncode, replayed.stderr) == (0, '')


def test_colcon_test_runs_the_tests(workspace: Path):
    done = colcon(
        workspace, 'test', '--packages-select', NAME, '--return-code-on-test-failure',
        '--pytest-args', 'test/msg_graph/test_duration.py', 'test/executor/test_names.py')
    assert done.returncode == 0, done.stdout + done.stderr
    done = colcon(workspace, 'test-result', '--all')
    assert done.returncode == 0 and '0 errors, 0 failures' in done.stdout
    assert int(done.stdout.split('Summary: ')[1].split()[0]) > 10
