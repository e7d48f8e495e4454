# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Public programs under rclpy's executor and under this one: what they publish is compared.

    python test/endurance/public_programs.py SOURCES [--seconds 5] [--only NAME]

SOURCES is a folder with the sources of the packages, one folder for each repository.  Programs
are run from there.  What they import beyond that (interfaces, libraries) must be importable
already (``make test-public`` adds ``SOURCES/install``); a program whose imports or sources are
missing is skipped with a line that says so.

Each program runs twice with the same inputs, once with its own executor, once as ``mddag run
--node`` hosts it.  A node of this script counts the messages of every topic for some seconds,
starting with the first message.  The two runs are the same if

* the same topics were published on, with the same types;
* each topic had as many messages, give or take a quarter (a slow machine is no difference);
* the last message of the topics in ``Program.constant`` was the same;
* both ran until SIGINT, or neither, and had the same exit status.  (A signal counts as the status
  that a shell makes of it.  A crash of the middleware at the end of a program by itself, SIGABRT
  or SIGSEGV, is compared with nothing, nor is the error of a program that goes on after rclpy's
  signal handler has shut the context down.)
"""

import argparse
from collections import Counter
from importlib import import_module
import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import time
from typing import Any, NamedTuple

from geometry_msgs.msg import Twist, Vector3
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, qos_profile_sensor_data, QoSProfile
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

TOLERANCE, FEW = 0.25, 3
"""Counts that differ by this part, or by so many messages, are the same."""
START_S, END_S = 10.0, 15.0
"""How long a program may take to publish first, and to end after SIGINT."""

_AFTER_THE_END = ('rcl_shutdown already called', 'context is invalid')
_CRASHES = (128 + signal.SIGABRT, 128 + signal.SIGSEGV)

# for subscriptions of either durability
_KEPT = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)

URDF = """<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="continuous">
<parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint></robot>"""


class Program(NamedTuple):
    """A program to compare."""

    name: str
    spec: str  # its module and function
    folders: tuple[str, ...]  # where its packages are, in the folder of sources
    inputs: tuple[tuple[str, Any], ...] = ()  # messages by topic, published at 20 Hz
    constant: tuple[str, ...] = ()  # the topics whose last message must be the same
    parameters: tuple[str, ...] = ()  # ROS parameters, ``name:=value``


_DEMOS = ('demos/demo_nodes_py',)
_DIAGNOSTICS = ('diagnostics/diagnostic_updater', 'diagnostics/diagnostic_common_diagnostics')
_ROSBRIDGE = ('rosbridge_suite/rosbridge_library/src', 'rosbridge_suite/rosbridge_server/src',
              'rosbridge_suite/rosapi/src')

PROGRAMS = (
    Program('talker', 'demo_nodes_py.topics.talker:main', _DEMOS),
    Program('listener', 'demo_nodes_py.topics.listener:main', _DEMOS, (
        ('/chatter', String(data='hello')),)),
    Program('talker_qos', 'demo_nodes_py.topics.talker_qos:main', _DEMOS),
    Program('set_parameters', 'demo_nodes_py.parameters.set_parameters_callback:main', _DEMOS),
    Program('lifecycle_talker', 'lifecycle_py.talker:main', ('demos/lifecycle_py',)),
    Program('data_publisher', 'topic_monitor.scripts.data_publisher:main',
            ('demos/topic_monitor',)),
    Program('obstacle_detection',
            'turtlebot3_example.turtlebot3_obstacle_detection.turtlebot3_obstacle_detection:main',
            ('turtlebot3/turtlebot3_example',), (
                ('/scan', LaserScan(ranges=[1.5] * 360)),
                ('/cmd_vel_raw', Twist(linear=Vector3(x=0.2)))),
            ('/cmd_vel',)),
    Program('joint_state_publisher', 'joint_state_publisher.joint_state_publisher:main',
            ('joint_state_publisher/joint_state_publisher',), (
                ('/robot_description', String(data=URDF)),)),
    Program('cpu_monitor', 'diagnostic_common_diagnostics.cpu_monitor:main', _DIAGNOSTICS),
    Program('diagnostic_example', 'diagnostic_updater.example:main', _DIAGNOSTICS),
    Program('rosapi', 'rosapi_node:main', (*_ROSBRIDGE, 'rosbridge_suite/rosapi/scripts')),
    Program('rosbridge_websocket', 'rosbridge_websocket:main',
            (*_ROSBRIDGE, 'rosbridge_suite/rosbridge_server/scripts'),
            parameters=('address:=127.0.0.1',)),
    Program('tree_watcher', 'py_trees_ros.programs.tree_watcher:main', ('py_trees_ros',)),
    Program('gym_bridge', 'f1tenth_gym_ros.gym_bridge:main', ('f1tenth_gym_ros',)),
)


class Probe:
    """A node that publishes a program's inputs and counts what the program publishes."""

    def __init__(self, program):
        self.counts, self.types, self.last = Counter(), {}, {}
        self.node = Node('public_programs_probe')
        self._ignored = {'/rosout', '/parameter_events', *(topic for topic, _ in program.inputs)}
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        for topic, message in program.inputs:
            publisher = self.node.create_publisher(type(message), topic, _KEPT)
            self.node.create_timer(0.05, lambda p=publisher, m=message: p.publish(m))
        self.node.create_timer(0.1, self._look)

    def _look(self):
        for topic, types in self.node.get_topic_names_and_types():
            if topic in self.types or topic in self._ignored or not (
                    self.node.get_publishers_info_by_topic(topic)):
                continue
            self.types[topic] = types[0]
            package, _, name = types[0].split('/')
            self.node.create_subscription(
                getattr(import_module(f'{package}.msg'), name), topic,
                lambda message, topic=topic: self._count(topic, message),
                qos_profile_sensor_data)

    def _count(self, topic, message):
        self.counts[topic] += 1
        self.last[topic] = message

    def spin_for(self, seconds, process, first):
        """Spin for some seconds, or until the first message; not longer than a process runs."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and process.poll() is None and not (first and self.counts):
            self._executor.spin_once(0.05)

    def close(self):
        self._executor.shutdown()
        self.node.destroy_node()


class Run(NamedTuple):
    """What a program did."""

    types: dict[str, str]
    counts: Counter[str]
    constant: dict[str, Any]
    end: str
    status: int
    said: str


def observe(program, path, hosted, seconds):
    """Run a program under one of the executors; return what it did."""
    os.environ['ROS_DOMAIN_ID'] = str(random.randrange(1, 40))  # the tests use those from 40 on
    module, function = program.spec.split(':')
    command = ['-c', f'import sys; sys.argv[0] = {module!r}; import {module} as m; m.{function}()']
    if hosted:
        command = ['-m', 'mddag_executor', 'run', '--node', program.spec, '--diagnostics', 'off']
    for parameter in program.parameters:
        command += ['--ros-args', '-p', parameter]
    rclpy.init()
    probe = Probe(program)
    with subprocess.Popen(
        [sys.executable, *command], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(path)},
    ) as process:
        try:
            probe.spin_for(START_S, process, True)
            probe.counts.clear()
            probe.spin_for(seconds, process, False)
            end = 'by SIGINT' if process.poll() is None else 'by itself'
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=END_S)
        except subprocess.TimeoutExpired:
            end, said = 'not even by SIGINT', ''
        finally:
            process.kill()
            probe.close()
            rclpy.shutdown()
    constant = {topic: probe.last.get(topic) for topic in program.constant}
    status = process.returncode if process.returncode >= 0 else 128 - process.returncode
    return Run(probe.types, probe.counts, constant, end, status, said)


def differences(theirs, ours):
    """Return in what two runs differ."""
    found = [f'{name} {one} and {other}' for name, one, other in zip(Run._fields, theirs, ours)
             if one != other and name in ('types', 'constant', 'end')]
    for topic in {*theirs.counts, *ours.counts}:
        one, other = theirs.counts[topic], ours.counts[topic]
        if abs(one - other) > max(FEW, TOLERANCE * max(one, other)):
            found.append(f'{topic}: {one} and {other} messages')
    if ours.status != theirs.status and theirs.status not in _CRASHES and not any(
            each in theirs.said for each in _AFTER_THE_END):
        found.append(f'exit status {theirs.status} and {ours.status}: {ours.said.strip()[-500:]}')
    return found


def missing(program, path):
    """Return why a program cannot run; '' if it can."""
    if not all(Path(folder).is_dir() for folder in path[:len(program.folders)]):
        return 'no sources'
    module = program.spec.split(':')[0]
    done = subprocess.run(
        [sys.executable, '-c', f'import {module}'], capture_output=True, text=True, check=False,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(path)}, timeout=60)
    return done.stderr.strip().splitlines()[-1] if done.returncode else ''


def compare(program, path, seconds):
    """Run a program twice; return what came of it, and whether the runs differ (None: skipped)."""
    why = missing(program, path)
    if why:
        return f'skipped: {why}', None
    theirs, ours = (observe(program, path, hosted, seconds) for hosted in (False, True))
    if theirs.end == 'by itself' and theirs.status:  # it compares nothing
        return f'skipped: {(theirs.said.strip().splitlines() or ["it ends at once"])[-1]}', None
    found = differences(theirs, ours)
    counts = ', '.join(f'{topic} {theirs.counts[topic]}/{ours.counts[topic]}'
                       for topic in sorted({*theirs.counts, *ours.counts}))
    return (f'{"; ".join(found) or "same"} ({counts or "no messages"}, ended {theirs.end})',
            bool(found))


def main():
    """Compare the programs; return 1 if one differs."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('sources', type=Path)
    parser.add_argument('--seconds', type=float, default=5.0)
    parser.add_argument('--only')
    options = parser.parse_args()
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    before = [os.environ['PYTHONPATH']] if os.environ.get('PYTHONPATH') else []
    differ = []
    for program in PROGRAMS:
        if options.only in (None, program.name):
            path = [str((options.sources / each).resolve()) for each in program.folders] + before
            said, differs = compare(program, path, options.seconds)
            differ.append(differs)
            print(f'{program.name}: {said}', flush=True)
    print(f'{len(differ) - differ.count(None)} programs compared, {differ.count(True)} differ')
    return 1 if any(differ) else 0


if __name__ == '__main__':
    sys.exit(main())
