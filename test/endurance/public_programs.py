# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Public programs under rclpy's executor and under this one: what they do is compared.

    python test/endurance/public_programs.py SOURCES [--seconds 5] [--interrupts 20] [--only NAME]

SOURCES is a folder with the sources of the packages, one folder for each repository.  Programs
are run from there.  What they import beyond that (interfaces, libraries) must be importable
already (``make test-public`` adds ``SOURCES/install``); a program whose imports or sources are
missing is skipped with a line that says so.

Each program runs with the same inputs under its own executor, and as ``mddag run --node`` hosts
it.  First one run of each: a node of this script publishes the inputs, calls the services, sends
goals to the actions, serves what the program is a client of, and counts messages, responses,
results, requests and goals for some seconds, starting with the first one.  The two runs are the
same if

* the same topics were published on, with the same types;
* each topic had as many messages, each service as many responses and each action as many results,
  give or take a quarter (a slow machine counts as equal);
* the last message of the topics in ``Program.constant``, the last response of each service, and
  the last status and result of each action were the same;
* both ran until SIGINT, or neither.

Then come runs that SIGINT ends at random moments, from the first line of the program on; most
moments are early.  No run may hang.  What they do is compared as sets, because no two runs are
interrupted at the same line of the program.  Each exit status of a hosted run must be one of the
program's own (a signal counts as the status that a shell makes of it), and each line that it
prints must be printed by one of the program's own runs, apart from numbers.  ``REASONS`` lists the
differences that are documented.
"""

import argparse
from array import array
from collections import Counter
from importlib import import_module
import os
from pathlib import Path
import random
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any, NamedTuple

from geometry_msgs.msg import Twist, Vector3
from nav_msgs.msg import Odometry
import rclpy
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, qos_profile_sensor_data, QoSProfile
from rclpy.task import Future
from sensor_msgs.msg import Image, LaserScan
from std_msgs.msg import String

sys.path.append(str(Path(__file__).parents[1]))
from ros_domains import claim_domain

TOLERANCE, FEW = 0.25, 3
"""Counts that differ by this part, or by this many messages, are the same."""
START_S, END_S = 60.0, 60.0
"""How long a program may take to publish first, and to end after SIGINT."""
LATEST_S = 2.0
"""The latest moment of an interrupt, after the first line of the program."""

_OK, _FAILED, _INTERRUPTED = 0, 1, 128 + signal.SIGINT
_CRASHES = (128 + signal.SIGABRT, 128 + signal.SIGSEGV)
_CONTEXT_ENDED = ('rcl_shutdown already called', 'context is invalid', 'context is not valid',
                  'ExternalShutdownException')
_BEGUN = 'the program begins'

# for subscriptions of either durability
_KEPT = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)

URDF = """<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="continuous">
<parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint></robot>"""

LANE = array('B', bytes([0, 200, 200, 255]) * 64 * 200)
"""A picture of the colour of the lane."""


class Program(NamedTuple):
    """A program to compare."""

    name: str
    spec: str  # its module and function
    folders: tuple[str, ...]  # where its packages are, in the folder of sources
    inputs: tuple[tuple[str, Any], ...] = ()  # messages by topic, published at 20 Hz
    constant: tuple[str, ...] = ()  # the topics whose last message must be the same
    parameters: tuple[str, ...] = ()  # ROS parameters, ``name:=value``
    arguments: tuple[str, ...] = ()  # of its command line; files are in the folder of sources
    # service, type, request, at 5 Hz; or action, type, goal, one goal after the other
    calls: tuple[tuple[str, str, dict[str, Any]], ...] = ()
    # the program is a client of these services and actions: name, type, response or result
    serves: tuple[tuple[str, str, dict[str, Any]], ...] = ()


_EXAMPLES = 'examples/rclpy'
_DEMOS = ('demos/demo_nodes_py',)
_DIAGNOSTICS = ('diagnostics/diagnostic_updater', 'diagnostics/diagnostic_common_diagnostics')
_ROSBRIDGE = ('rosbridge_suite/rosbridge_library/src', 'rosbridge_suite/rosbridge_server/src',
              'rosbridge_suite/rosapi/src')
_FLEXBE = tuple(f'flexbe_behavior_engine/flexbe_{each}' for each in (
    'core', 'mirror', 'onboard', 'widget', 'input'))
# as in its config/sim.yaml
_F1TENTH = (
    'ego_namespace:=ego_racecar', 'ego_odom_topic:=odom', 'ego_opp_odom_topic:=opp_odom',
    'ego_scan_topic:=scan', 'ego_drive_topic:=drive', 'opp_namespace:=opp_racecar',
    'opp_odom_topic:=odom', 'opp_ego_odom_topic:=opp_odom', 'opp_scan_topic:=opp_scan',
    'opp_drive_topic:=opp_drive', 'scan_distance_to_base_link:=0.275', 'scan_fov:=4.7',
    'scan_beams:=1080', 'map_path:=maps/levine', 'map_img_ext:=.png', 'num_agent:=1', 'sx:=0.0',
    'sy:=0.0', 'stheta:=0.0', 'sx1:=2.0', 'sy1:=0.5', 'stheta1:=0.0', 'kb_teleop:=true')
_SUM = (('/add_two_ints', 'example_interfaces/srv/AddTwoInts', {'a': 2, 'b': 3}),)
_IS_SUM = (('/add_two_ints', 'example_interfaces/srv/AddTwoInts', {'sum': 42}),)
_FIBONACCI = (('/fibonacci', 'example_interfaces/action/Fibonacci', {'order': 3}),)
_IS_FIBONACCI = (('/fibonacci', 'example_interfaces/action/Fibonacci', {'sequence': [0, 1, 1]}),)


def _examples(*names):
    """Return programs of ros2/examples; a name is a package and its module."""
    made = []
    for name in names:
        folder, package, module = name.split('/')
        made.append(Program(
            f'examples: {package} {module}', f'examples_rclpy_{package}.{module}:main',
            (f'{_EXAMPLES}/{folder}/{package}' if folder else f'{_EXAMPLES}/{package}',),
            (('/topic', String(data='Hello')), ('/chatter', String(data='Hello'))) * (
                module in ('listener', 'custom_executor') or 'subscriber' in module),
            calls=(_SUM * (package == 'minimal_service')
                   + _FIBONACCI * (package == 'minimal_action_server')),
            serves=(_IS_SUM * (package == 'minimal_client')
                    + _IS_FIBONACCI * (package == 'minimal_action_client'))))
    return made


PROGRAMS = (
    Program('talker', 'demo_nodes_py.topics.talker:main', _DEMOS),
    Program('listener', 'demo_nodes_py.topics.listener:main', _DEMOS, (
        ('/chatter', String(data='hello')),)),
    Program('talker_qos', 'demo_nodes_py.topics.talker_qos:main', _DEMOS),
    Program('set_parameters', 'demo_nodes_py.parameters.set_parameters_callback:main', _DEMOS),
    Program('use_logger_service', 'demo_nodes_py.logging.use_logger_service:main', _DEMOS),
    Program('matched_event', 'demo_nodes_py.events.matched_event_detect:main', _DEMOS),
    Program('add_two_ints_server', 'demo_nodes_py.services.add_two_ints_server:main', _DEMOS,
            calls=_SUM),
    Program('lifecycle_talker', 'lifecycle_py.talker:main', ('demos/lifecycle_py',)),
    Program('data_publisher', 'topic_monitor.scripts.data_publisher:main',
            ('demos/topic_monitor',)),
    *_examples(
        'topics/minimal_publisher/publisher_member_function',
        'topics/minimal_publisher/publisher_local_function',
        'topics/minimal_publisher/publisher_old_school',
        'topics/minimal_subscriber/subscriber_member_function',
        'topics/minimal_subscriber/subscriber_lambda',
        'topics/minimal_subscriber/subscriber_old_school',
        'services/minimal_service/service', 'services/minimal_service/service_member_function',
        'services/minimal_client/client', 'services/minimal_client/client_async',
        'services/minimal_client/client_async_callback',
        'services/minimal_client/client_async_member_function',
        '/executors/callback_group', '/executors/composed', '/executors/custom_callback_group',
        '/executors/custom_executor', '/executors/listener', '/executors/talker',
        '/guard_conditions/trigger_guard_condition',
        'actions/minimal_action_server/server',
        'actions/minimal_action_server/server_defer',
        'actions/minimal_action_server/server_single_goal',
        'actions/minimal_action_server/server_queue_goals',
        'actions/minimal_action_client/client', 'actions/minimal_action_client/client_asyncio',
        'actions/minimal_action_client/client_cancel',
        'actions/minimal_action_client/client_not_composable'),
    Program('dynamic_broadcaster', 'examples_tf2_py.dynamic_broadcaster:main', (
        'geometry2/examples_tf2_py', 'geometry2/tf2_ros_py', 'geometry2/tf2_py')),
    Program('joy_teleop', 'joy_teleop.joy_teleop:main', ('teleop_tools/joy_teleop',)),
    Program('nmea_topic_driver', 'libnmea_navsat_driver.nodes.nmea_topic_driver:main',
            ('nmea_navsat_driver/src',)),
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
    Program('gym_bridge', 'f1tenth_gym_ros.gym_bridge:main', ('f1tenth_gym_ros',), (
        ('/cmd_vel', Twist(linear=Vector3(x=0.2))),), parameters=_F1TENTH),
    Program('crazyflie_sim', 'crazyflie_sim.crazyflie_server:main', (
        'crazyswarm2/crazyflie_sim', 'crazyswarm2/crazyflie_py')),
    Program('vel_mux', 'crazyflie_examples.vel_mux:main', (
        'crazyswarm2/crazyflie_examples', 'crazyswarm2/crazyflie_py'), (
            ('/cmd_vel', Twist(linear=Vector3(x=0.2))),)),
    Program('epuck_drive_calibrator', 'webots_ros2_epuck.drive_calibrator:main', (
        'webots_ros2/webots_ros2_epuck',), (('/odom', Odometry()),), ('/cmd_vel',),
            ('type:=angular',)),
    Program('tesla_lane_follower', 'webots_ros2_tesla.lane_follower:main', (
        'webots_ros2/webots_ros2_tesla',), (
            ('/vehicle/camera/image_color', Image(height=200, width=64, data=LANE)),),
            ('/cmd_ackermann',)),
    Program('behavior_mirror', 'flexbe_mirror.behavior_mirror_sm:main', _FLEXBE),
    Program('be_input', 'flexbe_input.input_action_server:main', _FLEXBE),
    Program('behavior_onboard', 'flexbe_onboard.start_behavior:main', _FLEXBE),
    Program('emergency_signal', 'rmf_demos_tasks.emergency_signal:main', (
        'rmf_demos/rmf_demos_tasks',)),
    Program('dispatch_patrol', 'rmf_demos_tasks.dispatch_patrol:main', (
        'rmf_demos/rmf_demos_tasks',)),
    Program('fleet_manager', 'rmf_demos_fleet_adapter.fleet_manager:main', (
        'rmf_demos/rmf_demos_fleet_adapter',), arguments=(
            '-c', 'rmf_demos/rmf_demos/config/office/tinyRobot_config.yaml', '-n', 'no graph')),
    Program('yasmin_demo', 'yasmin_demos.yasmin_demo:main', (
        'yasmin/yasmin_demos', 'yasmin/yasmin')),
)


class Probe:
    """A node that publishes inputs and calls services, and counts what the program answers."""

    def __init__(self, program):
        self.counts, self.types, self.last = Counter(), {}, {}
        self.node = Node('public_programs_probe')
        self._ignored = {'/rosout', '/parameter_events', *(topic for topic, _ in program.inputs)}
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        for topic, message in program.inputs:
            publisher = self.node.create_publisher(type(message), topic, _KEPT)
            self.node.create_timer(0.05, lambda p=publisher, m=message: p.publish(m))
        for name, type_name, fields in program.calls:
            kind = _interface(type_name)
            if '/action/' in type_name:
                self._send_goals(name, ActionClient(self.node, kind, name), kind.Goal(**fields))
                continue
            client, request = self.node.create_client(kind, name), kind.Request(**fields)
            self.node.create_timer(
                0.2, lambda n=name, c=client, r=request: self._call(n, c, r))
        for name, type_name, fields in program.serves:
            kind = _interface(type_name)
            if '/action/' in type_name:
                self._serve_goals(name, kind, kind.Result(**fields))
            else:
                self._serve(name, kind, kind.Response(**fields))
        self.node.create_timer(0.1, self._look)

    def _send_goals(self, name, client, goal):
        running = []

        def send():
            if not running and client.server_is_ready():
                running.append(client.send_goal_async(goal, lambda message: self._count(
                    f'{name} feedback', None)))
                running[0].add_done_callback(sent)

        def sent(future):
            handle = future.result()
            if handle.accepted:
                handle.get_result_async().add_done_callback(ended)
            else:
                running.clear()
                self._count(name, 'rejected')

        def ended(future):
            running.clear()
            self._count(name, (future.result().status, future.result().result))

        self.node.create_timer(0.1, send)

    def _serve(self, name, kind, response):
        def serve(request, _):
            self._count(name, request)
            return response

        self.node.create_service(kind, name, serve)

    def _serve_goals(self, name, kind, result):
        async def serve(handle):
            self._count(name, handle.request)
            for _ in range(5):
                handle.publish_feedback(kind.Feedback())
                if handle.is_cancel_requested:
                    handle.canceled()
                    return result
                await self._sleep(0.2)
            handle.succeed()
            return result

        ActionServer(self.node, kind, name, serve,
                     cancel_callback=lambda _: CancelResponse.ACCEPT)

    async def _sleep(self, seconds):
        future = Future()
        timer = self.node.create_timer(seconds, lambda: future.set_result(None))
        await future
        self.node.destroy_timer(timer)

    def _look(self):
        for topic, types in self.node.get_topic_names_and_types():
            if topic in self.types or topic in self._ignored or '/_action/' in topic or not (
                    self.node.get_publishers_info_by_topic(topic)):
                continue
            self.types[topic] = types[0]
            self.node.create_subscription(
                _interface(types[0]), topic,
                lambda message, topic=topic: self._count(topic, message), qos_profile_sensor_data)

    def _call(self, name, client, request):
        if client.service_is_ready():
            client.call_async(request).add_done_callback(
                lambda future: self._count(name, future.result()))

    def _count(self, name, value):
        self.counts[name] += 1
        self.last[name] = value

    def spin_for(self, seconds, process, first):
        """Spin for some seconds, or until the first message; not longer than a process runs."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and process.poll() is None and not (first and self.counts):
            self._executor.spin_once(0.05)

    def close(self):
        self._executor.shutdown()
        self.node.destroy_node()


def _interface(type_name):
    package, kind, name = type_name.split('/')
    return getattr(import_module(f'{package}.{kind}'), name)


class Run(NamedTuple):
    """What a program did."""

    types: dict[str, str]
    counts: Counter[str]
    constant: dict[str, Any]
    end: str
    status: int
    lines: frozenset[str]


class Place:
    """
    Where programs run: their modules, and a ROS domain that no test of this machine has.

    :param sources: the folder of sources, in which they run.
    :param paths: the folders of the program's packages, and what else has to be importable.
    :param folder: a temporary one, for a module that says when the program begins.
    """

    def __init__(self, program, sources, paths, folder):
        self.program = program
        self._sources = sources
        module, function = program.spec.split(':')
        Path(folder, 'begun.py').write_text(
            f'import {module} as m\n\n\ndef main():\n    print({_BEGUN!r}, flush=True)\n'
            f'    return m.{function}()\n')
        self._env = {**os.environ, 'PYTHONPATH': os.pathsep.join([str(folder), *paths]),
                     'PYTHONUNBUFFERED': '1', 'RCUTILS_COLORIZED_OUTPUT': '0'}

    def start(self, hosted):
        """Start the program with its own executor, or with this one."""
        command = ['-c', f'import sys; sys.argv[0] = {self.program.name!r}\n'
                   'from begun import main\nsys.exit(main())', *self.program.arguments]
        if hosted:
            command = ['-m', 'mddag_executor', 'run', '--node', shlex.join((
                'begun:main', *self.program.arguments)), '--diagnostics', 'off', '--quiet']
        if self.program.parameters:
            command += ['--ros-args']
        for parameter in self.program.parameters:
            command += ['-p', parameter]
        return subprocess.Popen(
            [sys.executable, *command], env=self._env, cwd=self._sources, text=True,
            errors='replace', stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def _status(process):
    """Return its exit status; that of a shell for a signal."""
    return process.returncode if process.returncode >= 0 else 128 - process.returncode


def _lines(said):
    """Return the lines that a program has printed, without numbers, times and places."""
    found = set()
    for line in said.splitlines():
        line = re.sub(r'^\[(\w+)\] \[[\d.]+\] \[(.*?)\]:', r'[\1] \2:', line.rstrip())
        line = re.sub(r'0x[0-9a-f]+|\d+(\.\d+)?(e-?\d+)?|[0-9a-f]{8}-[0-9a-f-]{27}', '#', line)
        if line and line != _BEGUN and not line.startswith((' ', 'Traceback', '^')):
            found.add(line)
    return frozenset(found)


def observe(place, hosted, seconds):
    """Run a program under one of the executors, for some seconds; return what it did."""
    program = place.program
    rclpy.init()
    probe = Probe(program)
    with place.start(hosted) as process:
        try:
            probe.spin_for(START_S, process, True)
            probe.counts.clear()
            probe.spin_for(seconds, process, False)
            end = 'by SIGINT' if process.poll() is None else 'by itself'
            process.send_signal(signal.SIGINT)
            said, _ = process.communicate(timeout=END_S)
        except subprocess.TimeoutExpired:
            end, said = 'not even by SIGINT', ''
        finally:
            process.kill()
            probe.close()
            rclpy.shutdown()
    names = (*program.constant, *(name for name, *_ in (*program.calls, *program.serves)))
    constant = {name: probe.last.get(name) for name in names}
    return Run(probe.types, probe.counts, constant, end, _status(process), _lines(said))


def interrupt(place, hosted, after):
    """Run a program, and send SIGINT some seconds after it has begun; return status and lines."""
    with place.start(hosted) as process:
        try:
            if process.stdout.readline().strip() != _BEGUN:
                return None, frozenset()
            time.sleep(after)
            process.send_signal(signal.SIGINT)
            said, _ = process.communicate(timeout=END_S)
        except subprocess.TimeoutExpired:
            return 'hangs', frozenset()
        finally:
            process.kill()
    return _status(process), _lines(said)


def differences(theirs, ours):
    """Return in what two runs differ."""
    found = []
    if theirs.end == ours.end == 'by itself':  # discovery may miss a topic that soon ends
        both = theirs.types.keys() & ours.types.keys()
        theirs, ours = (run._replace(types={topic: run.types[topic] for topic in sorted(both)})
                        for run in (theirs, ours))
    found += [f'{name} {one} and {other}' for name, one, other in zip(Run._fields, theirs, ours)
              if one != other and name in ('types', 'constant', 'end')]
    for topic in {*theirs.counts, *ours.counts}:
        one, other = theirs.counts[topic], ours.counts[topic]
        if abs(one - other) > max(FEW, TOLERANCE * max(one, other)):
            found.append(f'{topic}: {one} and {other} messages')
    return found


def _is_documented(status, statuses, lines):
    """Return whether docs/run.md says why a hosted program has a status that it never had."""
    context_ended = any(each in line for line in lines for each in _CONTEXT_ENDED)
    # "After Ctrl-C programs may still publish, and rclpy.shutdown does nothing": no such error
    if status in (_OK, _INTERRUPTED) and _FAILED in statuses and context_ended:
        return True
    return status != 'hangs' and bool(statuses.intersection(_CRASHES))  # of the middleware


REASONS = (
    # rclpy's errors about a context that has ended, which a hosted program cannot have
    *_CONTEXT_ENDED,
    # the lines of ``mddag run`` itself
    'warning: ', 'error: ',
)
"""Lines that only one kind of runs may print, and why."""


def compare_interrupts(place, n, theirs, ours):
    """Interrupt a program at random moments; return the differences, and how it ended."""
    lines = {False: {*theirs.lines}, True: {*ours.lines}}
    ends = {False: Counter([theirs.status]), True: Counter([ours.status])}
    for _ in range(n):
        after = LATEST_S * random.random() ** 3
        for hosted in (False, True):
            status, said = interrupt(place, hosted, after)
            ends[hosted][status] += 1
            lines[hosted] |= said
    own = {*ends[False]}
    found = [f'exit status {status} in {ends[True][status]} of {n + 1} runs, by itself '
             f'{dict(ends[False])}' for status in {*ends[True]} - own
             if not _is_documented(status, own, lines[False])]
    found += [f'only hosted: {line[:200]!r}' for line in sorted(lines[True] - lines[False])
              if not any(each in line for each in REASONS)]
    return found, f'statuses {dict(ends[False])} and {dict(ends[True])}'


def missing(program, path):
    """Return why a program cannot run; '' if it can."""
    if not all(Path(folder).is_dir() for folder in path[:len(program.folders)]):
        return 'no sources'
    module, function = program.spec.split(':')
    done = subprocess.run(
        [sys.executable, '-c', f'from {module} import {function}'],
        capture_output=True, text=True, check=False,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(path)}, timeout=60)
    return done.stderr.strip().splitlines()[-1] if done.returncode else ''


def compare(program, sources, path, seconds, interrupts):
    """Compare the runs of a program; return the result, and whether they differ."""
    why = missing(program, path)
    if why:
        return f'skipped: {why}', None
    with tempfile.TemporaryDirectory() as folder:
        place = Place(program, sources, path, folder)
        theirs, ours = (observe(place, hosted, seconds) for hosted in (False, True))
        if theirs.end == 'by itself' and theirs.status:  # it compares nothing
            return f'skipped: it ends at once: {sorted(theirs.lines)[-1:]}', None
        found = differences(theirs, ours)
        said = f'ended {theirs.end}'
        if interrupts:
            more, ends = compare_interrupts(place, interrupts, theirs, ours)
            found += more
            said += f', {ends}'
    counts = ', '.join(f'{topic} {theirs.counts[topic]}/{ours.counts[topic]}'
                       for topic in sorted({*theirs.counts, *ours.counts}))
    return f'{"; ".join(found) or "same"} ({counts or "no messages"}, {said})', bool(found)


def main():
    """Compare the programs; return 1 if one differs."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('sources', type=Path)
    parser.add_argument('--seconds', type=float, default=5.0)
    parser.add_argument('--interrupts', type=int, default=20)
    parser.add_argument('--only')
    options = parser.parse_args()
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    before = [os.environ['PYTHONPATH']] if os.environ.get('PYTHONPATH') else []
    differ = []
    domain, claim = claim_domain()
    if claim is None:
        sys.exit('error: every ROS domain for tests is in use: try again later')
    os.environ['ROS_DOMAIN_ID'] = str(domain)
    with claim:
        for program in PROGRAMS:
            if options.only in (None, program.name):
                path = [str((options.sources / each).resolve()) for each in program.folders]
                said, differs = compare(
                    program, options.sources, path + before, options.seconds, options.interrupts)
                differ.append(differs)
                print(f'{program.name}: {said}', flush=True)
    print(f'{len(differ) - differ.count(None)} programs compared, {differ.count(True)} differ')
    return 1 if any(differ) else 0


if __name__ == '__main__':
    sys.exit(main())
