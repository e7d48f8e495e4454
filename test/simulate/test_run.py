# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Simulated runs: loads and settings, and that a recorded one is replayed as it was."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
import tempfile

from hypothesis import assume, example, given
from hypothesis import strategies as st
from mddag_executor import replay, reschedule
from mddag_executor.core.state import EXPIRED, SINK_COMPLETED, SINK_LATE
from mddag_executor.errors import MddagError, UsageError
from mddag_executor.simulate import (
    draw_execution_times,
    END,
    JOB_ENDED,
    periodic_workload,
    RELEASE,
    scale_execution_times,
    Settings,
    simulate,
    START,
    utilisation,
    Workload,
)
from mddag_executor.whatif.run_writer import write_trace
from msg_graph import load, loads
from msg_graph.duration import DAY
import pytest

from ..conftest import examples
from ..core.task_sets import Case, cases, declaration
from .helpers import executions

US = 1_000


def two_dags(**more):
    return declaration([
        {'node': '/n', 'name': 's', 'timer': '10us', 'publishes': ['/s'], 'dag': 'a',
         'execution_time': '2us', **more},
        {'node': '/n', 'name': 'x', 'subscription': '/s', 'deadline': '9us',
         'execution_time': {'quantiles_us': [1, 3]}},
        {'node': '/n', 'name': 't', 'timer': '4us', 'publishes': ['/s'], 'dag': 'b',
         'execution_time': '1us'}])


AUTOWARE = Path(__file__).resolve().parents[2] / 'config' / 'autoware.yaml'

# What the paper's own program (github.com/atsushi421/2024_RTSS_WiP_Evaluation) gave on 2026-11-22
# for draws of this project, by seed and policy: when the first late sink completed, and the worst
# response time of each sink until then, DAG by DAG, us.
PAPER = {
    (2, 'rad'): (None, [
        5998, 5967, 1995, 2216, 34988, 250, 251, 4401, 140938, 231479, 122722, 212577, 188155, 669,
        2889, 79032, 316, 314]),
    (2, 'rm'): (None, [
        5998, 5967, 1995, 2216, 47589, 250, 251, 42276, 154585, 253775, 136369, 238556, 193595,
        40455, 42176, 95793, 316, 314]),
    (2, 'wc'): (246381, [
        27427, 28065, 46381, 19384, 1022, 7070, 7068, 24540, 137314, 221830, 115863, 204491,
        175345, 23881, 24440, 79020, 7076, 7072]),
    (3, 'rad'): (None, [
        2410, 2439, 444, 757, 42939, 331, 331, 2330, 139084, 243956, 102674, 214008, 174158, 637,
        2433, 93197, 1488, 1488]),
    (3, 'rm'): (301085, [
        2410, 2439, 444, 757, 5711, 331, 331, 32706, 137484, 235300, 99541, 205538, 166578, 32527,
        33954, 101085, 1488, 1488]),
    (3, 'wc'): (239240, [
        28420, 28516, 39240, 9888, 783, 7349, 7346, 35902, 137351, 235723, 98151, 209200, 165680,
        32024, 36002, 92988, 10060, 10058]),
}


@pytest.mark.parametrize(('seed', 'policy'), PAPER)
def test_autoware_runs_as_in_the_paper_s_program(seed, policy):
    task_set = load(AUTOWARE)
    times = [[-(-time // 1000) * 1000 for time in row]
             for row in draw_execution_times(task_set, seed)]
    run = simulate(task_set, periodic_workload(task_set, times, 3 * 10 ** 9), Settings(
        policy=policy, pools=(7,), duration_ns=3 * 10 ** 9, preemptive=None,
        judge='completions', stop_at_first_miss=True))
    worst = {}
    first_miss = None
    for kind, dag, vertex, job, _, time in run.decisions:
        if kind in SINK_COMPLETED and first_miss is None:
            response = (time - job * task_set.dags[dag].period_ns) // 1000
            worst[vertex] = max(response, worst.get(vertex, 0))
            first_miss = time // 1000 if kind == SINK_LATE else None
    assert (first_miss, [worst[vertex] for vertex in sorted(worst)]) == PAPER[seed, policy]


# --- loads ---------------------------------------------------------------------------------------


def test_a_source_may_get_ready_after_its_release():
    """As with a header stamp: the deadline counts from the release."""
    load = Workload([5 * US], [0], [0], [2 * US, 2 * US], [0, 2], [0, 0], releases=[1])
    run = simulate(two_dags(), load, Settings(pools=(1,), duration_ns=100 * US))
    sink = run.result()['dags']['a']['sinks']['/n:x@a']
    assert (sink['completed'], sink['late']) == (1, 0)
    assert sink['response_ns']['max'] == 9 * US - 1
    late = simulate(two_dags(), load._replace(times=[5 * US + 2]),
                    Settings(pools=(1,), duration_ns=100 * US))
    assert late.result()['first_miss'] == {
        'dag': 'a', 'vertex': '/n:x@a', 'job': 0, 'deadline_ns': 9 * US + 1,
        'completed_ns': 9 * US + 2}


def test_the_log_has_releases_and_early_ends_in_the_order_of_the_engine():
    """A release expires the job before it; what waits of that job still runs."""
    task_set = declaration([{'node': '/n', 'name': 't', 'timer': '10us', 'deadline': '9us',
                             'max_active_jobs': 1, 'execution_time': '25us'}])
    run = simulate(task_set, periodic_workload(task_set, [[25 * US]], 26 * US),
                   Settings(pools=(1,), duration_ns=26 * US), log=True)
    assert [*map(tuple, run.log)] == [
        (0, RELEASE, -1, 0, 0, 0), (0, START, 0, 0, 0, 0),
        (10 * US, JOB_ENDED, -1, 0, EXPIRED, 0), (10 * US, RELEASE, -1, 0, 10 * US, 1),
        (20 * US, JOB_ENDED, -1, 0, EXPIRED, 1), (20 * US, RELEASE, -1, 0, 20 * US, 2),
        (25 * US, END, 0, 0, 0, 0), (25 * US, START, 0, 0, 0, 1)]


def test_a_bound_for_all_dags_and_one_of_its_own():
    task_set = two_dags(max_active_jobs=3)
    load = periodic_workload(task_set, [[1, 900 * US], [900 * US, 1]], 100 * US)
    settings = Settings(pools=(2,), duration_ns=100 * US)
    for more, expired in (({'max_active_jobs': 2}, [10 - 3, 25 - 2]), ({}, [10 - 3, 0])):
        dags = simulate(task_set, load, settings, **more).result()['dags']
        assert [dags[name]['ends']['expired'] for name in 'ab'] == expired


# --- settings ------------------------------------------------------------------------------------

@pytest.mark.parametrize(('setting', 'says'), [
    ({'pools': (2, 0)}, 'workers: 0 is out of range: give 1 to 4096'),
    ({'duration_ns': 0}, 'duration: 0 ns is too short'),
    ({'judge': 'me'}, "judge 'me': .*: choose one of horizon, completions"),
    ({'policy': 'ros2', 'preemptive': True}, "policy 'ros2': .* preempts no callback: run it"),
    ({'cpus': 0}, 'cpus: 0 is too few'),
    ({'dispatch_overhead_ns': -1}, 'overhead'), ({'switch_overhead_ns': -1}, 'overhead'),
])
def test_settings_that_make_no_sense(setting, says):
    load = periodic_workload(two_dags(), [[1, 1], [1, 1]], US)
    with pytest.raises(MddagError, match=says):
        simulate(two_dags(), load, replace(Settings(), **setting))


# --- execution times -----------------------------------------------------------------------------

def test_a_seed_draws_the_same_for_ever():
    """The draw is part of results that people publish: it must not change."""
    assert draw_execution_times(two_dags(), 1) == [[2_000, 2_695], [2_528, 1_000]]
    assert draw_execution_times(two_dags(), 2) == [[2_000, 2_896], [1_113, 1_000]]


def test_a_callback_without_a_time_is_named_with_its_own_file(tmp_path):
    (tmp_path / 'part.yaml').write_text(
        'mddag: 1\nnodes:\n- node: /n\n  callbacks:\n  - {name: t, timer: 1ms, deadline: 1ms}\n')
    (tmp_path / 'top.yaml').write_text('mddag: 1\ninclude: [part.yaml]\n')
    with pytest.raises(MddagError, match='part.yaml:5: /n:t declares no execution_time: add one'):
        draw_execution_times(load(tmp_path / 'top.yaml'), 0)


def test_utilisation_and_its_scaling():
    times = [[2_000, 3_000], [1_000, 1_000]]
    assert utilisation(two_dags(), times, 2) == pytest.approx(0.5)
    scaled = scale_execution_times(two_dags(), times, 2, 0.25)
    assert scaled == [[1_000, 1_500], [500, 500]]
    assert times == [[2_000, 3_000], [1_000, 1_000]]
    for target in (0.0, -1.0, float('nan'), float('inf')):
        with pytest.raises(UsageError, match='utilisation'):
            scale_execution_times(two_dags(), times, 2, target)
    with pytest.raises(UsageError, match='so there is nothing to scale'):
        scale_execution_times(two_dags(), [[0, 0], [0, 0]], 2, 0.5)


def test_more_jobs_than_fit_into_memory_are_refused():
    with pytest.raises(UsageError, match='more than 20000000 jobs in 86400 s: give a shorter'):
        periodic_workload(two_dags(), [[1, 1], [1, 1]], DAY)


# Both are late, at once.
TWO_SINKS_AT_ONCE = Case(loads("""\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: s, timer: 3us, dag: d, publishes: [/t]}
      - {name: a, subscription: /t, deadline: 1us}
      - {name: b, subscription: /t, deadline: 1us}
"""), ((1, 1, 1),), 2, 'rad', False, 0, 0)


# Two of three sinks of a job have completed when the third one is dropped, which closes the job.
DROPPED_LAST = Case(loads("""\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: s, timer: 3us, dag: d, on_late: continue, publishes: [/t]}
      - {name: a, subscription: /t, deadline: 1us}
      - {name: b, subscription: /t, deadline: 2us, keep: newest}
  - node: /m
    callbacks:
      - {name: other, timer: 3us, dag: e, on_late: continue, deadline: 1us}
"""), ((1, 1, 1), (1,)), 1, 'rad', False, 0, 0)


@pytest.fixture(scope='module')
def trace():
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder, 'run.mcap')


def record(case, horizon, trace, **how):
    run = case.run(horizon, **how)
    trace.unlink(missing_ok=True)
    write_trace(trace, case.task_set, case.load(how.get('last_release') or horizon), run)
    return run


@examples(30)
@example(case=TWO_SINKS_AT_ONCE, horizon=5, stop=False)
@example(case=DROPPED_LAST, horizon=12, stop=False)
@given(case=cases(overheads=True, newest=True), horizon=st.integers(5, 50), stop=st.booleans())
def test_the_replayer_counts_the_same(trace, case, horizon, stop):
    """Also with expiries, preemptions and groups; nothing contradicts anything."""
    run = record(case, horizon, trace)
    replayed = replay(trace)
    assert replayed.warnings == []
    result = replayed.result()
    for name, dag in run.result()['dags'].items():
        assert result['dags'][name]['jobs'] == dag['jobs']
        assert result['dags'][name]['ends'] == dag['ends']
        for sink, values in dag['sinks'].items():
            found = result['dags'][name]['sinks'][sink]
            assert values.pop('demoted', 0) == found.get('demoted', 0)
            assert {key: found[key] for key in values} == values
    assert result['deadline_missed'] == run.tally.missed
    assert result['policy'] == case.policy
    assert result['preemptive'] == case.preemptive
    assert result['workers'] == case.workers
    if stop:
        stopped = record(case, horizon, trace, judge='completions', stop=True)
        assert replay(trace).result()['duration_ns'] <= stopped.ended_ns


@examples(50)
@given(case=cases(), last_release=st.integers(5, 25))
def test_rescheduled_alike_it_runs_alike(trace, case, last_release):
    """
    Of runs that end with everything done: elsewhere not all execution times are known.

    And of those that demote nothing: demoting goes by the recorded execution times.
    """
    assume(all(dag.on_late != 'demote' for dag in case.task_set.dags))
    horizon = last_release * (1 + sum(map(sum, case.ticks)))
    run = record(case, horizon, trace, last_release=last_release)
    if Counter(entry[1] for entry in run.log)[END] < sum(
            len(case.task_set.dags[dag].vertices) for dag in case.load(last_release).dags):
        return  # something has expired
    rescheduled = reschedule(trace)
    result, expected = rescheduled.result(), run.tally.result()
    assert (rescheduled.log, rescheduled.warnings) == (run.log, [])
    assert {key: result[key] for key in expected} == expected
    assert (result['policy'], result['workers'], result['preemptive']) == (
        case.policy, case.workers, run.settings.preempts)
    assert result['recorded']['dags'] == expected['dags']
    assert result['estimated_executions'] == 0
    busy = [0] * case.workers
    for start, (end, _, worker, *_) in executions(run.log):
        busy[worker] += end - start
    assert result['worker_use']['busy_ns'] == {str(n): took for n, took in enumerate(busy)}


@pytest.mark.parametrize(('holds', 'cpus'), [('true', None), ('true', 2), ('false', 1)])
def test_what_shared_cpus_or_the_interpreter_does_so_again(trace, holds, cpus):
    """The long one is overtaken; what it waited for the other one is taken back."""
    task_set = loads(f"""\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {{name: a, timer: 40ms, deadline: 40ms, dag: a, execution_time: 22ms,
          holds_interpreter: {holds}}}
      - {{name: b, timer: 10ms, deadline: 10ms, dag: b, execution_time: 3ms,
          holds_interpreter: {holds}}}
""", 'g.yaml')
    horizon = 160_000_000
    load_ = periodic_workload(task_set, draw_execution_times(task_set, 0), horizon)
    run = simulate(task_set, load_, Settings(pools=(2,), duration_ns=horizon, cpus=cpus), log=True)
    trace.unlink(missing_ok=True)
    write_trace(trace, task_set, load_, run)
    result = reschedule(trace).result()
    assert result['dags'] == run.result()['dags']
    assert result.get('cpus') == cpus
    response = result['dags']['a']['sinks']['/n:a']['response_ns']['median']
    assert response > 22_000_000     # it was not alone
