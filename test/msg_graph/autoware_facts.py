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
    """A DAG: times in ms, edges as `before-after`."""

    period: int
    deadlines: dict[int, int]
    edges: str
    times_ns: tuple[int, int, int, int]
    """Sums over the vertices of the least, median, 95 % and largest execution time."""


DAGS = {
    'control': Facts(
        30, {1: 30, 4: 30},
        '0-1 0-2 2-3 3-4',
        (807903, 2920638, 5747682, 39062613)),
    'ekf_localizer': Facts(
        20, {1: 20, 3: 20},
        '0-1 0-2 2-3',
        (423658, 1835160, 4495333, 72194902)),
    'gnss': Facts(
        1000, {1: 1000},
        '0-1',
        (357721, 528364, 1664455, 7632621)),
    'imu': Facts(
        33, {2: 33, 3: 33},
        '0-1 1-2 1-3',
        (112438, 284140, 443487, 11996958)),
    'left_lidar': Facts(
        100, {5: 50},
        '0-1 1-2 2-3 3-4 4-5',
        (1144142, 2292181, 17157469, 111459736)),
    'perception': Facts(
        100, {15: 300, 29: 300, 30: 300, 33: 300},
        '0-1 1-2 0-3 0-4 0-5 2-9 2-12 3-8 9-8 8-12 4-6 5-7 7-13 13-14 14-15 6-10 12-7 12-27 '
        '27-30 7-11 11-10 11-31 11-26 26-25 31-23 25-23 23-18 23-24 18-32 32-19 24-22 22-18 '
        '18-17 17-16 10-16 16-19 19-20 20-21 21-28 28-33 28-29',
        (16458702, 227287426, 566723492, 1774635385)),
    'planning': Facts(
        100, {8: 300},
        '0-1 1-2 2-3 3-4 4-5 5-6 6-7 7-8',
        (5803639, 107104443, 234927906, 766971240)),
    'rear_lidar': Facts(
        100, {5: 50},
        '0-1 1-2 2-3 3-4 4-5',
        (320769, 620889, 11191586, 83748921)),
    'right_lidar': Facts(
        100, {5: 50},
        '0-1 1-2 2-3 3-4 4-5',
        (1229037, 2347447, 19887237, 107568512)),
    'top_lidar': Facts(
        100, {5: 100},
        '0-1 1-2 2-3 3-4 4-5',
        (31166006, 74348754, 140170156, 479285918)),
    'vehicle': Facts(
        33, {2: 33, 3: 33},
        '0-1 1-2 1-3',
        (107797, 248618, 409208, 16251888)),
}
