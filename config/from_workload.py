# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
r"""
Write `autoware.yaml` and `autoware_multi.yaml` from the figures of the paper's workload.

    python config/from_workload.py WORKLOAD.json [DIRECTORY]

The workload is that of Yano and Azumi, "Multi-Deadline DAG Scheduling Model for Autonomous
Driving Systems" (RTSS 2024 work in progress), published in its evaluation repository
2024_RTSS_WiP_Evaluation. WORKLOAD.json holds its facts: for each of `dags` the `name`,
`period_us`, `edges` (pairs of ids) and `vertices` with `id`, `node`, `callback`,
`execution_time_us` (quantiles of what was measured, at `quantiles_percent`) and, for a sink,
`relative_deadline_us`. The facts have no topics and no queue edges; those stand in the tables
below and are named as in Autoware. The two files that this program wrote are what counts;
nothing needs it to run.
"""

from __future__ import annotations

from collections.abc import Iterator
import json
from pathlib import Path
import sys
import textwrap
from typing import Any

WORKERS = 7
DETECTION = '/perception/object_recognition/detection'
MOTION = '/planning/scenario_planning/lane_driving/motion_planning'
OBJECTS = '/perception/object_recognition/objects'
ODOMETRY = '/localization/kinematic_state'
TWIST = '/localization/twist_estimator/twist_with_covariance'

# For each DAG, by vertex id: what it publishes, and the ids of those whom that starts. What starts
# nobody is only read by queue edges. Ties go by the order of the facts' edges, but edges of one
# topic are in the order of the file. Hence four vertices publish one more topic (`/copy`).
TOPICS: dict[str, dict[int, dict[str, list[int]]]] = {
    'control': {
        0: {'/control/trajectory_follower/control_cmd': [1, 2]},
        1: {'/control/shift_decider/gear_cmd': []},
        2: {'/control/command/control_cmd': [3]},
        3: {'/control/command/actuation_cmd': [4]},
    },
    'ekf_localizer': {
        0: {'/localization/pose_twist_fusion_filter/biased_pose_with_covariance': [1],
            '/localization/pose_twist_fusion_filter/kinematic_state': [2]},
        2: {ODOMETRY: [3]},
        3: {'/localization/acceleration': []},
    },
    'gnss': {0: {'/sensing/gnss/pose_with_covariance': [1]}},
    'imu': {0: {'/sensing/imu/imu_data': [1]}, 1: {TWIST: [2, 3]}},
    'perception': {
        0: {'/sensing/lidar/concatenated/pointcloud': [1, 3, 4, 5]},
        1: {'/perception/obstacle_segmentation/range_cropped/pointcloud': [2]},
        2: {'/perception/obstacle_segmentation/single_frame/pointcloud': [9, 12]},
        3: {'/perception/occupancy_grid_map/raw/downsample/pointcloud': [8]},
        4: {f'{DETECTION}/pointpainting/objects': [6]},
        5: {'/localization/util/measurement_range/pointcloud': [7]},
        6: {f'{DETECTION}/pointpainting/roi_fusion/objects': [10]},
        7: {'/localization/util/voxel_grid_downsample/pointcloud': [13],
            '/localization/util/voxel_grid_downsample/pointcloud/copy': [11]},
        8: {'/perception/occupancy_grid_map/map': [12]},
        9: {'/perception/occupancy_grid_map/obstacle/downsample/pointcloud': [8]},
        10: {f'{DETECTION}/pointpainting/validation/objects': [16]},
        11: {f'{DETECTION}/pointcloud_map_filtered/pointcloud': [10, 31],
             f'{DETECTION}/pointcloud_map_filtered/pointcloud/copy': [26]},
        12: {'/perception/obstacle_segmentation/pointcloud': [7, 27]},
        13: {'/localization/util/downsample/pointcloud': [14]},
        14: {'/localization/pose_estimator/pose_with_covariance': [15]},
        16: {f'{DETECTION}/camera_lidar_fusion/objects': [19]},
        17: {f'{DETECTION}/clustering/objects': [16]},
        18: {f'{DETECTION}/clustering/objects_with_feature': [32],
             f'{DETECTION}/clustering/objects_with_feature/copy': [17]},
        19: {f'{DETECTION}/temporary_merged_objects': [20]},
        20: {f'{DETECTION}/objects': [21]},
        21: {'/perception/object_recognition/tracking/near_objects': [28]},
        22: {f'{DETECTION}/clustering/camera_lidar_fusion/filtered/clusters': [18]},
        23: {f'{DETECTION}/clustering/merged/clusters': [18, 24]},
        24: {f'{DETECTION}/clustering/camera_lidar_fusion/clusters': [22]},
        25: {f'{DETECTION}/clustering/euclidean/clusters': [23]},
        26: {f'{DETECTION}/clustering/low_height/pointcloud': [25]},
        27: {'/planning/scenario_planning/max_velocity_candidates': [30]},
        28: {'/perception/object_recognition/tracking/objects': [33],
             '/perception/object_recognition/tracking/objects/copy': [29]},
        29: {OBJECTS: []},
        30: {'/planning/scenario_planning/max_velocity': []},
        31: {f'{DETECTION}/clustering/roi_cluster/clusters': [23]},
        32: {f'{DETECTION}/detection_by_tracker/objects': [19]},
    },
    'planning': {
        0: {'/planning/scenario_planning/lane_driving/behavior_planning/path_with_lane_id': [1]},
        1: {'/planning/scenario_planning/lane_driving/behavior_planning/path': [2]},
        2: {f'{MOTION}/elastic_band_smoother/path': [3]},
        3: {f'{MOTION}/path_optimizer/trajectory': [4]},
        4: {f'{MOTION}/motion_velocity_planner/trajectory': [5]},
        5: {'/planning/scenario_planning/lane_driving/trajectory': [6]},
        6: {'/planning/scenario_planning/scenario_selector/trajectory': [7]},
        7: {'/planning/scenario_planning/velocity_smoother/trajectory': [8]},
        8: {'/planning/scenario_planning/trajectory': []},
    },
    'vehicle': {
        0: {'/sensing/vehicle_velocity_converter/twist_with_covariance': [1]},
        1: {TWIST: [2, 3]},
    },
    **{f'{side}_lidar': {
        0: {f'/sensing/lidar/{side}/pointcloud_raw_ex': [1]},
        1: {f'/sensing/lidar/{side}/self_cropped/pointcloud_ex': [2]},
        2: {f'/sensing/lidar/{side}/mirror_cropped/pointcloud_ex': [3]},
        3: {f'/sensing/lidar/{side}/rectified/pointcloud_ex': [4]},
        4: {f'/sensing/lidar/{side}/pointcloud_before_sync': [5]},
    } for side in ('left', 'rear', 'right', 'top')},
}

# Queue edges: what a vertex takes later, or has from a member variable.
READS: dict[str, dict[int, list[str]]] = {
    'control': {
        0: ['/planning/scenario_planning/trajectory', ODOMETRY, '/localization/acceleration'],
        2: ['/control/shift_decider/gear_cmd'],
    },
    'ekf_localizer': {0: ['callback_2', 'callback_3']},
    'imu': {1: ['callback_0']},
    'perception': {
        0: ['callback_2', 'callback_3', 'callback_4', 'callback_5'],
        14: ['callback_1'],
        27: [ODOMETRY],
        32: ['callback_0'],
    },
    'planning': {
        0: [OBJECTS, '/perception/occupancy_grid_map/map', ODOMETRY],
        1: [OBJECTS, '/perception/obstacle_segmentation/pointcloud'],
        4: [OBJECTS],
        5: [OBJECTS],
        7: ['/planning/scenario_planning/max_velocity', ODOMETRY],
    },
    'vehicle': {1: ['callback_1']},
    **{f'{side}_lidar': {
        3: ['/sensing/vehicle_velocity_converter/twist_with_covariance', '/sensing/imu/imu_data'],
    } for side in ('left', 'rear', 'right', 'top')},
}

# End-to-end paths: which vertices of which DAG, one DAG after the other over queue edges.
ACTUATE = ('control', [0, 2, 3, 4])
PATHS: dict[str, list[tuple[str, list[int]]]] = {
    'lidar_to_control': [
        ('top_lidar', [0, 1, 2, 3, 4, 5]),
        ('perception', [0, 1, 2, 9, 8, 12, 7, 11, 26, 25, 23, 24, 22, 18, 32, 19, 20, 21, 28, 29]),
        ('planning', [0, 1, 2, 3, 4, 5, 6, 7, 8]), ACTUATE],
    'obstacle_to_control': [
        ('top_lidar', [0, 1, 2, 3, 4, 5]), ('perception', [0, 1, 2, 12, 27, 30]),
        ('planning', [7, 8]), ACTUATE],
    'lidar_to_pose': [
        ('top_lidar', [0, 1, 2, 3, 4, 5]), ('perception', [0, 5, 7, 13, 14, 15]),
        ('ekf_localizer', [0, 2]), ACTUATE],
    'imu_to_control': [('imu', [0, 1, 2]), ('ekf_localizer', [0, 2]), ACTUATE],
    'vehicle_to_control': [('vehicle', [0, 1, 2]), ('ekf_localizer', [0, 2]), ACTUATE],
}

# Deadlines (ms) of autoware_multi.yaml, where they differ from the facts', and why.
MULTI: dict[str, dict[int, tuple[int, str]]] = {
    'control': {
        1: (30, 'the gear: it may take the whole period'),
        4: (15, 'the actuators: half a period; p95 path 5.6 ms'),
    },
    'imu': {
        2: (20, 'the filter that takes the twist runs every 20 ms; p95 path 0.4 ms'),
        3: (33, 'an acceleration for the controller: the whole period will do'),
    },
    'perception': {
        15: (220, 'the pose: late ones make the filter drift; p95 path 201 ms'),
        29: (420, 'predicted objects: the longest path; p95 409 ms'),
        30: (180, 'the speed limit before an obstacle: the most urgent; p95 path 154 ms'),
        33: (500, 'kept for the detection of a later frame: can wait; p95 path 313 ms'),
    },
}

HEAD = """\
# {title}
#
# Source of the figures: the public evaluation repository 2024_RTSS_WiP_Evaluation of Yano and
# Azumi, "Multi-Deadline DAG Scheduling Model for Autonomous Driving Systems" (RTSS 2024 work in
# progress): nodes, callbacks, edges, periods, deadlines and the quantiles (0 to 100 %) of the
# execution times measured there, in us. Topic names and queue edges are not among them; they are
# chosen as in Autoware, but for four topics '.../copy', which keep the order of the paper's edges.
#
# 11 DAGs, 86 vertices, 84 callbacks: {shared}
# each belong to imu and to vehicle, and stand last. The order of the file gives the indices.
{more}# Written by config/from_workload.py.
"""
SINGLE_TITLE = "The paper's workload: Autoware, with the paper's deadlines (one for each DAG)."
MULTI_TITLE = 'The Autoware workload with a different deadline for each sink of a DAG.'
MULTI_MORE = """\
#
# The same graph as autoware.yaml; the deadlines differ for the sinks of control, imu, vehicle and
# perception, as noted at each. Urgent sinks have shorter ones, and none is below the sum of the
# 95 % quantiles along its longest path. With one deadline for each DAG (its latest) the steering
# chain of control (30 ms) runs behind ekf_localizer (20 ms), and the obstacle branch of perception
# runs behind planning (300 ms); with RAD they have 15 ms and 180 ms and run before them.
"""


def main(arguments: list[str]) -> int:
    """Write both files; the arguments are the workload's path and the directory to write to."""
    if len(arguments) not in (1, 2):
        print('usage: from_workload.py WORKLOAD.json [DIRECTORY]', file=sys.stderr)
        return 2
    workload = json.loads(Path(arguments[0]).read_text(encoding='utf-8'))
    target = Path(arguments[1]) if len(arguments) == 2 else Path(__file__).parent
    for name, multi in (('autoware.yaml', False), ('autoware_multi.yaml', True)):
        text = '\n'.join(declaration(workload, multi))
        percent = textwrap.fill(
            f'percent: &percent {workload["quantiles_percent"]}', 99,
            initial_indent=' ' * 10, subsequent_indent=' ' * 12).lstrip()
        text = text.replace('percent: *percent', percent, 1)  # the others are as in the first
        (target / name).write_text(text, encoding='utf-8')
    return 0


def declaration(workload: dict[str, Any], multi: bool) -> Iterator[str]:
    """Yield the lines of a declaration."""
    dags = {dag['name']: dag for dag in workload['dags']}
    times: dict[str, int] = {}
    for dag in dags.values():
        for vertex in dag['vertices']:
            times[key(vertex)] = times.get(key(vertex), 0) + 1
    shared = [name for name, count in times.items() if count > 1]
    yield HEAD.format(
        title=MULTI_TITLE if multi else SINGLE_TITLE, more=MULTI_MORE if multi else '',
        shared=' and '.join(name.rpartition('/')[2] for name in shared))
    yield f'mddag: 1\nworkers: {WORKERS}\n\nnodes:'
    node = None
    last: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {}
    for dag in dags.values():
        yield f'  # DAG {dag["name"]}'
        node = None
        for vertex in dag['vertices']:
            if key(vertex) in shared:
                last.setdefault(key(vertex), (dag, vertex))
                continue
            yield from callback(dag, vertex, node, multi)
            node = vertex['node']
    yield '  # In imu and in vehicle'
    for dag, vertex in last.values():
        yield from callback(dag, vertex, None, multi)
    yield '\npaths:'
    for name, parts in PATHS.items():
        yield f'  - name: {name}\n    callbacks:'
        for dag_name, ids in parts:
            for i in ids:
                yield f"      - '{key(dags[dag_name]['vertices'][i])}'"
    yield ''


def key(vertex: dict[str, Any]) -> str:
    """Return the callback's key."""
    return f'{vertex["node"]}:{vertex["callback"]}'


def callback(
    dag: dict[str, Any], vertex: dict[str, Any], node: str | None, multi: bool
) -> Iterator[str]:
    """Yield the lines of a callback, with those of its node where that is not the one before."""
    name, number = dag['name'], vertex['id']
    if vertex['node'] != node:
        yield f'  - node: {vertex["node"]}\n    callbacks:'
    yield f'      - name: {vertex["callback"]}'
    started_by = [
        topic for topics in TOPICS[name].values() for topic, ids in topics.items()
        if number in ids]
    if not started_by:
        yield f'        timer: {dag["period_us"] // 1000}ms'
        yield f'        dag: {name}'
    elif len(started_by) == 1:
        yield f'        subscription: {started_by[0]}'
    else:
        yield from listing('sync', started_by)
    yield from listing('publishes', list(TOPICS[name].get(number, ())))
    yield from listing('reads', READS.get(name, {}).get(number, []))
    if 'relative_deadline_us' in vertex:
        deadline, why = vertex['relative_deadline_us'] // 1000, ''
        if multi and number in MULTI.get(name, {}):
            deadline, why = MULTI[name][number]
        yield f'        deadline: {deadline}ms' + (f'  # {why}' if why else '')
    quantiles = ', '.join(f'{time:.3f}' for time in vertex['execution_time_us'])
    yield '        execution_time:'
    yield textwrap.fill(
        f'quantiles_us: [{quantiles}]', 99,
        initial_indent=' ' * 10, subsequent_indent=' ' * 12)
    yield '          percent: *percent'


def listing(name: str, items: list[str]) -> Iterator[str]:
    """Yield a list, on one line where it is short."""
    line = f'        {name}: [{", ".join(items)}]'
    if items and len(line) <= 99:
        yield line
    elif items:
        yield f'        {name}:'
        yield from (f'          - {item}' for item in items)


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
