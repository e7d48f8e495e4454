# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0


"""The sample traces in `bags/`: each is replayed, with exactly what the executor counted."""

from __future__ import annotations

from pathlib import Path

from benchmarks import autoware_multi
from mddag_executor.replay import replay, reschedule
from msg_graph import load
import pytest

TOP = Path(__file__).resolve().parent.parent.parent
BAGS = TOP / 'bags'
DEMO = BAGS / 'demo_short.mcap'

# As the executor counted while it ran (`mddag run --json`): completed, late, overdue at the end,
# expired, and the longest response time in ns; by the last part of the sink's name.
COUNTED = {
    'autoware_shift_decider:callback_0': (49, 0, 0, 0, 13602978),
    'pacmod_interface:callback_04': (49, 0, 0, 0, 14112613),
    'ndt_scan_matcher:callback_1': (74, 0, 0, 0, 15314419),
    'twist2accel:callback_0': (74, 1, 0, 0, 23002995),
    'pose_initializer:callback_0': (1, 0, 0, 0, 2020780),
    'ekf_localizer:callback_3@imu': (45, 0, 0, 0, 10583885),
    'twist2accel:callback_1@imu': (45, 0, 0, 0, 10718755),
    'concatenate_data:callback_3': (14, 0, 0, 0, 10737254),
    'ekf_localizer:callback_2': (13, 0, 0, 0, 126358674),
    'map_based_prediction:callback_1': (13, 0, 0, 0, 214626764),
    'external_velocity_limit_selector:callback_1': (14, 0, 0, 0, 104653008),
    'detection_by_tracker_node:callback_0': (13, 0, 0, 0, 173484469),
    'planning_validator:callback_2': (14, 0, 0, 0, 94793434),
    'concatenate_data:callback_5': (14, 0, 0, 0, 10048920),
    'concatenate_data:callback_4': (14, 0, 0, 0, 10829711),
    'concatenate_data:callback_2': (14, 0, 0, 0, 93019950),
    'ekf_localizer:callback_3@vehicle': (45, 0, 0, 0, 10570130),
    'twist2accel:callback_1@vehicle': (45, 0, 0, 0, 10545233),
}
JOBS = {
    'control': 50, 'ekf_localizer': 75, 'gnss': 1, 'imu': 45, 'left_lidar': 15, 'perception': 15,
    'planning': 15, 'rear_lidar': 15, 'right_lidar': 15, 'top_lidar': 15, 'vehicle': 45}
EXECUTIONS = 1934


def test_every_trace_is_told_of_in_the_readme() -> None:
    text = (BAGS / 'README.md').read_text(encoding='utf-8')
    assert [path.name for path in BAGS.glob('*.mcap') if f'`{path.name}`' not in text] == []
    assert 100_000 < DEMO.stat().st_size < 600_000


def test_the_demo_as_recorded() -> None:
    outcome = replay(DEMO)
    assert outcome.warnings == []
    result = outcome.result()
    assert {name: dag['jobs'] for name, dag in result['dags'].items()} == JOBS
    found = {
        name.split('/')[-1]: (
            sink['completed'], sink['late'], sink['overdue'], sink['expired'],
            sink['response_ns']['max'])
        for dag in result['dags'].values() for name, sink in dag['sinks'].items()}
    assert found == COUNTED
    assert sum(use['executions'] for use in result['callbacks'].values()) == EXECUTIONS
    assert result['undeclared']['executions'] == 0
    assert result['dropped'] == {}
    assert (result['policy'], result['workers']) == ('rad', 7)
    assert 0.55 < result['utilisation'] < 0.65
    for dag in result['dags'].values():
        for sink in dag['sinks'].values():
            worst = sink['breakdown']['worst']
            assert worst['unknown_ns'] == 0
            assert worst['completed_ns'] - worst['release_ns'] == sink['response_ns']['max']


def test_the_demo_under_the_shipped_declarations() -> None:
    """The declarations may change; as long as they have these callbacks they can judge."""
    for task_set in (load(TOP / 'config' / 'autoware.yaml'), autoware_multi.task_set()):
        result = replay(DEMO, task_set).result()
        assert {dag: about['jobs'] for dag, about in result['dags'].items()} == JOBS
        completed = {sink.split('/')[-1]: about['completed'] for dag in result['dags'].values()
                     for sink, about in dag['sinks'].items()}
        assert completed == {sink: about[0] for sink, about in COUNTED.items()}


def test_the_demo_rescheduled() -> None:
    """As recorded one job was late, for overheads; four workers would not have been enough."""
    same = reschedule(DEMO)
    assert sum(sink.late for sink in same.tally.sinks.values()) == 1
    assert same.tally.first_miss is not None
    assert same.tally.first_miss['vertex'].endswith('twist2accel:callback_0')
    result = same.result()
    for name, dag in result['dags'].items():
        for sink_name, sink in dag['sinks'].items():
            recorded = result['recorded']['dags'][name]['sinks'][sink_name]['response_ns']
            if sink['completed'] < 40:
                continue
            assert sink['response_ns']['median'] == pytest.approx(recorded['median'], rel=0.05)
    assert not reschedule(DEMO, overheads=False).tally.missed
    four = reschedule(DEMO, workers=4)
    assert four.tally.missed
    again = reschedule(DEMO, workers=4)
    assert four.result() == again.result()
