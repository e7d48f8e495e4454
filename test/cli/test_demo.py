# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0

import json

import pytest


@pytest.mark.slow
def test_the_main_job_end_to_end(tmp_path, mddag):
    process = mddag('demo', '--duration', '3s', '--utilisation', '0.3', '--output', tmp_path,
                    '--json', tmp_path / 'all.json', timeout=150.0)
    assert process.returncode == 0, process.stderr
    # On a busy machine periods are skipped and predictions are off, which is reported.
    for line in process.stderr.splitlines():
        assert line.startswith('[WARN] ') or 'with the recorded pool the prediction' in line, line
    live, recorded, rescheduled, every = (
        json.loads((tmp_path / f'{name}.json').read_text())
        for name in ('run', 'recorded', 'rescheduled', 'all'))
    assert len(live['dags']) == 11
    assert every['live'] == live and every['baseline']['sink_jobs_due'] > 100
    # What the replayer counts is exactly what the executor counted.
    assert 'counts what the executor counted, for 18 of 18 sinks.' in process.stdout
    assert recorded['dags'].keys() == rescheduled['dags'].keys() == live['dags'].keys()
    assert live['never_ran'] == []
    measured = live['measured']
    assert (measured['seed'], measured['attribution']) == (0, {'wrong': 0, 'none': 0})
    assert measured['utilisation'] == pytest.approx(0.3, abs=0.001)
    for same in ('seed', 'workers', 'utilisation'):     # as rclpy's executor got it
        assert every['baseline'][same] == measured[same]
    assert every['baseline']['on_time'] > 0
    verdicts = measured['on_time'] + measured['late'] + measured['missing']
    assert verdicts == measured['sink_jobs_due'] > 200
    assert (tmp_path / 'demo.mcap').read_bytes()[:5] == b'\x89MCAP'
    for text in ('$ mddag run ', '$ mddag replay ', 'MultiThreadedExecutor', 'measured for',
                 'CPU per callback'):
        assert text in process.stdout


def test_a_step_that_fails_is_one_line(tmp_path, mddag):
    trace = tmp_path / 'a folder' / 'demo.mcap'
    trace.mkdir(parents=True)  # it cannot be written
    process = mddag('demo', '--duration', '1s', '--output', trace.parent)
    assert process.returncode == 2
    assert process.stderr == f'error: mddag run: {trace}: this is a directory: name a file\n'
    assert f" --trace '{trace}' " in process.stdout  # as a shell needs it
