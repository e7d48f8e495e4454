# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Callbacks that do not end: they are named live, in the trace, and as causes of misses."""

import asyncio
from functools import partial
import shutil
import threading

from mddag_executor import replay
from mddag_executor.analysis import causes
from mddag_executor.errors import MddagError
from mddag_executor.executor import diagnostics, unfinished
from mddag_executor.executor.session import Session
from mddag_executor.report import tables
from mddag_executor.report.live_runs import live_lines
from mddag_executor.report.replays import summary
from msg_graph import loads
import pytest
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.task import Future
from std_srvs.srv import Trigger

from .conftest import Spinning, wait_for
from .declared import graph
from .inside import engine_of, replace_method

GRAPH = graph(
    robot="""
        name: works, timer: 10ms, deadline: 5ms, dag: a
        name: other, timer: 10ms, deadline: 9ms, dag: b""",
    free='name: goes_on, timer: 10ms, deadline: 1s, dag: c')
MS = 1_000_000


class Robot:
    """
    A node of which a callback does not end in its third run, until it is released.

    :param how: what it waits for.
    """

    def __init__(self, make_node, how):
        self.runs = 0
        self.let_go, self.future = threading.Event(), Future()
        self.node, self.free = make_node('robot'), make_node('free')
        self.client = self.node.create_client(
            Trigger, '/never', callback_group=MutuallyExclusiveCallbackGroup())
        body = {'lock': self.let_go.wait, 'service': partial(
            self.client.call, Trigger.Request())}.get(how)
        self.node.create_timer(0.01, self.awaits if body is None else partial(self.works, body))
        self.node.create_timer(0.01, lambda: None)
        self.free.create_timer(0.01, lambda: None)

    def works(self, body):
        self.runs += 1
        if self.runs == 3:
            body()

    async def awaits(self):
        self.runs += 1
        if self.runs == 3:
            await self.future

    def release(self):
        """Let it end; after that nothing happens."""
        self.let_go.set()
        for future in (self.future, *[*self.client._pending_requests.values()]):
            if not future.done():
                future.set_result(None)


@pytest.fixture
def make_robot(make_node):
    """Give a function that makes robots; their callbacks end afterwards, even if a test fails."""
    robots = []

    def make(how):
        robots.append(Robot(make_node, how))
        return robots[-1]
    yield make
    for robot in robots:
        robot.release()


def is_noted(path, killed, waits_for):
    """Return whether a killed process would leave a note of the execution; copy what it leaves."""
    shutil.copy(path, killed)
    try:
        found = replay(killed, loads(GRAPH)).result().get('unfinished', ())
        # on a busy machine an earlier one, whose end has not been written, may be there first, or
        # this one before it waits
        return len(found) == 1 and 'test_unfinished' in found[0]['where'] and (
            found[0]['where'].endswith(waits_for))
    except MddagError:      # nothing has been written yet
        return False


def count_notes(patch, executor):
    """Return a list that gets the number of unfinished executions each time they are noted."""
    engine, notes = engine_of(executor), []
    note = engine.note_unfinished
    replace_method(patch, engine, 'note_unfinished', lambda several, now: (
        notes.append(len(several)), note(several, now)))
    return notes


@pytest.mark.parametrize('how', ['lock', 'service', 'future'])
@pytest.mark.parametrize('declared', [True, False], ids=['declared', 'undeclared'])
def test_a_callback_that_does_not_end_is_named(
        make_executor, make_robot, tmp_path, monkeypatch, how, declared):
    for module, name in ((unfinished, 'LONG_NS'), (causes, 'HANGS_NS'), (tables, 'LONG_NS'),
                         (diagnostics, 'LONG_NS')):
        monkeypatch.setattr(module, name, 20 * MS)
    monkeypatch.setattr('mddag_executor.sources.imported_run.LEAST_UNFINISHED_NS', 20 * MS)
    monkeypatch.setattr('mddag_executor.analysis.explain.HANGS_NS', 20 * MS)
    path, killed = tmp_path / 'run.mcap', tmp_path / 'killed.mcap'
    robot = make_robot(how)
    executor = make_executor(
        loads(GRAPH) if declared else None, trace=str(path), diagnostics_period='10s',
        nodes=[robot.node, robot.free])
    session = Session(executor)
    waits_for = {'lock': '', 'service': ', waits for service /never',
                 'future': ', waits for a future'}[how]
    where = f'(at {__name__.rpartition(".")[2]}.py:'
    with session:
        assert wait_for(lambda: any(
            each['callback'].startswith('/robot:') and each['for_ns'] > 200 * MS
            for each in executor.statistics()['unfinished']))
        assert wait_for(partial(is_noted, path, killed, waits_for))

        def is_reported():
            level, message = executor._diagnostics._pool.status(0)[1:3]
            # on a busy machine another callback may run for long as well
            return (level, where in message, message.count('has run for')) == (1, True, 1)
        assert wait_for(is_reported)
        if how != 'future':     # a coroutine does not keep the run from its end
            session.hurry()
    assert session.clean == (how == 'future')
    statistics = executor.statistics()
    lines = [line for line in live_lines({**statistics, 'measured': None})
             if 'has not ended' in line]
    robot.release()
    name = '/robot:works' if declared else '/robot: '
    assert len(lines) == 1 and lines[0].startswith(name)
    assert where in lines[0] and lines[0].endswith(f'{waits_for})')
    for trace in (path, killed):
        replayed = replay(trace, loads(GRAPH))
        result = replayed.result()
        found, = result['unfinished']
        assert (found['callback'], found['for_ns'] > 20 * MS) == ('/robot:works', True)
        assert f'({found["where"]})'.startswith(where)
        assert f'{found["where"]})'.endswith(f'{waits_for})'), found
        assert any('/robot:works has not ended' in line for line in summary(result))
        table = replayed.recording.executions
        job, = table['job'][table['start'] == found['since_ns']].tolist()
        why = {each['job']: each['cause'] for each in replayed.explanation.result(sink=0)['jobs']}
        # on a busy machine it may have started after its deadline
        assert why[job] in ('never ended', 'machine')
        if declared:    # without a declaration skipped releases have no jobs
            after = [cause for each, cause in why.items() if each > job]
            assert 'never ended' in after, (job, why)
        assert result['recording'].get('shut_down') is (trace is path)
        assert not [each for each in replayed.drift() if each.kind == 'stopped'
                    and each.callback != '/free:goes_on']


def test_what_runs_long_and_ends_is_recorded_once(
        make_executor, make_node, make_robot, tmp_path, monkeypatch):
    """Notes of executions that have ended after all, or went on, count for nothing."""
    monkeypatch.setattr(unfinished, 'LONG_NS', 10 * MS)
    path = tmp_path / 'run.mcap'
    robot = make_robot('future')
    slow = make_node('slow')
    ended = []

    def work():
        if not ended:
            robot.let_go.wait()
        ended.append(True)

    slow.create_timer(0.01, work)
    executor = make_executor(loads(GRAPH), trace=str(path), nodes=[robot.node, slow])
    notes = count_notes(monkeypatch, executor)
    with Session(executor):
        assert wait_for(lambda: notes.count(2) > 1)
        robot.release()
        assert wait_for(lambda: robot.runs > 5 and len(ended) > 2)
    replayed = replay(path)
    assert 'unfinished' not in replayed.result()
    table = replayed.recording.executions
    table = table[table['start'] < replayed.recording.end]     # else it waited at the end
    assert (table['end'] >= table['start']).all()
    rows = list(zip(*(table[name].tolist() for name in ('callback', 'start'))))
    assert len(set(rows)) == len(rows)


def test_a_coroutine_outlives_the_client_that_it_waits_for(
        make_executor, make_node, tmp_path, monkeypatch):
    monkeypatch.setattr(unfinished, 'LONG_NS', 10 * MS)
    monkeypatch.setattr('mddag_executor.sources.imported_run.LEAST_UNFINISHED_NS', 10 * MS)
    node = make_node('robot')
    client = node.create_client(Trigger, '/never')

    async def ask():
        timer.cancel()
        await client.call_async(Trigger.Request())

    timer = node.create_timer(0.01, ask)
    executor = make_executor(trace=str(tmp_path / 'run.mcap'), nodes=[node])
    notes = count_notes(monkeypatch, executor)
    with Spinning(executor):
        assert wait_for(engine_of(executor).begun)
        node.destroy_client(client)
        seen = len(notes)
        assert wait_for(lambda: notes[seen:].count(1) > 1)
        found, = executor.statistics()['unfinished']
        assert found['where'].endswith(', waits for service /never, whose client is destroyed')
    assert executor.statistics()['trace']['error'] is None
    found, = replay(tmp_path / 'run.mcap').result()['unfinished']
    assert found['where'].endswith(', waits for service /never, whose client is destroyed')


def test_a_coroutine_that_has_slept_waits_for_a_worker(
        make_executor, make_node, tmp_path, monkeypatch):
    """Its future of asyncio is done; the only worker runs a callback that does not end."""
    monkeypatch.setattr(unfinished, 'LONG_NS', 10 * MS)
    node, reentrant = make_node('robot'), ReentrantCallbackGroup()
    blocks, let_go, ended = threading.Event(), threading.Event(), threading.Event()

    async def sleep():
        sleeper.cancel()
        while not blocks.is_set():
            await asyncio.sleep(0.1)
        ended.set()

    def block():
        blocker.cancel()
        blocks.set()
        let_go.wait(60.0)

    sleeper = node.create_timer(0.01, sleep, callback_group=reentrant)
    executor = make_executor(num_workers=1, trace=str(tmp_path / 'run.mcap'), nodes=[node],
                             diagnostics_period='10s')
    engine, notes = engine_of(executor), count_notes(monkeypatch, executor)
    with Spinning(executor):
        assert wait_for(engine.begun)
        blocker = node.create_timer(0.01, block, callback_group=reentrant)
        assert wait_for(lambda: blocks.is_set() and engine.begun()[0].coroutine.waits_for.done())
        where = [each['where'] for each in executor.statistics()['unfinished']
                 if 'sleep' in each['callback']]
        assert len(where) == 1 and where[0].endswith(', waits for a future')
        assert wait_for(lambda: executor._diagnostics._pool.status(0).level == 1)
        seen = len(notes)
        assert wait_for(lambda: notes[seen:].count(2) > 1)
        let_go.set()
        assert wait_for(ended.is_set)
    assert executor.statistics()['trace']['error'] is None
    assert 'unfinished' not in replay(tmp_path / 'run.mcap').result()
