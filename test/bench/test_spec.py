# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

from typing import Any

from mddag_executor.errors import MddagError
from mddag_executor.executor.bench.campaign import combine, parse_executors, Spec
import pytest


def test_a_measurement_survives_its_text() -> None:
    spec = Spec('topics', 'rad-events', policy='fifo', topics=3, rate_hz=2.5, seed=4)
    assert Spec.from_json(spec.to_json()) == spec
    assert spec.name == 'rad-events:fifo'
    assert Spec('topics', 'multi').name == 'multi'


def test_executors_and_policies_by_name() -> None:
    assert parse_executors('rad-events, multi') == [('rad-events', 'rad'), ('multi', 'rad')]
    assert parse_executors('rad-waitset:wc,events,rad-events', 'rm,gedf') == [
        ('rad-waitset', 'wc'), ('events', 'rad'), ('rad-events', 'rm'), ('rad-events', 'gedf')]


@pytest.mark.parametrize(('executors', 'policies', 'text'), [
    ('rad', None, "--executors: 'rad' is unknown"),
    ('', None, "--executors: '' is unknown"),
    ('multi:fifo', None, 'only this executor knows policies'),
    ('rad-events:fast', None, 'fast'),
    ('rad-events', 'fast', 'fast'),
    ('multi,multi', None, 'stands there twice'),
    ('rad-events:rm,rad-events', 'rad,rm', 'stands there twice'),
    ('multi', 'rm', '--policies: '),
])
def test_wrong_executors_are_one_line(executors: str, policies: str | None, text: str) -> None:
    with pytest.raises(MddagError) as caught:
        parse_executors(executors, policies)
    assert text in str(caught.value)
    assert '\n' not in str(caught.value)


def declared(on_time: int, cpu: float, p99: float) -> dict[str, Any]:
    return {
        'utilisation': 0.6, 'sink_jobs_due': 100, 'on_time': on_time, 'late': 100 - on_time,
        'missing': 0, 'on_time_ratio': on_time / 100, 'callbacks_per_s': 10.0,
        'cpu_us_per_callback': cpu, 'dispatch_latency_us': {'p50': 1.0, 'p99': p99, 'max': 9.0},
        'hot_path_us': None, 'dags': {}}


def test_repetitions_give_medians() -> None:
    spec = Spec('autoware', 'multi', utilisation=0.6, graph='x.yaml')
    runs = [declared(50, 30.0, 3.0), declared(90, 10.0, 5.0), declared(70, 80.0, 4.0)]
    result = combine(spec, runs, repeat=3)
    assert result['executor'] == 'multi'
    assert result['utilisation'] == 0.6
    assert (result['on_time'], result['on_time_ratio']) == (70, 0.7)
    assert result['cpu_us_per_callback'] == 30.0
    assert result['dispatch_latency_us'] == {'p50': 1.0, 'p99': 4.0, 'max': 9.0}
    assert result['crashed'] == 0
    assert [run['on_time'] for run in result['runs']] == [50, 90, 70]
    assert 'dags' not in result['runs'][0]


def test_messages_are_counted_over_all_repetitions() -> None:
    def run(published: int, received: int) -> dict[str, Any]:
        return {
            'callbacks_per_s': 1.0, 'cpu_us_per_callback': None, 'dispatch_latency_us': None,
            'published': published, 'received': received, 'lost': published - received}

    # The median of the losses would be 0.
    result = combine(Spec('topics', 'multi'), [run(10, 10), run(10, 3), run(10, 10)], repeat=3)
    assert (result['published'], result['received'], result['lost']) == (30, 23, 7)
    assert result['sink_jobs_due'] is None
    assert result['on_time_ratio'] is None
    assert result['cpu_us_per_callback'] is None


def test_what_never_succeeded_has_no_figures() -> None:
    result = combine(Spec('topics', 'events'), [], repeat=2)
    assert result['crashed'] == 2
    assert result['dispatch_latency_us'] is None
    assert result['callbacks_per_s'] is None
    assert (result['published'], result['lost']) == (0, 0)
