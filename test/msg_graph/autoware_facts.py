# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The facts of the paper's workload that `config/autoware.yaml` must give.

They are those of the public evaluation repository 2024_RTSS_WiP_Evaluation of Yano and Azumi
(RTSS 2024 work in progress).
"""

from __future__ import annotations

from typing import NamedTuple


class Facts(NamedTuple):
    """A DAG: times in ms, edges as `before-after`, callbacks by index."""

    period: int
    deadlines: dict[int, int]
    edges: str
    times_ns: tuple[int, int, int, int]
    """Sums over the vertices of the least, median, 95 % and largest execution time."""
    callbacks: str


DAGS = {
    'control': Facts(
        30, {1: 30, 4: 30},
        '0-1 0-2 2-3 3-4',
        (807903, 2920638, 5747682, 39062613),
        """
        /control/trajectory_follower/controller_node_exe:callback_1
        /control/autoware_shift_decider:callback_0
        /control/vehicle_cmd_gate:callback_16
        /raw_vehicle_cmd_converter:callback_2
        /pacmod_interface:callback_04
        """),
    'ekf_localizer': Facts(
        20, {1: 20, 3: 20},
        '0-1 0-2 2-3',
        (423658, 1835160, 4495333, 72194902),
        """
        /localization/pose_twist_fusion_filter/ekf_localizer:callback_1
        /localization/pose_estimator/ndt_scan_matcher:callback_1
        /localization/pose_twist_fusion_filter/stop_filter:callback_0
        /localization/pose_twist_fusion_filter/twist2accel:callback_0
        """),
    'gnss': Facts(
        1000, {1: 1000},
        '0-1',
        (357721, 528364, 1664455, 7632621),
        """
        /sensing/gnss/gnss_poser:callback_1
        /localization/util/pose_initializer:callback_0
        """),
    'imu': Facts(
        33, {2: 33, 3: 33},
        '0-1 1-2 1-3',
        (112438, 284140, 443487, 11996958),
        """
        /sensing/imu/imu_corrector:callback_0
        /localization/twist_estimator/gyro_odometer:callback_1
        /localization/pose_twist_fusion_filter/ekf_localizer:callback_3
        /localization/pose_twist_fusion_filter/twist2accel:callback_1
        """),
    'left_lidar': Facts(
        100, {5: 50},
        '0-1 1-2 2-3 3-4 4-5',
        (1144142, 2292181, 17157469, 111459736),
        """
        /sensing/lidar/left/velodyne_driver_ros_wrapper_node:callback_0
        /sensing/lidar/left/crop_box_filter_self:callback_0
        /sensing/lidar/left/crop_box_filter_mirror:callback_0
        /sensing/lidar/left/distortion_corrector_node:callback_2
        /sensing/lidar/left/ring_outlier_filter:callback_0
        /sensing/lidar/concatenate_data:callback_3
        """),
    'perception': Facts(
        100, {15: 300, 29: 300, 30: 300, 33: 300},
        '0-1 1-2 0-3 0-4 0-5 2-9 2-12 3-8 9-8 8-12 4-6 5-7 7-13 13-14 14-15 6-10 12-7 12-27 '
        '27-30 7-11 11-10 11-31 11-26 26-25 31-23 25-23 23-18 23-24 18-32 32-19 24-22 22-18 '
        '18-17 17-16 10-16 16-19 19-20 20-21 21-28 28-33 28-29',
        (16458702, 227287426, 566723492, 1774635385),
        """
        /sensing/lidar/concatenate_data:callback_1
        /perception/obstacle_segmentation/crop_box_filter:callback_0
        /perception/obstacle_segmentation/common_ground_filter:callback_0
        /perception/occupancy_grid_map/raw_pc_downsample_filter:callback_0
        /perception/object_recognition/detection/pointpainting/pointpainting:callback_14
        /localization/util/crop_box_filter_measurement_range:callback_0
        /perception/object_recognition/detection/roi_detected_object_fusion:callback_13
        /localization/util/voxel_grid_downsample_filter:callback_0
        /perception/occupancy_grid_map/occupancy_grid_map_node:callback_0
        /perception/occupancy_grid_map/obstacle_pc_downsample_filter:callback_0
        /perception/object_recognition/detection/obstacle_pointcloud_based_validator_node:callback_1
        /perception/object_recognition/detection/voxel_based_compare_map_filter:callback_1
        /perception/obstacle_segmentation/occupancy_grid_based_outlier_filter:callback_1
        /localization/util/random_downsample_filter:callback_0
        /localization/pose_estimator/ndt_scan_matcher:callback_2
        /localization/pose_twist_fusion_filter/ekf_localizer:callback_2
        /perception/object_recognition/detection/object_association_merger_autoware_ecu_373458_2520929050865267140:callback_1
        /perception/object_recognition/detection/clustering/camera_lidar_fusion/detected_object_feature_remover:callback_0
        /perception/object_recognition/detection/clustering/shape_estimation:callback_0
        /perception/object_recognition/detection/object_association_merger_autoware_ecu_373458_2698618723653090675:callback_0
        /perception/object_recognition/detection/object_lanelet_filter:callback_0
        /perception/object_recognition/tracking/multi_object_tracker:callback_3
        /perception/object_recognition/detection/clustering/camera_lidar_fusion/low_intensity_cluster_filter_node:callback_0
        /perception/object_recognition/detection/clustering/cluster_merger:callback_0
        /perception/object_recognition/detection/clustering/camera_lidar_fusion/roi_cluster_fusion:callback_13
        /perception/object_recognition/detection/clustering/euclidean_cluster:callback_0
        /perception/object_recognition/detection/clustering/low_height_crop_box_filter:callback_0
        /planning/scenario_planning/lane_driving/motion_planning/surround_obstacle_checker:callback_4
        /perception/object_recognition/tracking/decorative_tracker_merger_autoware_ecu_373458_2496151694788268076:callback_0
        /perception/object_recognition/prediction/map_based_prediction:callback_1
        /planning/scenario_planning/external_velocity_limit_selector:callback_1
        /perception/object_recognition/detection/clustering/roi_cluster/roi_pointcloud_fusion:callback_13
        /perception/object_recognition/detection/detection_by_tracker/detection_by_tracker_node:callback_1
        /perception/object_recognition/detection/detection_by_tracker/detection_by_tracker_node:callback_0
        """),
    'planning': Facts(
        100, {8: 300},
        '0-1 1-2 2-3 3-4 4-5 5-6 6-7 7-8',
        (5803639, 107104443, 234927906, 766971240),
        """
        /planning/scenario_planning/lane_driving/behavior_planning/behavior_path_planner:callback_00
        /planning/scenario_planning/lane_driving/behavior_planning/behavior_velocity_planner:callback_13
        /planning/scenario_planning/lane_driving/motion_planning/elastic_band_smoother:callback_1
        /planning/scenario_planning/lane_driving/motion_planning/path_optimizer:callback_1
        /planning/scenario_planning/lane_driving/motion_planning/motion_velocity_planner:callback_7
        /planning/scenario_planning/lane_driving/motion_planning/obstacle_cruise_planner:callback_3
        /planning/scenario_planning/scenario_selector:callback_1
        /planning/scenario_planning/velocity_smoother:callback_4
        /planning/planning_validator:callback_2
        """),
    'rear_lidar': Facts(
        100, {5: 50},
        '0-1 1-2 2-3 3-4 4-5',
        (320769, 620889, 11191586, 83748921),
        """
        /sensing/lidar/rear/velodyne_driver_ros_wrapper_node:callback_0
        /sensing/lidar/rear/crop_box_filter_self:callback_0
        /sensing/lidar/rear/crop_box_filter_mirror:callback_0
        /sensing/lidar/rear/distortion_corrector_node:callback_2
        /sensing/lidar/rear/ring_outlier_filter:callback_0
        /sensing/lidar/concatenate_data:callback_5
        """),
    'right_lidar': Facts(
        100, {5: 50},
        '0-1 1-2 2-3 3-4 4-5',
        (1229037, 2347447, 19887237, 107568512),
        """
        /sensing/lidar/right/velodyne_driver_ros_wrapper_node:callback_0
        /sensing/lidar/right/crop_box_filter_self:callback_0
        /sensing/lidar/right/crop_box_filter_mirror:callback_0
        /sensing/lidar/right/distortion_corrector_node:callback_2
        /sensing/lidar/right/ring_outlier_filter:callback_0
        /sensing/lidar/concatenate_data:callback_4
        """),
    'top_lidar': Facts(
        100, {5: 100},
        '0-1 1-2 2-3 3-4 4-5',
        (31166006, 74348754, 140170156, 479285918),
        """
        /sensing/lidar/top/velodyne_driver_ros_wrapper_node:callback_0
        /sensing/lidar/top/crop_box_filter_self:callback_0
        /sensing/lidar/top/crop_box_filter_mirror:callback_0
        /sensing/lidar/top/distortion_corrector_node:callback_2
        /sensing/lidar/top/ring_outlier_filter:callback_0
        /sensing/lidar/concatenate_data:callback_2
        """),
    'vehicle': Facts(
        33, {2: 33, 3: 33},
        '0-1 1-2 1-3',
        (107797, 248618, 409208, 16251888),
        """
        /sensing/vehicle_velocity_converter:callback_0
        /localization/twist_estimator/gyro_odometer:callback_0
        /localization/pose_twist_fusion_filter/ekf_localizer:callback_3
        /localization/pose_twist_fusion_filter/twist2accel:callback_1
        """),
}
