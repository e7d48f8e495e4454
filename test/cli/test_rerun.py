# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0

import json
import os
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

from . import golden

EXAMPLE = Path(__file__).resolve().parents[2] / 'examples' / 'rerun'
THIRD_PARTY = EXAMPLE.parent / 'third_party'
NODES = ('--node', 'robot:Tracker', '--node', 'robot:Brake')
RERUN = ('rerun', 'drive.mcap', 'graph.yaml', *NODES)


@pytest.fixture(scope='module')
def drive(tmp_path_factory):
    """Return a folder with the example, and a drive of 5 s."""
    folder = tmp_path_factory.mktemp('rerun')
    for name in ('graph.yaml', 'robot.py'):
        shutil.copy(EXAMPLE / name, folder)
    run_in(folder, 'simulate', 'graph.yaml', '--duration', '5s', '--trace', 'releases.mcap')
    run_in(folder, 'rerun', 'releases.mcap', 'graph.yaml', '--node', 'robot:Lidar', '-o',
          'drive.mcap')
    return folder


def run_in(folder, *args, status=0, python=('-m', 'mddag_executor'), **more):
    """Run `mddag` in a folder, as a user would who has fixed the hashes: else it starts twice."""
    done = subprocess.run(
        [sys.executable, *python, *args], cwd=folder, capture_output=True, text=True,
        check=False, timeout=120, env={'PYTHONHASHSEED': '0', **os.environ, **more})
    assert done.returncode == status, done.stderr
    return done


def digest(folder, *args, **more):
    return json.loads(run_in(folder, *args, '--json', '-', **more).stdout)['digest']


def test_a_run_and_its_result(drive, tmp_path):
    done = run_in(drive, *RERUN, '-o', 'out.mcap', '--trace', 'run.mcap', '--json', 'result.json')
    golden.compare('rerun', done.stdout)
    result = json.loads((drive / 'result.json').read_text())
    assert result['topics'] == {'/brake': 50, '/parameter_events': 4, '/track': 50}
    assert result['messages'] == 104
    assert (result['callbacks'], result['warnings'], result['recorded']) == (100, [], [])
    assert result['dags']['brake']['sinks']['/brake:decide']['completed'] == 50
    replayed = run_in(drive, 'replay', 'run.mcap', '--json', '-')
    sinks = json.loads(replayed.stdout)['dags']['brake']['sinks']
    assert sinks['/brake:decide']['response_ns']['max'] == 9_000_000
    # The same again, and with another gain.
    expect = (*RERUN, '--expect', 'out.mcap')
    assert 'the same as out.mcap' in run_in(drive, *expect).stdout
    for name in ('graph.yaml', 'robot.py', 'drive.mcap', 'out.mcap'):
        shutil.copy(drive / name, tmp_path)
    text = (tmp_path / 'robot.py').read_text()
    (tmp_path / 'robot.py').write_text(text.replace('GAIN = 0.3', 'GAIN = 0.3001'))
    assert run_in(tmp_path, *expect, status=1).stdout.splitlines()[-1].startswith(
        '/track: content, first in message 1 at 0.110000 s: data is ')
    difference, = json.loads(
        run_in(tmp_path, *expect, '--json', '-', status=1).stdout)['differences']
    assert (difference['topic'], difference['field'], difference['number']) == (
        '/track', 'data', 1)
    run_in(tmp_path, *expect, '--allow-difference', '1%')


@pytest.mark.slow
def test_the_same_each_time_also_next_to_busy_processes(drive):
    """Also where seven workers are too few, and with other hashes of strings."""
    text = (drive / 'graph.yaml').read_text()
    (drive / 'overload.yaml').write_text(
        text.replace('execution_time: 8ms', 'execution_time: 130ms'))
    busy = [subprocess.Popen([sys.executable, '-c', 'while True: pass']) for _ in range(2)]
    overload = ('rerun', 'drive.mcap', 'overload.yaml', *NODES, '--workers', '7')
    try:
        found = {digest(drive, *overload, PYTHONHASHSEED=str(i)) for i in range(2)}
    finally:
        for each in busy:
            each.kill()
            each.wait()
    found.add(digest(drive, *overload))
    assert len(found) == 1


def test_unmodified_programs(drive, tmp_path):
    """A talker, and a listener with an executor of its own, started as ros2 run does."""
    graph = str(THIRD_PARTY / 'graph.yaml')
    prefix = str(THIRD_PARTY / 'install')
    args = ('rerun', str(drive / 'drive.mcap'), graph, '--node', 'their_robot/talker.py',
            '--node', 'their_robot/listener.py')
    first = run_in(tmp_path, *args, '-o', 'chatter.mcap', AMENT_PREFIX_PATH=prefix)
    assert 'heard 49 messages' in first.stdout
    again = run_in(tmp_path, *args, '--expect', 'chatter.mcap', AMENT_PREFIX_PATH=prefix)
    assert 'the same as chatter.mcap' in again.stdout
    # The listener alone: the messages of the talker are in the bag.
    alone = run_in(tmp_path, 'rerun', 'chatter.mcap', graph, '--node', 'their_robot/listener.py',
                  AMENT_PREFIX_PATH=prefix)
    assert 'heard 49 messages' in alone.stdout


HASHES = """\
import rclpy
from std_msgs.msg import Float64, String


def make():
    node = rclpy.create_node('tracker')
    node.create_subscription(Float64, '/distance', lambda message: None, 10)
    node.create_publisher(String, '/hash', 10).publish(String(data=str(hash('tracker'))))
    return node
"""
MADE = ('rerun', 'drive.mcap', 'graph.yaml', '--node', 'hashes:make', '--json', '-')


def test_hashes_are_fixed_however_the_program_is_installed(drive, monkeypatch):
    """`ros2 run` starts PREFIX/lib/PACKAGE/mddag, which colcon has put there."""
    monkeypatch.setenv('PYTHONHASHSEED', 'random')     # as if it were not set
    (drive / 'hashes.py').write_text(HASHES)
    script = drive / 'lib' / 'mddag_executor' / 'mddag'
    script.parent.mkdir(parents=True)
    main = 'import sys\nfrom mddag_executor.cli.main import main\nsys.exit(main())\n'
    script.write_text(main)
    digests = set()
    for python in ((str(script),), (str(script),), ('-m', 'mddag_executor')):
        done = run_in(drive, *MADE, python=python, PYTHONPATH=os.getcwd())
        digests.add(json.loads(done.stdout)['digest'])
        assert not done.stderr
    assert len(digests) == 1
    for python in (('-E', '-m', 'mddag_executor'), ('-c', main)):
        said = run_in(drive, *MADE, python=python).stderr
        assert said.startswith('warning: hashes of strings are not the same in each run: ')
        assert said.count('\n') == 1


@pytest.mark.parametrize(('args', 'message'), [
    (('drive.mcap', 'graph.yaml', '--node', 'robot:Breake'), "did you mean 'Brake'"),
    (('drive.mcap', 'graph.yaml', '--node', 'typo:Brake'),
     "/brake:decide (did you mean the topic '/trak'?)"),
    (('drive.mcap', 'graph.yaml', '--node', 'robot:Brake'),
     '/track, which /brake:decide needs, is not recorded'),
    (('releases.mcap', 'graph.yaml', '--node', 'robot:Tracker'),
     '/distance, which /tracker:track needs, is not recorded'),
])
def test_bad_input_is_one_line(drive, args, message):
    (drive / 'typo.py').write_text((drive / 'robot.py').read_text().replace('/track', '/trak'))
    before = {path.name for path in drive.iterdir()} | {'__pycache__'}
    done = run_in(drive, 'rerun', *args, '-o', 'new.mcap', status=2)
    errors = [line for line in done.stderr.splitlines() if line.startswith('error: ')]
    assert len(errors) == 1 and message in errors[0] and 'Traceback' not in done.stderr, errors
    assert {path.name for path in drive.iterdir()} | {'__pycache__'} == before
