# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The Autoware workload with a different deadline for each sink of a DAG, on standard output.

The graph is that of ``config/autoware.yaml``. Urgent sinks have shorter deadlines, and no deadline
is below the sum of the 95 % quantiles along its longest path. With one deadline for each DAG (its
latest) the steering chain of control (30 ms) runs behind ekf_localizer (20 ms), and the obstacle
branch of perception runs behind planning (300 ms); with RAD they have 15 ms and 180 ms and run
before them.
"""

from __future__ import annotations

from pathlib import Path

from msg_graph import load, loads, TaskSet
from msg_graph.edit import deadlines_in_text

MS = 1_000_000
# by the end of the sink's key
DEADLINES = {
    'autoware_shift_decider:callback_0': 30,        # the gear: it may take the whole period
    'pacmod_interface:callback_04': 15,             # actuators: half a period; p95 path 5.6 ms
    'ekf_localizer:callback_2': 220,                # late poses make it drift; p95 path 201 ms
    'map_based_prediction:callback_1': 420,         # the longest path; p95 409 ms
    'external_velocity_limit_selector:callback_1': 180,     # the most urgent; p95 path 154 ms
    'detection_by_tracker_node:callback_0': 500,    # for a later frame; p95 path 313 ms
    'ekf_localizer:callback_3': 20,                 # it runs every 20 ms; p95 path 0.4 ms
    'twist2accel:callback_1': 33,                   # the whole period will do
}


def task_set() -> TaskSet:
    """Return the task set."""
    plain = load(Path(__file__).parents[1] / 'config' / 'autoware.yaml')
    deadlines = {
        vertex.callback.key: ms * MS for vertex in plain.vertices for end, ms in DEADLINES.items()
        if vertex.callback.key.endswith(end)}
    assert len(deadlines) == len(DEADLINES)
    return loads(deadlines_in_text(plain, plain.text, deadlines), 'autoware_multi.yaml')


if __name__ == '__main__':
    print(task_set().text, end='')
