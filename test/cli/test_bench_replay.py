# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `bench replay`: what it measures, on small files; no figure of speed is judged."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mddag_executor.cli import bench_replay
from mddag_executor.cli import main as program
from mddag_executor.cli.slack_check import is_counted, with_times
from mddag_executor.errors import MddagError
from mddag_executor.replay import replay
from mddag_executor.replay.measure import measure, READERS, write_long_trace
from mddag_executor.resources import find
from mddag_executor.trace import TraceReader
from msg_graph import load, loads
from msg_graph.layout import without_lines
import pytest

GRAPH = """\
mddag: 1
workers: 2
nodes:
  - node: /a
    callbacks: [{name: a, timer: 100ms, publishes: [/x, /y], execution_time: 9ms}]
  - node: /b
    callbacks: [{name: b, subscription: /x, publishes: [/z], execution_time: 8ms}]
  - node: /c
    callbacks: [{name: c, sync: [/y, /z], deadline: 90ms, execution_time: 7ms}]
"""


def test_the_long_trace_is_what_an_executor_records(tmp_path: Path) -> None:
    """A replay of it has no doubts: every job complete, every path closed, no warning."""
    path = tmp_path / 'long.mcap'
    count = write_long_trace(str(path), load(find('config/autoware.yaml')), 100_000)
    reader = TraceReader(path)
    assert reader.message_count == count >= 100_000
    outcome = replay(path)
    assert outcome.warnings == []
    for dag in outcome.result()['dags'].values():
        assert dag['jobs'] == sum(dag['ends'].values()) > 0


def test_jobs_go_on_from_one_repetition_to_the_next(tmp_path: Path, graph: Path) -> None:
    path = tmp_path / 'long.mcap'
    write_long_trace(str(path), load(graph), 5000, workers=2)
    jobs = [event[5] for event in TraceReader(path).events({'mddag:job_release'})]
    assert jobs == list(range(len(jobs))) and len(jobs) > 200
    result = replay(path).result()
    response = result['dags']['/a']['sinks']['/c:c']['response_ns']
    assert response['min'] == response['max']


@pytest.mark.parametrize('name', READERS)
def test_every_reader_reads_all(tmp_path: Path, graph: Path, name: str) -> None:
    path = tmp_path / 'long.mcap'
    count = write_long_trace(str(path), load(graph), 1000, workers=2)
    found = measure(name, str(path), 10**9)
    # only this program knows that the declaration is written twice
    assert found.events == count + ('undecoded' in name)
    assert 0 < found.peak_mb < 300 and found.per_s > 0
    path.write_bytes(b'nonsense')
    if name.startswith(('events', 'read', 'replayed')):
        with pytest.raises(MddagError, match='is no MCAP file'):
            measure(name, str(path), 10)


def test_speed_on_the_command_line(
    tmp_path: Path, graph: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / 'out.json'
    assert program.main(['bench', 'replay', '--events', '2000', '--repeat', '1', '--others', '100',
                         '--graph', str(graph), '--json', str(out)]) == 0
    shown = capsys.readouterr().out
    result = json.loads(out.read_text())
    assert list(result['readers']) == list(READERS)
    assert result['readers']['read and linked']['events'] == result['events'] >= 2000
    assert result['readers']['mcap, undecoded']['events'] == 100
    assert all(name in shown for name in READERS)


def test_accuracy_on_the_command_line(
    tmp_path: Path, graph: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With simulated runs instead of live ones, which are predicted exactly."""
    def record(graph: str, args: Any, utilisation: float, workers: int, path: str) -> None:
        write_long_trace(path, load(graph), 3000, workers, utilisation)

    monkeypatch.setattr(bench_replay, '_record', record)
    out = tmp_path / 'out.json'
    arguments = ['bench', 'replay', '--accuracy', '--graph', str(graph), '--repeat', '2',
                 '--utilisation', '0.1', '--workers', '2,3', '--json', str(out)]
    assert program.main(arguments) == 0
    shown = capsys.readouterr().out
    result = json.loads(out.read_text())
    assert result['bodies'] == 'sleep'
    assert [(run['utilisation'], run['workers']) for run in result['runs']] == [
        (0.1, 2), (0.1, 3)] * 2
    same, other = result['summary']
    assert (same['median_error'], same['p99_error'], same['within']) == (0, 0, True)
    # the same utilisation of three workers is more work than was recorded with two
    assert other['median_error'] == pytest.approx(-1 / 3, abs=0.001) and not other['within']
    assert '1 of 1 sinks within 5% of the median and 15% of the p99' in shown
    assert '0 of 1 sinks' in shown and 'predicted from a recording with 2 workers' in shown


def test_a_live_run_is_predicted(tmp_path: Path, graph: Path) -> None:
    """Much nearer than without overheads, which are about as long as these callbacks."""
    graph.write_text(GRAPH.replace('100ms', '20ms').replace('9ms,', '1ms,').replace(
        'execution_time: 9ms', 'execution_time: 200us').replace(
        'execution_time: 8ms', 'execution_time: 200us').replace(
        'execution_time: 7ms', 'execution_time: 200us'))
    out = tmp_path / 'out.json'
    assert program.main([
        'bench', 'replay', '--accuracy', '--graph', str(graph), '--repeat', '1', '--seconds', '2',
        '--utilisation', '0.02', '--workers', '3', '--json', str(out)]) == 0
    run, = json.loads(out.read_text())['runs']
    sink, = run['sinks']
    assert sink['jobs'] > 20
    assert abs(sink['median_error']) < 1  # a few percent where the machine is not busy
    assert sink['ideal_median'] < sink['recorded_median']


@pytest.mark.parametrize(('options', 'says'), [
    (['--accuracy', '--trace', 'a.mcap'], '--accuracy: it records its own runs'),
    (['--trace', 'gone.mcap'], 'gone.mcap: cannot be read'),
    (['--events', '0'], "'0' is no whole number"),
    (['--utilisation', '0.3,x'], "'x' is no number above zero"),
    (['--json', '/gone/a.json'], 'there is no directory /gone'),
])
def test_wrong_options(
    options: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert program.main(['bench', 'replay', *options]) == 2
    output = capsys.readouterr()
    assert output.out == '' and says in output.err and output.err.count('\n') == 1


def test_slack_holds_where_runs_are_simulated(
    graph: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In virtual time instead of live: what is told must happen."""
    def simulated(graph: str, args: Any, utilisation: Any, workers: int, path: str) -> None:
        assert utilisation is None
        assert program.main(['simulate', graph, '--workers', str(workers), '--duration', '3s',
                             '--trace', path, '--overwrite']) == 0

    monkeypatch.setattr(bench_replay, '_record', simulated)
    assert program.main([
        'bench', 'replay', '--slack', '--graph', str(graph), '--utilisation', '0.12',
        '--workers', '2', '--callbacks', '3']) == 0
    out = capsys.readouterr().out
    assert out.endswith('3 of 3 callbacks behave as predicted\n')
    assert 'c:c       10.37 times' in out     # (90 - 9 - 8) / 7
    for arguments, error in (
            (['--slack', '--accuracy'], 'leave it or --accuracy out'),
            (['--slack', '--trace', 'x.mcap'], '--slack: it records its own runs')):
        assert program.main(['bench', 'replay', *arguments]) == 2
        assert error in capsys.readouterr().err


@pytest.mark.parametrize(('late', 'parts', 'told'), [
    (7, {'ran': 80, 'waited': 9}, True), (7, {'ran': 80, 'ran long': 4, 'machine': 2}, True),
    (7, {'ran long': 4, 'released late': 3}, False), (None, {'lost': 4, 'ran long': 9}, True)])
def test_what_a_disturbance_made_late_says_nothing_of_slack(
    late: int | None, parts: dict[str, int], told: bool
) -> None:
    assert told == is_counted({'late_ns': late, 'parts': [
        {'cause': cause, 'ns': took} for cause, took in parts.items()]})


def test_fixed_times_change_nothing_else_of_a_declaration() -> None:
    task_set = load(find('config/autoware.yaml'))
    assert without_lines(loads(with_times(task_set, {}), task_set.file)) == without_lines(task_set)
    odd = loads("""\
mddag: 1
workers: 7
nodes:
  - node: /n
    callbacks:
      - {name: on, timer: 1s, deadline: 1s, execution_time: 1ms, holds_interpreter: true}
      - {name: 0x10, timer: 1s, dag: 'no', deadline: 1s, execution_time: {quantiles_us: [1, 2]}}
      - {name: "1e3", timer: 1s, dag: e, deadline: 1s}
""")
    after = loads(with_times(odd, {'/n:on': 5_000_000, '/n:0x10': 6_000_000, '/n:1e3': 7}))
    assert [each.key for each in after.callbacks] == ['/n:on', '/n:0x10', '/n:1e3']
    assert [each.execution_time and each.execution_time.quantiles_ns
            for each in after.callbacks] == [(5_000_000,), (6_000_000,), (7,)]
    assert (after.workers, after.dags[1].name) == (7, 'no')
