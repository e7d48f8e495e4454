# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
r"""
Run nodes under the executor, as `mddag run` does.

    ros2 launch mddag_executor run.launch.py graph:=/path/graph.yaml trace:=run.mcap \
        nodes:='my_package/driver my_package/filter'

Each argument has the meaning of the option of `mddag run` of that name, and is left out if empty.
`ros2 launch` ends when the run ends, with status 1 if the run failed or, with
`fail_on_miss:=true`, missed more deadlines than it may. SIGINT and SIGTERM end the run, which then
prints its verdict and completes its trace.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import shlex
from typing import Any

OPTIONS = {
    'policy': 'the scheduling policy',
    'workers': 'how many worker threads run callbacks',
    'trace': 'the file to record to; it must not exist yet',
    'processes': 'how many processes run the nodes, or a file that says which node runs where',
    'duration': 'how long to run, for instance 20s; until Ctrl-C if empty',
    'synthetic': 'instead of nodes: make them from the graph (sleep, spin, native or mixed)',
    'utilisation': 'with synthetic: normalised utilisation that execution times are scaled to',
    'seed': 'with synthetic: what execution times are drawn with',
}
ARGUMENTS = {
    'graph': 'the declaration, a YAML file; without one nothing is judged',
    'nodes': 'PACKAGE/EXECUTABLE or MODULE:CLASS of each node, separated by blanks; quote a node '
             'that has arguments',
    **OPTIONS,
    'fail_on_miss': 'true: a missed deadline ends the launch with status 1',
    'ros_args': "for all nodes, for instance '--params-file my.yaml -r image:=front/image'",
}
# From Ctrl-C to SIGTERM, and from SIGTERM to SIGKILL: running callbacks finish, and the trace is
# completed. launch's own 5 s are less than a callback may take.
GRACE_S = '30'
# A SIGTERM ends `ros2 launch` without a word to its processes. The kernel passes it on.
PREFIX = 'setpriv --pdeathsig TERM'


def command(values: Mapping[str, str]) -> list[str]:
    """
    Return the arguments of `mddag`.

    :param values: by the names of ``ARGUMENTS``
    :raises ValueError: if `nodes` or `ros_args` has a quote without its end
    """
    def parts() -> Iterator[str]:
        yield 'run'
        if values['graph']:
            yield values['graph']
        for node in shlex.split(values['nodes']):
            yield from ('--node', node)
        for name in OPTIONS:
            if values[name]:
                yield from (f'--{name}', values[name])
        if values['fail_on_miss'].lower() in ('true', '1', 'yes'):
            yield '--fail-on-miss'
        if values['ros_args']:
            yield from ('--ros-args', *shlex.split(values['ros_args']))
    return list(parts())


def generate_launch_description() -> Any:
    """Return the launch description: the arguments, and the process."""
    # Here, so that this file can be read on a machine without ROS's launch.
    from launch.actions import DeclareLaunchArgument, OpaqueFunction
    from launch.substitutions import LaunchConfiguration

    from launch import LaunchDescription

    def process(context: Any) -> list[Any]:
        from launch_ros.actions import Node
        values = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
        return [Node(
            package='mddag_executor', executable='mddag', exec_name='mddag',
            arguments=command(values), output='screen', prefix=PREFIX,
            sigterm_timeout=GRACE_S, sigkill_timeout=GRACE_S, on_exit=ended)]

    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value='', description=meaning)
          for name, meaning in ARGUMENTS.items()),
        OpaqueFunction(function=process),
    ])


def ended(event: Any, context: Any) -> Any:
    """
    End the launch with the run.

    :raises RuntimeError: if the run failed; launch then ends with status 1
    """
    from launch.actions import Shutdown
    if event.returncode:
        raise RuntimeError(f'mddag run ended with status {event.returncode}')
    return Shutdown(reason='the run has ended')
