# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Run the paper's Autoware workload under the executor, as `mddag run` does, and record it.

    ros2 launch mddag_executor autoware_demo.launch.py utilisation:=0.8 trace:=/tmp/run.mcap

The nodes have the names that the declaration gives them, so remappings and namespaces of an
including launch file do not reach them. Every argument below has the meaning of the option of
`mddag run` of that name.
"""

from datetime import datetime

ARGUMENTS = (
    ('synthetic', 'sleep', 'how a callback takes its time: sleep or spin'),
    ('utilisation', '0.6', 'normalised utilisation that the execution times are scaled to'),
    ('seed', '0', 'what the execution times are drawn with'),
    ('duration', '20s', 'how long to run'),
    ('workers', '7', 'how many worker threads run callbacks'),
    ('policy', 'rad', 'the scheduling policy'),
    # with the time in its name, for nothing is recorded over a file
    ('trace', f'autoware_demo_{datetime.now():%Y_%m_%d-%H_%M_%S}.mcap', 'where to record'),
)


def generate_launch_description():
    """Return the launch description, with one launch argument for each option."""
    # Here, so that this file can be read on a machine without ROS's launch.
    from launch.actions import DeclareLaunchArgument
    from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
    from launch_ros.actions import Node
    from launch_ros.substitutions import FindPackageShare

    from launch import LaunchDescription

    workload = PathJoinSubstitution(
        [FindPackageShare('mddag_executor'), 'config', 'autoware.yaml'])
    command = ['run', LaunchConfiguration('graph')]
    for name, _, _ in ARGUMENTS:
        command += [f'--{name}', LaunchConfiguration(name)]
    return LaunchDescription([
        DeclareLaunchArgument('graph', default_value=workload,
                              description='the declaration to run'),
        *(DeclareLaunchArgument(name, default_value=value, description=meaning)
          for name, value, meaning in ARGUMENTS),
        Node(package='mddag_executor', executable='mddag', arguments=command, output='screen'),
    ])
