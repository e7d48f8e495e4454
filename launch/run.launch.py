# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
r"""
Run nodes under the executor, as `mddag run` does.

    ros2 launch mddag_executor run.launch.py graph:=/path/graph.yaml trace:=run.mcap \
        nodes:='my_package/driver my_package/filter'

Each option of `mddag run` is an argument of its name; one that is empty is left out.
`ros2 launch` ends when the run ends, with status 1 if the run failed or, with
`fail_on_miss:=true`, missed more deadlines than the declaration tolerates. SIGINT and SIGTERM end
the run, which then prints its verdict and completes its trace.
"""

from __future__ import annotations

from typing import Any

from mddag_executor.cli import launch_arguments

# From Ctrl-C to SIGTERM, and from SIGTERM to SIGKILL: running callbacks finish, and the trace is
# completed. launch's own 5 s are less than a callback may take.
GRACE_S = '30'
# A SIGTERM ends `ros2 launch` without a word to its processes. The kernel passes it on.
PREFIX = 'setpriv --pdeathsig TERM'


def generate_launch_description() -> Any:
    """Return the launch description: the arguments, and the process."""
    # Here, so that this file can be read on a machine without ROS's launch.
    from launch.actions import DeclareLaunchArgument, OpaqueFunction
    from launch.substitutions import LaunchConfiguration

    from launch import LaunchDescription

    arguments = launch_arguments.arguments()

    def process(context: Any) -> list[Any]:
        from launch_ros.actions import Node
        values = {name: LaunchConfiguration(name).perform(context) for name in arguments}
        return [Node(
            package='mddag_executor', executable='mddag', exec_name='mddag',
            arguments=launch_arguments.command(values), output='screen', prefix=PREFIX,
            sigterm_timeout=GRACE_S, sigkill_timeout=GRACE_S, on_exit=ended)]

    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value='', description=meaning)
          for name, meaning in arguments.items()),
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
