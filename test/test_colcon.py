# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The package in a colcon workspace: built, tested and used from there.

Without an installation of ROS, the rclpy that colcon's packages find is that of the package index.
"""

import contextlib
from importlib.util import find_spec
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import time
import warnings

from mddag_executor.trace import read_events
from mddag_executor.trace.errors import TraceError, TraceWarning
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
def workspace(tmp_path_factory):
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


def colcon(place, *arguments):
    return subprocess.run(
        [sys.executable, '-c', COLCON, *arguments], cwd=place, capture_output=True, text=True,
        timeout=170, check=False, stdin=subprocess.DEVNULL)


def in_workspace(place, command, folder=Path('/')):
    """Run a command in a shell that has sourced the workspace."""
    return subprocess.run(
        ['bash', '-c', f'. "{place}/install/setup.bash" && cd "{folder}" && {command}'],
        capture_output=True, text=True, timeout=60, check=False, stdin=subprocess.DEVNULL,
        env={**os.environ, 'COLCON_TRACE': '', 'PYTHON': sys.executable})


def test_what_was_built_is_what_runs(workspace):
    installed = workspace / 'install' / NAME
    share = installed / 'share'
    for name in (f'ament_index/resource_index/packages/{NAME}', f'{NAME}/package.xml',
                 f'{NAME}/launch/run.launch.py'):
        assert (share / name).is_file()
    done = in_workspace(
        workspace, f'"{sys.executable}" -c "import {NAME}; print({NAME}.__file__)" && '
        'mddag --version && command -v mddag && '       # and where `ros2 run` looks:
        f'"{installed}/lib/{NAME}/mddag" graph check "{share}/{NAME}/config/autoware.yaml"')
    assert done.returncode == 0 and 'perception' in done.stdout, done.stderr
    assert done.stdout.startswith(str(installed))
    assert f'\n{installed / "bin" / "mddag"}\n' in done.stdout


@needs_ros2
def test_ros2_finds_and_runs_it(workspace, tmp_path):
    done = in_workspace(
        workspace, f'ros2 run {NAME} mddag --version && ros2 mddag --version && ros2 --help && '
        f'ros2 launch {NAME} run.launch.py --show-args', tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(re.findall(r'^mddag \d', done.stdout, re.M)) == 2 and '\n  mddag ' in done.stdout
    assert "'ros_args':" in done.stdout
    line = 'ros2 mddag graph from-tr'
    assert in_workspace(
        workspace, f"_ARGCOMPLETE=1 _ARGCOMPLETE_STDOUT_FILENAME=out COMP_LINE='{line}' "
        f'COMP_POINT={len(line)} ros2; cat out', tmp_path).stdout.strip() == 'from-trace'


GRAPH = """
mddag: 1
nodes:
  - node: /n
    callbacks: [{name: tick, timer: 20ms, deadline: DEADLINE, execution_time: 5ms}]
"""


@needs_ros2
@pytest.mark.parametrize(('deadline', 'status'), [
    ('20s, tolerate: 999 of 1000', 0), ('1ms', 1)])
def test_ros2_launch_ends_with_the_verdict(workspace, tmp_path, deadline, status):
    (tmp_path / 'graph.yaml').write_text(GRAPH.replace('DEADLINE', deadline))
    done = in_workspace(
        workspace, f'ros2 launch {NAME} run.launch.py graph:=graph.yaml synthetic:=sleep '
        'duration:=500ms trace:=out.mcap fail_on_miss:=true', tmp_path)
    said = done.stdout + done.stderr
    assert done.returncode == status and 'results due' in said, said
    assert ('process has finished cleanly' in said) == (status == 0)
    assert ('mddag run ended with status 1' in said) == (status == 1)
    replayed = in_workspace(workspace, 'ros2 mddag replay out.mcap --fail-on-miss', tmp_path)
    assert (replayed.returncode, replayed.stderr) == (status, '')


@needs_ros2
def test_bad_input_ends_ros2_launch(workspace, tmp_path):
    for arguments, says in (('graph:=none.yaml nodes:=a/b', 'error: none.yaml: '),
                            ('nodes:="\'a/b"', 'No closing quotation'),
                            ('graph:=x.yaml', 'required')):
        done = in_workspace(workspace, f'ros2 launch {NAME} run.launch.py {arguments}', tmp_path)
        assert done.returncode == 1 and says in done.stdout + done.stderr


def has_run(trace):
    """Return whether a callback has run, by the trace of a run that goes on."""
    with contextlib.suppress(TraceError), warnings.catch_warnings():
        warnings.simplefilter('ignore', TraceWarning)  # that it has no end
        return any(event['_name'] == 'ros2:callback_end' for event in read_events(trace))
    return False    # it is not there yet


@needs_ros2
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('to_all', [True, False])
def test_a_signal_ends_ros2_launch_and_the_run(workspace, tmp_path, number, to_all):
    """As a terminal or systemd sends it, or to `ros2 launch` only."""
    (tmp_path / 'graph.yaml').write_text(GRAPH.replace('DEADLINE', '20s'))
    command = (f'. "{workspace}/install/setup.bash" && exec ros2 launch {NAME} run.launch.py '
               'graph:=graph.yaml synthetic:=sleep trace:=out.mcap')
    with subprocess.Popen(
            ['bash', '-c', command], cwd=tmp_path, text=True, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, start_new_session=True,
            env={**os.environ, 'COLCON_TRACE': '', 'PYTHONUNBUFFERED': '1'}) as process:
        pid = int(re.search(r'process started with pid \[(\d+)\]', next(
            line for line in process.stdout if 'process started' in line))[1])
        while not has_run(tmp_path / 'out.mcap'):
            time.sleep(0.1)
        if to_all:
            os.killpg(process.pid, number)
        else:
            process.send_signal(number)
        said = process.stdout.read()    # to its end: the run has it as well
    while Path(f'/proc/{pid}').exists():
        time.sleep(0.05)
    if number == signal.SIGINT:
        assert 'results due' in said and 'process has finished cleanly' in said
    assert 'Traceback' not in said.replace('see debug for traceback', '')
    replayed = in_workspace(workspace, 'ros2 mddag replay out.mcap', tmp_path)
    assert (replayed.returncode, replayed.stderr) == (0, ''), replayed.stdout


def test_colcon_test_runs_the_tests(workspace):
    done = colcon(
        workspace, 'test', '--packages-select', NAME, '--return-code-on-test-failure',
        '--pytest-args', 'test/msg_graph/test_model.py')
    assert done.returncode == 0, done.stdout + done.stderr
    done = colcon(workspace, 'test-result', '--all')
    assert done.returncode == 0 and '0 errors, 0 failures' in done.stdout
    assert int(done.stdout.split('Summary: ')[1].split()[0]) > 10
