# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What ordinary robots do: publish sometimes, store values, start once, wait for a button."""

import time

from mddag_executor.executor import current_job
from mddag_executor.replay import replay, reschedule
from mddag_executor.replay.drafting import System
from msg_graph import loads
from msg_graph.draft import declaration_of
import pytest

from .conftest import is_idle, Spinning, wait_for
from .declared import Declared, graph

ROBOT = graph(
    camera='name: grab, timer: 20ms, publishes: [/image], dag: vision',
    detector="""
        name: detect, subscription: /image, publishes: [/seen], may_publish: [/alarm]
        name: start, timer: 30ms, once: true, dag: start, deadline: 5s""",
    planner='name: plan, subscription: /alarm, publishes: [/stop]',
    brake='name: stop, subscription: /stop, deadline: 5s',
    fuse='name: fuse, sync: [/seen, /alarm], deadline: 5s',
    store='name: store, subscription: /seen, deadline: none',
    panel='name: press, subscription: /button, period: 10ms, sporadic: true, deadline: 1s')
FINDS_IN = 3


def detect():
    """Find something in each third job."""
    return frozenset() if current_job().job % FINDS_IN == 0 else frozenset(['/alarm'])


def verdicts(result):
    return {name: (sink['completed'], sink.get('not_due', 0), sink['late'], sink['expired'])
            for dag in result['dags'].values() for name, sink in dag['sinks'].items()}


def test_results_that_nothing_was_published_for_are_not_due(make_executor, make_node, tmp_path):
    """They are no misses, live, as recorded and rescheduled; a silent job ends at once."""
    path = tmp_path / 'run.mcap'
    started = []

    def start():
        started.append(1)
        robot.timers[1].cancel()

    robot = Declared(make_node, ROBOT, {'detect': detect, 'start': start})
    executor = make_executor(loads(ROBOT), num_workers=3, trace=str(path))
    with Spinning(executor):
        robot.start(executor)
        assert wait_for(lambda: len(robot.ran['detect']) >= 30)
        robot.cancel()
        assert wait_for(lambda: is_idle(executor))
        ends = executor.statistics()['dags']['vision']['ends']
        # no job waits for a message that does not come
        assert sum(ends.values()) == executor.statistics()['dags']['vision']['jobs']
    executor.shutdown()
    statistics = executor.statistics()
    jobs = [job.job for job in robot.jobs('detect')]
    found = sum(job % FINDS_IN == 0 for job in jobs)
    assert (started, found > 5) == ([1], True)
    skipped = statistics['dags']['vision']['jobs'] - len(jobs)  # releases, on a busy machine
    live = verdicts(statistics)
    assert live == {
        '/brake:stop': (found, len(jobs) - found, 0, skipped),
        '/fuse:fuse': (found, len(jobs) - found, 0, skipped),
        '/detector:start': (1, 0, 0, 0), '/panel:press': (0, 0, 0, 0)}
    assert statistics['dags']['vision']['ends']['completed'] == len(jobs)
    assert statistics['unattributed'] == {'unknown': 0, 'doubtful': 0}
    assert len(robot.ran['store']) == len(jobs)
    recorded = replay(path).result()
    assert verdicts(recorded) == live
    assert verdicts(reschedule(path, workers=1).result()) == live


PLAIN = ROBOT.replace(
    'publishes: [/seen], may_publish: [/alarm]', 'publishes: [/seen, /alarm]').replace(
    'once: true, ', '')


@pytest.mark.parametrize('text', [ROBOT, PLAIN], ids=['declared so', 'declared plainly'])
def test_the_draft_of_a_recording_knows_what_is_published_sometimes(
        make_executor, make_node, tmp_path, text):
    """Its verdict on the same recording has no miss, and keys that were declared stay."""
    path = tmp_path / 'run.mcap'
    robot = Declared(make_node, ROBOT, {
        'detect': detect, 'start': lambda: robot.timers[1].cancel()})
    executor = make_executor(loads(text), num_workers=3, trace=str(path))
    with Spinning(executor):
        robot.start(executor)
        assert wait_for(lambda: len(robot.ran['detect']) >= 30)
        robot.cancel()
        assert wait_for(lambda: is_idle(executor))
    executor.shutdown()
    drafted = loads(declaration_of(System(path).draft(), accepted=True))
    found = {callback.name: callback for callback in drafted.callbacks}
    assert found['detect'].publishes == ('/seen', '/alarm')
    assert found['detect'].may_publish == ('/alarm',)
    assert (found['start'].once, found['grab'].once) == (True, False)
    assert not found['store'].judged
    results = verdicts(replay(path, drafted).result())
    assert results['/brake:stop'][1] > 5
    # a release may have been skipped on a busy machine
    assert results['/brake:stop'][2:] == results['/fuse:fuse'][2:]


LATE = graph(
    camera='name: grab, timer: 40ms, publishes: [/image], dag: vision',
    detector='name: detect, subscription: /image, may_publish: [/alarm]',
    brake='name: stop, subscription: /alarm, deadline: 1ms')


def test_a_result_is_not_reported_as_missed_while_it_may_not_be_due(make_executor, make_node):
    """The detector runs past the deadline of the brake: only an alarm makes that a miss."""
    def detect_slowly():
        time.sleep(0.005)
        return detect()

    missed = []
    robot = Declared(make_node, LATE, {'detect': detect_slowly})
    executor = make_executor(loads(LATE), on_deadline_miss=missed.append)
    with Spinning(executor):
        robot.start(executor)
        assert wait_for(lambda: len(robot.ran['detect']) >= 8)
        robot.cancel()
        assert wait_for(lambda: is_idle(executor))
    executor.shutdown()
    jobs = [job.job for job in robot.jobs('detect')]
    assert sorted(miss.job for miss in missed if miss.kind != 'expired') == [
        job for job in sorted(jobs) if job % FINDS_IN == 0]
