# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""`mddag simulate`: judged and rescheduled as it was, and disks that get full."""

import errno
import os
from pathlib import Path
import resource
import sys

from mddag_executor import open_recording
import pytest

GRAPH = """\
mddag: 1
workers: 2
nodes:
  - node: /sensing/driver
    callbacks:
      - {name: tick, timer: 10ms, publishes: [/points], dag: lidar, execution_time: 2ms}
  - node: /filter
    callbacks:
      - {name: near, subscription: /points, deadline: 5ms, execution_time: 1ms}
      - {name: far, subscription: /points, deadline: 12ms, execution_time: 8ms}
"""


def sinks(result):
    return {name: (sink['completed'], sink['late'], sink['overdue'])
            for name, sink in result['dags']['lidar']['sinks'].items()}


def test_what_is_asked_for_is_done(call, graph):
    """
    One worker, 11 ms of work each 10 ms: near is late from job 3 on (36 ms), far from job 2 on.

    Job k: tick from 11k, near done at 11k + 3, far at 11k + 11.
    """
    simulate = ('simulate', graph, '--workers', 1, '--duration', '100ms', '--json', '-')
    assert sinks(call(*simulate).result)['/filter:near'] == (9, 7, 1)
    judged = call(*simulate, '--judge', 'completions').result
    assert sinks(judged)['/filter:near'] == (9, 6, 0)
    stopped = call(*simulate, '--stop-at-first-miss').result
    assert stopped['ended_ns'] == stopped['first_miss']['completed_ns'] == 33_000_000
    # With more time for far the next tick goes before it: late are the jobs 3 to 7 only; with
    # preemption near does not wait.
    graph.write_text(GRAPH.replace('12ms', '60ms'))
    for option, late in ((), 5), (('--preemptive',), 0):
        assert sinks(call(*simulate, *option).result)['/filter:near'][1] == late


@pytest.mark.parametrize('on_late', ['continue', 'demote'])
def test_late_jobs_are_rescheduled_as_they_were_treated(call, graph, on_late):
    simulated = call('simulate', graph, '--workers', 1, '--duration', '200ms', '--on-late',
                     on_late, '--trace', 'run.mcap', '--json', '-').result
    again = call('replay', 'run.mcap', '--reschedule', '--json', '-').result
    assert again['on_late'] == on_late
    assert [each[:2] for each in sinks(again).values()] == [
        each[:2] for each in sinks(simulated).values()]


@pytest.mark.parametrize(('command', 'most'), [
    ('simulate graph.yaml --duration 20s --trace out.mcap', 100_000),
    ('export run.mcap -o tables/', 1_000), ('export run.mcap -o out.csv', 1_000),
    ('generate --sets 3 -o sets', 1_000)])
def test_a_disk_that_gets_full_is_one_line_and_leaves_nothing(
        graph, call, mddag, command, most, monkeypatch):
    # else Python would leave only the begin of compiled modules in __pycache__
    monkeypatch.setenv('PYTHONDONTWRITEBYTECODE', '1')
    if 'tables' in command:
        pytest.importorskip('pyarrow', reason='pyarrow is not installed')
    assert call('simulate', graph, '--duration', '2s', '--trace', 'run.mcap').returncode == 0
    before = sorted(graph.parent.iterdir())
    done = mddag(*command.split(), preexec_fn=lambda: resource.setrlimit(
        resource.RLIMIT_FSIZE, (most, most)))
    assert (done.returncode, done.stderr.count('\n')) == (2, 1)
    assert done.stderr.startswith(f'error: {command.split()[-1]}: ')
    assert os.strerror(errno.EFBIG)[1:] in done.stderr
    assert 'trace' not in done.stdout and sorted(graph.parent.iterdir()) == before


def test_a_timer_without_a_deadline_starts_within_ten_of_its_periods(call, folder):
    """Also if all others are always late: its place among them is that of a late one already."""
    Path('g.yaml').write_text("""\
mddag: 1
workers: 1
nodes:
  - {node: /heavy, callbacks: [{name: t, timer: 10ms, deadline: 10ms, execution_time: 12ms}]}
  - {node: /mission, callbacks: [{name: t, timer: 1s, deadline: none, execution_time: 1ms}]}
""")
    done = call('simulate', 'g.yaml', '--duration', '50s', '--on-late', 'demote',
                '--trace', 'r.mcap')
    assert done.returncode == 0
    run = open_recording('r.mcap')
    mine = run.executions[(run.executions['dag'] == 1) & (run.executions['worker'] >= 0)]
    starts = [run.start, *mine['start'].tolist(), run.end]
    assert max(after - before for before, after in zip(starts, starts[1:])) <= 11.1e9


POLICIES = """\
from mddag_executor.core.policies import Policy
from mddag_executor.core.state import DEADLINE_KEYS


def late_first(tables, vertex, release, job, order):
    return -tables.rad_offset[vertex], order, 0, 0


def rad(tables, vertex, release, job, order):
    return (release + tables.rad_offset[vertex], tables.index_in_dag[vertex],
            tables.dag_of[vertex], order)


def three(tables, vertex, release, job, order):
    return 1.5, 0, 0


def broken(tables, vertex, release, job, order):
    return tables.no_such_column[vertex]


like_rad = Policy('any name', rad, True, 'as rad', urgency=DEADLINE_KEYS)
number = 1
"""


@pytest.fixture
def policies(folder, monkeypatch):
    """Give the name of a module of policies in the folder."""
    monkeypatch.setattr('sys.path', [*sys.path])
    name = f'policies_{folder.name}'
    (folder / f'{name}.py').write_text(POLICIES)
    yield name
    sys.modules.pop(name, None)


def test_a_policy_of_a_user_s_own(call, graph, policies):
    simulate = ('simulate', graph, '--workers', 1, '--duration', '40ms', '--on-late', 'demote',
                '--json', '-')
    ours, theirs = (call(*simulate, '--policy', name).result
                    for name in ('rad', f'{policies}:like_rad'))
    assert theirs['policy'] == f'{policies}:like_rad' and theirs['dags'] == ours['dags']
    late = call(*simulate, '--policy', f'{policies}:late_first', '--trace', 'run.mcap').result
    assert sinks(late)['/filter:near'][1] > sinks(ours)['/filter:near'][1]
    names = ['rad', f'{policies}:like_rad', f'{policies}:late_first']
    accepted = call('evaluate', graph, '--runs', 4, '--parallel', 1, '--json', '-',
                    '--policies', ','.join(names)).result['policies']
    assert [*accepted] == names and accepted[names[0]] == accepted[names[1]]
    # the recording only names it: it runs when it is asked for
    replayed = call('replay', 'run.mcap', '--json', '-')
    assert replayed.result['policy'] == f'{policies}:late_first'
    refused = call('replay', 'run.mcap', '--reschedule')
    assert refused.returncode == 2 and 'give --policy' in refused.stderr
    again = call('replay', 'run.mcap', '--reschedule', '--json', '-', '--policy',
                 f'{policies}:late_first').result
    assert sinks(again) == sinks(late)
    assert call('replay', 'run.mcap', '--reschedule', '--policy', 'rad').returncode == 0
    assert call('slack', graph, '--duration', '40ms', '--policy', f'{policies}:like_rad',
                '--parallel', 1).returncode == 0


@pytest.mark.parametrize(('name', 'status', 'says'), [
    ('three', 2, 'it returned (1.5, 0, 0): let it return four integers'),
    ('number', 2, 'it cannot be called: give a function'),
    ('missing', 2, 'it cannot be imported (AttributeError: module '),
    ('broken', 70, "'Tables' object has no attribute 'no_such_column'")])
def test_a_policy_that_cannot_be_used(call, graph, policies, name, status, says):
    done = call('simulate', graph, '--policy', f'{policies}:{name}')
    assert done.returncode == status and says in done.stderr
    assert ('Traceback' in done.stderr) == (status == 70)
