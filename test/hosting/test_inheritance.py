# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Requests inherit between the programs of a process, and not between processes (rule 15)."""

from mddag_executor import open_recording
from mddag_executor.hosting import run, RunOptions
from msg_graph import loads
import pytest

from .conftest import GUESTS

DEADLINE_NS = 45_000_000     # less than that of undeclared callbacks
GRAPH = """\
mddag: 1
workers: 1
nodes:
  - node: /control
    callbacks: [{name: tick, timer: 50ms, deadline: 45ms}]
"""
TWO_PROCESSES = GRAPH + """\
  - node: /serving
    callbacks: [{name: work, subscription: /work, period: 10ms, sporadic: true, deadline: none}]
processes: {up: [/control], down: [/serving]}
"""
ASK, WORK = '/serving: answer (service /ask)', '/serving: work (subscription /work)'
ELSEWHERE = '/working: <lambda> (subscription /work)'


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(GUESTS))
    monkeypatch.setenv('PYTHONPATH', str(GUESTS), prepend=':')
    return tmp_path


def runs_of(recording, *names):
    """Return the rows of the executions of undeclared callbacks in a recording."""
    numbers, index = recording.callbacks()
    wanted = [recording.callback_name(number) in names for number in numbers.tolist()]
    return [recording.executions[row] for row, at in enumerate(index.tolist()) if wanted[at]]


@pytest.mark.parametrize('serving', ['Serving', 'spins', 'spins_several', 'steps'])
def test_a_service_of_another_program_goes_before_what_is_less_urgent(here, serving):
    """Its callback group, and that of its program's executor, may be busy for one callback."""
    result = run(RunOptions(
        nodes=['asks:Control', f'asks:{serving}', 'asks:Working'], graph=loads(GRAPH),
        duration='60s', diagnostics=None, trace='run.mcap'))
    assert result.error is None
    recording = open_recording('run.mcap')
    asked = runs_of(recording, ASK)
    inheriting = [each for each in asked if each['inherited']]
    assert asked and inheriting
    dues = {release + DEADLINE_NS for release in recording.releases['release'].tolist()}
    assert {int(each['inherited']) for each in inheriting} <= dues
    if serving in ('Serving', 'spins'):
        overtakes(inheriting, runs_of(recording, WORK, ELSEWHERE))


def overtakes(urgent, others):
    """Check that none of the others has started while an urgent execution was ready."""
    for each in urgent:
        assert not [other for other in others if each['ready'] < other['start'] < each['start']]


def test_requests_of_another_process_inherit_nothing(here):
    """They are answered all the same."""
    result = run(RunOptions(
        nodes=['up=asks:Control', 'up=asks:Working', 'down=asks:spins'],
        graph=loads(TWO_PROCESSES), duration='60s', diagnostics=None, trace='run/'))
    assert result.error is None
    down = open_recording('run/down.mcap')
    asked = runs_of(down, ASK)
    assert len(asked) >= 20
    assert not down.executions['inherited'].any()
    up = open_recording('run/up.mcap')
    inherits = up.executions['inherited'] > 0
    # the callback of a response does, in the process that has asked
    numbers, index = up.callbacks()
    names = {up.callback_name(int(numbers[at])) for at in index[inherits]}
    assert names <= {'/control: note (task)'}, names
