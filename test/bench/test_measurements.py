# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Each load for about a second, under this executor and one of rclpy's.

The figures are checked for their structure and for what has to add up, never for time.
"""

from __future__ import annotations

from collections.abc import Callable
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from types import SimpleNamespace
from typing import Any

from mddag_executor.executor.bench import campaign, publisher
from mddag_executor.executor.bench.campaign import BenchError, CrashError, measure, run_all, Spec
from mddag_executor.resources import find
from msg_graph import load
import pytest

Mddag = Callable[..., subprocess.CompletedProcess[str]]

KEYS = {'executor', 'utilisation', 'sink_jobs_due', 'on_time', 'on_time_ratio', 'callbacks_per_s',
        'cpu_us_per_callback', 'dispatch_latency_us'}


def check_latency(latency: dict[str, float]) -> None:
    assert list(latency) == ['p50', 'p99', 'max']
    assert 0 < latency['p50'] <= latency['p99'] <= latency['max']


def check_messages(result: dict[str, Any]) -> None:
    assert result['published'] == result['received'] + result['lost']
    assert result['published'] > 0
    assert 0 <= result['lost'] < result['published']
    check_latency(result['dispatch_latency_us'])
    assert result['cpu_us_per_callback'] > 0


def descendants(pid: int) -> list[int]:
    found = []
    for child in Path(f'/proc/{pid}/task/{pid}/children').read_text().split():
        found += [int(child), *descendants(int(child))]
    return found


def running(pid: int) -> bool:
    try:
        return ') Z ' not in Path(f'/proc/{pid}/stat').read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.parametrize('executor', ['rad-events', 'rad-waitset', 'single', 'events'])
def test_topics_count_every_message(executor: str) -> None:
    result = measure(Spec(
        'topics', executor, topics=5, rate_hz=40.0, seconds=0.5, warm_up_s=0.2))
    check_messages(result)
    assert result['callbacks'] <= result['received']
    dds = result['middleware_cpu_us_per_callback']
    assert dds is None or 0 <= dds < result['cpu_us_per_callback']


def test_every_executor_is_offered_the_same(tmp_path: Path, mddag: Mddag) -> None:
    output = tmp_path / 'out.json'
    process = mddag(
        'bench', 'live', '--load', 'topics', '--topics', '4', '--rate', '50', '--seconds', '0.5',
        '--executors', 'rad-events,single', '--policies', 'rad,fifo', '--json', output,
        timeout=120.0)
    assert process.returncode == 0, process.stderr
    assert process.stderr == ''
    results = json.loads(output.read_text())
    assert [result['executor'] for result in results] == [
        'rad-events', 'rad-events:fifo', 'single']
    for result in results:
        assert set(result) > KEYS
        assert (result['topics'], result['rate_hz'], result['utilisation']) == (4, 50.0, None)
        check_messages(result)
    assert process.stdout.splitlines()[0].split()[:5] == [
        'topics', 'rate', 'executor', 'published', 'lost']


class VirtualStop:
    """Says after a time of a virtual clock that it is time to stop."""

    def __init__(self, after_ns: int) -> None:
        self.now, self.end = 0, after_ns

    def wait(self, seconds: float) -> bool:
        self.now = min(self.end, self.now + round(seconds * 1e9))
        return self.now >= self.end


@pytest.mark.parametrize('seed', [None, 1])
def test_topics_are_published_in_rows_or_at_drawn_phases(
    seed: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop: Any = VirtualStop(1_000_000_000)
    monkeypatch.setattr(publisher, 'time', SimpleNamespace(monotonic_ns=lambda: stop.now))
    published: list[tuple[int, int]] = []
    topics: Any = [SimpleNamespace(publish=lambda _, index=index: published.append(
        (stop.now, index))) for index in range(5)]
    assert publisher.publish(topics, 20.0, seed, stop.wait) == [20] * 5
    times = [time for time, _ in published]
    if seed is None:
        assert [index for _, index in published] == [0, 1, 2, 3, 4] * 20
        assert len(set(times)) == 20
    else:
        assert len(set(times)) == 100


def test_topics_that_are_published_together(mddag: Mddag) -> None:
    process = mddag(
        'bench', 'live', '--load', 'topics', '--topics', '5', '--rate', '20', '--seconds', '0.5',
        '--executors', 'single', '--phases', 'together', '--json', '-', timeout=120.0)
    assert process.returncode == 0, process.stderr
    result, = json.loads(process.stdout)
    assert result['phases'] == 'together'
    check_messages(result)


def test_entities_have_idle_neighbours(mddag: Mddag) -> None:
    process = mddag(
        'bench', 'live', '--load', 'entities', '--idle', '0,20', '--seconds', '0.5',
        '--executors', 'rad-events,single', '--json', '-', timeout=120.0)
    assert process.returncode == 0, process.stderr
    results = json.loads(process.stdout)
    assert [(result['idle'], result['executor']) for result in results] == [
        (0, 'rad-events'), (0, 'single'), (20, 'rad-events'), (20, 'single')]
    for result in results:
        assert result['topics'] == 1
        check_messages(result)


@pytest.mark.slow
def test_autoware_is_judged_by_its_nodes(mddag: Mddag) -> None:
    process = mddag(
        'bench', 'live', '--load', 'autoware', '--utilisation', '0.3', '--seconds', '1',
        '--executors', 'rad-events,single', '--repeat', '2', '--json', '-',
        timeout=120.0)
    assert process.returncode == 0, process.stderr
    results = json.loads(process.stdout)
    assert [result['executor'] for result in results] == ['rad-events', 'single']
    for result in results:
        assert set(result) > KEYS
        assert result['utilisation'] == pytest.approx(0.3, abs=0.001)
        assert Path(result['graph']).name == 'autoware.yaml'
        assert result['on_time_ratio'] == result['on_time'] / result['sink_jobs_due']
        check_latency(result['dispatch_latency_us'])
        assert len(result['runs']) == 2
        for run in result['runs']:
            verdicts = run['on_time'] + run['late'] + run['missing']
            assert verdicts == run['sink_jobs_due'] > 200
            assert run['attribution'] == {'wrong': 0, 'none': 0}


def test_nodes_run_without_an_executor() -> None:
    graph = str(find('config/autoware.yaml'))
    result = measure(Spec(
        'autoware', 'none', graph=graph, utilisation=0.1, seconds=1.0, warm_up_s=0.5))
    assert result['on_time'] > 0.5 * result['sink_jobs_due'] > 100
    assert 0 < result['cpu_us_per_callback']
    check_latency(result['dispatch_latency_us'])


@pytest.mark.parametrize('executor', ['rad-waitset', 'multi'])
def test_the_reference_system_has_a_hot_path(executor: str) -> None:
    graph = str(find('config/reference_system.yaml'))
    result = measure(Spec('reference-system', executor, graph=graph, seconds=1.0))
    hot = result['hot_path_us']
    assert 0 <= hot['missing'] <= hot['due']
    assert hot['due'] >= 8
    if hot['missing'] < hot['due']:
        # The longest chain: seven bodies of 10 ms.
        assert 70_000 * 0.95 < hot['p50'] <= hot['p99'] <= hot['max']
    check_latency(result['dispatch_latency_us'])
    assert result['sink_jobs_due'] == result['on_time'] + result['late'] + result['missing']


def test_the_reference_system_as_described() -> None:
    task_set = load(str(find('config/reference_system.yaml')))
    callbacks = task_set.callbacks
    assert len({callback.node for callback in callbacks}) == 24
    timers = {c.node: c.timer_period_ns for c in callbacks if c.kind == 'timer'}
    assert sorted(timers.values()) == [ms * 1_000_000 for ms in (25, 60, 100, 100, 100, 100, 120)]
    planner = [c for c in callbacks if c.node == '/BehaviorPlanner']
    assert sorted(c.kind for c in planner) == ['subscription'] * 6 + ['timer']
    busy = [c for c in callbacks if c.execution_time is not None]
    assert {c.execution_time.mean_ns for c in busy if c.execution_time} == {10_000_000}
    path, = task_set.paths
    assert len([key for key in path.callbacks if key in {c.key for c in busy}]) == 7


def test_dispatch_latency_of_timers_is_counted(tmp_path: Path) -> None:
    # One DAG of a timer only: without timers there would be nothing.
    graph = tmp_path / 'timer.yaml'
    graph.write_text(
        'mddag: 1\nnodes:\n- node: /a\n  callbacks:\n'
        '  - {name: c, timer: 20ms, deadline: 9ms}\n')
    for executor in ('rad-events', 'single'):
        result = measure(Spec(
            'autoware', executor, graph=str(graph), seconds=0.5, warm_up_s=0.2))
        check_latency(result['dispatch_latency_us'])
        assert result['hot_path_us'] is None


def test_a_hanging_executor_is_killed() -> None:
    before = set(descendants(os.getpid()))  # other tests may have left helpers of Python's own
    with pytest.raises(CrashError, match='events: it did not end within 2 s and was killed'):
        measure(Spec('topics', 'events', seconds=30.0), patience_s=-29.0)
    end = time.monotonic() + 5.0  # the kernel may take a moment over it
    while [p for p in descendants(os.getpid()) if p not in before and running(p)]:
        assert time.monotonic() < end
        time.sleep(0.05)


def test_one_crash_does_not_end_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    def crash_or_measure(spec: Spec, tick: Any = None) -> dict[str, Any]:
        if spec.executor == 'events':
            raise CrashError('events: it crashed with signal 11')
        return measure(spec, tick)

    monkeypatch.setattr(campaign, 'measure', crash_or_measure)
    crashing = Spec('topics', 'events')
    fine = Spec('topics', 'single', seconds=0.3, warm_up_s=0.1)
    errors: list[str] = []
    results = run_all([crashing, fine], 1, lambda *_: None, errors.append)
    assert [result['crashed'] for result in results] == [1, 0]
    assert errors == ['events: it crashed with signal 11']
    check_messages(results[1])
    with pytest.raises(BenchError, match='no measurement succeeded'):
        run_all([crashing], 1, lambda *_: None, errors.append)


def test_a_measurement_that_cannot_be_made_ends_all() -> None:
    with pytest.raises(BenchError, match='/none.yaml: '):
        measure(Spec('autoware', 'single', graph='/none.yaml'))


@pytest.mark.parametrize('executor', ['rad-events', 'events'])
def test_declared_processes_are_measured_as_one_run(tmp_path: Path, executor: str) -> None:
    graph = tmp_path / 'graph.yaml'
    graph.write_text("""
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: t, timer: 20ms, publishes: [/x], execution_time: 1ms}]}
  - {node: /b, callbacks: [{name: s, subscription: /x, deadline: 500ms, execution_time: 1ms}]}
processes: {one: [/a], two: [/b]}
""")
    result = measure(Spec('autoware', executor, graph=str(graph), seconds=1.0, warm_up_s=0.2))
    assert 0 < result['on_time'] <= result['sink_jobs_due']
    # what waited 0.1 s for its announcement, as on a busy machine, is of no job
    assert result['attribution']['wrong'] == 0
    assert result['attribution']['none'] < result['sink_jobs_due'] / 2
    assert result['dispatch_latency_us'] is not None and result['callbacks'] > 0


def test_what_native_code_prints_is_no_result() -> None:
    # rclpy's EventsExecutor prints a warning about a clock with many timers.
    graph = str(find('config/autoware.yaml'))
    result = measure(Spec(
        'autoware', 'events', graph=graph, utilisation=0.3, seconds=0.5, warm_up_s=0.2))
    assert result['sink_jobs_due'] == result['on_time'] + result['late'] + result['missing'] > 0


def test_nothing_outlives_a_killed_bench() -> None:
    process = subprocess.Popen(
        [sys.executable, '-m', 'mddag_executor', 'bench', 'live', '--load', 'topics', '--topics',
         '2', '--rate', '10', '--seconds', '60', '--executors', 'events'],
        stdout=subprocess.DEVNULL)
    try:
        end = time.monotonic() + 30
        while len(children := descendants(process.pid)) < 2:
            assert time.monotonic() < end
            time.sleep(0.05)
        time.sleep(0.5)
        process.send_signal(signal.SIGKILL)
        process.wait()
        end = time.monotonic() + 10
        while left := [pid for pid in children if running(pid)]:
            assert time.monotonic() < end, left
            time.sleep(0.05)
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize(('arguments', 'text'), [
    (['--load', 'none'], "argument --load: invalid choice: 'none'"),
    (['--load', 'autoware', '--topics', '3'], '--topics: it means nothing to --load autoware'),
    (['--load', 'topics', '--utilisation', '0.3'], '--utilisation: it means nothing'),
    (['--load', 'topics', '--executors', 'foo'], "--executors: 'foo' is unknown"),
    (['--load', 'topics', '--executors', 'none'], '--executors: none: not with --load topics'),
    (['--load', 'autoware', '--executors', 'none:rad'], 'only this executor knows policies'),
    (['--load', 'autoware', '--phases', 'drawn'], '--phases: it means nothing to --load autoware'),
    (['--load', 'entities', '--idle', '1,-1'], "argument --idle: '-1' is no whole number"),
    (['--load', 'autoware', '--graph', '/none.yaml'], '/none.yaml: '),
    (['--load', 'topics', '--json', '/none/x'], '/none/x: there is no directory /none'),
])
def test_a_wrong_command_line_is_one_line(call: Mddag, arguments: list[str], text: str) -> None:
    process = call('bench', 'live', *arguments)
    assert process.returncode == 2
    assert process.stderr.startswith('error: ')
    assert text in process.stderr
    assert process.stderr.count('\n') == 1


def test_the_help_shows_an_example(mddag: Mddag) -> None:
    process = mddag('bench', 'live', '--help')
    assert process.returncode == 0
    assert 'mddag bench live --load topics' in process.stdout


@pytest.mark.parametrize('executor', ['rad-events', 'events'])
def test_the_robots_nodes_are_judged_by_their_own_stamps(executor: str) -> None:
    graph = str(find('examples/robot/graph.yaml'))
    result = measure(Spec('robot', executor, graph=graph, seconds=1.0, scale=0.2))
    assert list(result['sinks']) == [
        dag.vertices[i].name for dag in load(graph).dags for i in dag.sinks]
    assert result['sink_jobs_due'] == sum(s['due'] for s in result['sinks'].values()) > 100
    assert result['on_time'] > 0
    for sink in result['sinks'].values():
        assert sink['on_time'] + sink['late'] + sink['missing'] == sink['due']
