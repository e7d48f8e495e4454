# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the core does in an overload, and that it does nothing without one (rules 7 and 13)."""

from dataclasses import replace

from hypothesis import assume, given
from hypothesis import strategies as st
from mddag_executor.core.jobs import is_miss
from mddag_executor.core.state import DROPPED
from mddag_executor.core.tally import counts
from mddag_executor.simulate import Settings, simulate
from msg_graph import ExecutionTime
import pytest

from ..conftest import examples
from .live_helpers import J, live, start_job, US
from .task_sets import Case, cases, declaration, single, TICK


def with_times(case, on_late=None, **more):
    """Return a case that declares its execution times, and ``more`` for each callback."""
    return replace(case, task_set=replace(case.task_set, dags=tuple(
        replace(dag, on_late=on_late, vertices=tuple(
            replace(vertex, callback=replace(
                vertex.callback, execution_time=ExecutionTime((ticks * TICK,), (50.0,)), **more))
            for vertex, ticks in zip(dag.vertices, row)))
        for dag, row in zip(case.task_set.dags, case.ticks))))


@examples(300)
@given(cases(bounds=False, importance=True), st.integers(5, 60))
def test_demote_without_an_overload_changes_nothing(case, horizon):
    case = with_times(case)
    run = case.run(horizon)
    assume(not run.tally.missed and demand(case) <= case.workers)
    latest = max(v.deadline_ns or 0 for v in case.task_set.vertices) // TICK
    demoted = with_times(case, on_late='demote').run(horizon)
    assert _until(case, run, horizon - latest) == _until(case, demoted, horizon - latest)


def demand(case):
    """Return how many workers the executions need."""
    return sum(sum(row) * TICK / dag.period_ns
               for dag, row in zip(case.task_set.dags, case.ticks))


@examples(300)
@given(cases(importance=True), st.integers(5, 60))
def test_importance_means_nothing_if_late_jobs_are_not_demoted(case, horizon):
    """They are not under a policy whose keys are no times."""
    by_time = case.policy in ('rad', 'gedf', 'llf')
    important = with_times(case, on_late='continue' if by_time else 'demote')
    plain = with_times(case, on_late='continue', importance='normal', tolerate=None)
    assert case.events(important.run(horizon)) == case.events(plain.run(horizon))


@examples(300)
@given(cases(('rad', 'gedf', 'llf'), groups=False, bounds=False, importance=True),
       st.integers(5, 60))
def test_messages_of_a_callback_keep_their_order(case, horizon):
    case = replace(with_times(case, on_late='demote'), workers=1, preemptive=False)
    started = {}
    for _, kind, _, dag, vertex, job in case.events(case.run(horizon)):
        if kind == 'start':
            started.setdefault((dag, vertex), []).append(job)
    for (dag, _), jobs in started.items():
        of_source = started[dag, case.task_set.dags[dag].source]
        assert jobs == sorted(of_source)[:len(jobs)]


@examples(300)
@given(st.lists(st.sampled_from((0, 1, 'run', 'wait')), min_size=4, max_size=40))
def test_messages_of_each_topic_of_a_sync_keep_their_order(steps):
    """Also if those of the other topic belong to jobs released earlier or later."""
    scheduler = live(workers=1, on_late='demote')
    jobs = len(steps) + 1
    slots = [start_job(scheduler, job, 10 * US * job) for job in range(jobs)]
    now = 10 * US * jobs
    arrived, ran = [0, 0], [0, 0]
    jobs_of = {scheduler.execution(slots[job], J, leg): (leg, job)
               for job in range(jobs) for leg in (0, 1)}
    executions = {each: x for x, each in jobs_of.items()}
    for step in (*steps, *['run'] * len(steps)):
        if step == 'wait':
            now += 5 * US
        elif step == 'run':
            x = scheduler.take(0, now)
            if x >= 0:
                leg, job = jobs_of[x]
                assert job == ran[leg]
                ran[leg] += 1
                scheduler.complete(x, now)
        else:
            leg = int(step)
            scheduler.ready(executions[leg, arrived[leg]], now)
            arrived[leg] += 1
    assert ran == arrived


def _until(case, run, end):
    """Return the events before a time: what is released later may be too much for the workers."""
    return [event for event in case.events(run) if event[0] < end]


def results(callbacks, ticks, horizon, preemptive=False):
    """Return of each sink what came of it, on one worker."""
    case = Case(declaration(callbacks), tuple((each,) for each in ticks), 1, 'rad', preemptive)
    dags = case.run(horizon).result()['dags']
    return {name: next(iter(dag['sinks'].values())) for name, dag in dags.items()}


def test_late_work_does_not_go_before_what_can_be_in_time():
    # The heavy one is late from its second job on, and then always has the earlier deadline.
    in_time = {}
    for on_late in ('continue', 'demote'):
        heavy = single('heavy', 10, 12, execution_time='12us', on_late=on_late)
        light = single('light', 20, 15, execution_time='2us', on_late=on_late)
        sinks = results([heavy, light], [12, 2], 400)
        assert (sinks['heavy'].get('demoted', 0) > 0) == (on_late == 'demote')
        in_time[on_late] = counts(sinks['light']).in_time
    assert in_time['continue'] < in_time['demote']


def test_a_sink_that_can_be_in_time_keeps_its_deadline():
    # At 10 the source of the second job is too late for near, and not for far.
    callbacks = [
        single('block', 100, 2, execution_time='10us'),  # it goes first
        {'node': '/n', 'name': 'source', 'timer': '100us', 'dag': 'two', 'on_late': 'demote',
         'publishes': ['/a'], 'execution_time': '1us'},
        {'node': '/n', 'name': 'near', 'subscription': '/a', 'deadline': '5us'},
        {'node': '/n', 'name': 'far', 'subscription': '/a', 'deadline': '40us'},
        single('other', 100, 50, execution_time='10us')]
    case = Case(declaration(callbacks), ((10,), (1, 1, 1), (10,)), 1, 'rad', False)
    sinks = case.run(90).result()['dags']['two']['sinks']
    assert sinks['/n:near']['demoted'] == sinks['/n:near']['late'] == 1
    assert sinks['/n:far']['response_ns']['max'] == 12 * TICK  # other went after it
    assert sinks['/n:near']['response_ns']['max'] == 23 * TICK  # and before this


def test_demoted_callbacks_do_not_starve():
    # The sensor is always late, because the others block it for longer than its deadline.
    callbacks = [single('sensor', 10, 2, execution_time='1us', on_late='demote'),
                 *(single(f'heavy{i}', 40, 80, execution_time='20us', on_late='demote')
                   for i in range(2))]
    sinks = results(callbacks, [1, 20, 20], 4000)
    assert counts(sinks['sensor']).in_time < 200
    assert sinks['sensor']['completed'] >= 4000 // (11 * 2 + 20)  # one in 11 deadlines


@pytest.mark.parametrize('keep', ['all', 'newest'])
def test_callbacks_whose_releases_are_dropped_do_not_starve(keep):
    # The first one needs the worker always, and goes first among equals.
    sinks = results([
        single('first', 20, 20, execution_time='20us', on_late='demote'),
        single('second', 20, 20, execution_time='12us', on_late='demote', keep=keep)],
        [20, 12], 4000)
    assert sinks['second']['dropped'] >= 100
    assert sinks['second']['completed'] >= 4000 // (12 * 20)


def test_late_releases_of_a_timer_give_way_to_newer_ones():
    """After an overload the newest is in time at once, although there is hardly room."""
    sinks = results([
        single('block', 1000, 1000, execution_time='95us', on_late='demote'),
        single('sensor', 10, 30, execution_time='9us', on_late='demote')], [95, 9], 1000)
    assert counts(sinks['sensor']).in_time >= 88  # 27 if all run


def test_less_important_sinks_are_demoted_first():
    for preemptive in (True, False):
        in_time = {}
        for importance in ('normal', 'high'):
            callbacks = [
                single('low', 20, 20, execution_time='8us', importance='low', on_late='demote'),
                single('main', 30, 40, execution_time='24us', importance=importance,
                       on_late='demote')]
            sinks = results(callbacks, [8, 24], 6000, preemptive)
            in_time[importance] = {name: counts(sink).in_time for name, sink in sinks.items()}
        assert in_time['high']['main'] >= 199 == 6000 // 30 - 1
        assert in_time['high'] == in_time['normal']  # normal is more than low


def test_the_highest_importance_is_never_refused():
    def run(**more):
        return results([single(name, 10, 10, execution_time='8us', on_late='demote', **more)
                        for name in 'ab'], [8, 8], 2000)
    assert run(importance='low') == run(importance='high') == run()


@pytest.mark.parametrize('keep', ['all', 'newest'])
@pytest.mark.parametrize(('time', 'runs'), [(11, True), (20, False)])
def test_less_important_work_leaves_room_for_the_next_important_job(time, runs, keep):
    """It starts only if it ends before that job must start, or at long intervals."""
    sinks = results([
        single('low', 20, 20, execution_time=f'{time}us', importance='low', on_late='demote',
               keep=keep),
        single('high', 20, 12, execution_time='10us', on_late='demote')], [time, 10], 20_000)
    assert counts(sinks['high']).in_time >= (0.99 if runs else 0.85) * 1000
    assert (sinks['low']['completed'] > 600) == runs
    assert sinks['low']['completed'] >= 80  # one in about ten deadlines


def test_less_important_work_leaves_room_for_all_important_jobs():
    """Those released together need the interpreter one after the other."""
    task_set = declaration([
        single('low', 50, 50, execution_time='26us', importance='low', on_late='demote'),
        *(single(name, 50, deadline, execution_time='14us', on_late='demote')
          for name, deadline in (('first', 20), ('second', 30)))])
    case = Case(task_set, ((26,), (14,), (14,)), 7, 'rad', False)
    load = case.load(20_000)._replace(holds=[1, 1, 1])
    run = simulate(task_set, load, Settings(workers=7, duration_ns=20_000 * TICK))
    for name in ('first', 'second'):
        sink = run.result()['dags'][name]['sinks'][f'/n:{name}']
        assert counts(sink).in_time >= 0.85 * 400


@pytest.mark.parametrize('last', [0, 100])
def test_room_is_left_for_one_release_after_the_last(last):
    """If the source stops, less important work goes on although nothing else happens."""
    case = Case(declaration([
        single('low', 40, 40, execution_time='30us', importance='low', on_late='demote'),
        single('high', 20, 12, execution_time='10us', on_late='demote')]),
        ((30,), (10,)), 1, 'rad', False)
    times = range(0, last + 1, 20)
    load = case.load(1000)._replace(
        times=[0, *(time * TICK for time in times)], dags=[0, *[1 for _ in times]],
        jobs=[0, *range(len(times))])
    run = simulate(case.task_set, load, Settings(workers=1, duration_ns=1000 * TICK), log=True)
    starts = [time for time, kind, _, dag, _, _ in case.events(run) if (kind, dag) == ('start', 0)]
    assert starts == [last + 20 + 2]  # as soon as the next job would be late


def test_late_jobs_of_an_important_sink_refuse_others():
    # There is room for both, but the first has the earlier deadline.
    in_time = {}
    for importance in ('low', 'high'):
        sinks = results([
            single('first', 40, 10, execution_time='10us', importance='low', on_late='demote'),
            single('second', 40, 20, execution_time='15us', importance=importance,
                   on_late='demote')], [10, 15], 8000)
        in_time[importance] = counts(sinks['second']).in_time
    assert in_time['low'] == 0 and in_time['high'] >= 0.97 * 200


def test_a_sink_that_tolerates_no_further_miss_goes_first():
    def run(**more):
        sinks = results([
            single('plain', 20, 20, execution_time='20us', on_late='demote'),
            single('other', 20, 20, execution_time='12us', on_late='demote', **more)],
            [20, 12], 4000)
        return [sinks[name]['completed'] for name in ('plain', 'other')]
    (plain, other), (plain_then, other_then) = run(), run(tolerate='1 of 10')
    assert other_then > other and plain_then < plain


def test_a_backlog_of_a_heavy_callback_leaves_the_others_in_time():
    # One interpreter for all; the heavy one has a long deadline, but its late jobs have the first.
    callbacks = [single(name, period, deadline, execution_time=f'{time}us', on_late='demote')
                 for name, period, deadline, time in (
                     ('publisher', 2000, 2000, 50), ('heavy', 5000, 50000, 4000),
                     ('other', 10000, 10000, 2500))]
    task_set = declaration(callbacks)
    case = Case(task_set, ((50,), (4000,), (2500,)), 7, 'rad', False)
    load = case.load(1_000_000)._replace(holds=[1, 1, 1])
    for on_late in ('demote', 'continue'):
        dags = tuple(replace(dag, on_late=on_late) for dag in task_set.dags)
        run = simulate(replace(task_set, dags=dags), load, Settings(
            workers=7, duration_ns=1_000_000 * TICK))
        publisher = run.result()['dags']['publisher']['sinks']['/n:publisher']
        assert (counts(publisher).in_time >= 0.96 * 500) == (on_late == 'demote')


def misses_of_a_burst(case, period, extra, horizon, on_late):
    """Return DAG and release (ticks) of the misses, if the first DAG is released more often."""
    load = case.load(horizon)
    releases = sorted([*zip(load.times, load.dags),
                       *((500 * TICK + period * each, 0) for each in range(extra))])
    times = [[] for _ in case.ticks]
    jobs = []
    for time, dag in releases:
        jobs.append(len(times[dag]))
        times[dag].append(time)
    load = load._replace(
        times=[time for time, _ in releases], dags=[dag for _, dag in releases], jobs=jobs)
    run = simulate(case.task_set, load, Settings(
        workers=case.workers, duration_ns=horizon * TICK, on_late=on_late))
    return [(dag, times[dag][job] // TICK) for kind, dag, _, job, _, _ in run.decisions
            if is_miss(kind)]


@pytest.mark.parametrize('extra', [3, 6, 10, 20])
def test_a_burst_is_worked_off(extra):
    """No more is late than with ``continue``, and nothing once there is room for the backlog."""
    periods = {'burst': (20, 40), 'other': (10, 10), 'slow': (60, 60)}
    ticks = (8, 4, 3)
    case = Case(declaration([
        single(name, *times, execution_time=f'{each}us')
        for (name, times), each in zip(periods.items(), ticks)]),
        tuple((each,) for each in ticks), 1, 'rad', False)
    missed = {on_late: misses_of_a_burst(case, 7, extra, 2000, on_late)
              for on_late in ('continue', 'demote')}
    assert 0 < len(missed['demote']) <= len(missed['continue'])
    assert max(time for _, time in missed['demote']) < 500 + extra * 8 / (1 - demand(case))


@pytest.mark.parametrize('extra', [5, 10, 20])
def test_the_slowest_callback_of_a_burst_works_off_its_backlog(extra):
    """As soon as it can, though its newest message cannot be in time behind the others."""
    case = Case(declaration([
        {'node': '/n', 'name': 'source', 'timer': '10us', 'dag': 'burst', 'publishes': ['/a'],
         'execution_time': '1us'},
        {'node': '/n', 'name': 'slowest', 'subscription': '/a', 'deadline': '30us', 'group': 'g',
         'execution_time': '7us'},
        *(single(f'other{i}', 30, 30, execution_time='12us') for i in range(2))]),
        ((1, 7), (12,), (12,)), 2, 'rad', False)
    missed = misses_of_a_burst(case, 1, extra, 2000, 'demote')
    assert {dag for dag, _ in missed} == {0}
    assert max(time for _, time in missed) < 500 + extra * 7 / (1 - 0.7)


def test_only_the_newest_is_kept():
    callbacks = [single('slow', 35, 100, execution_time='30us'),
                 single('fast', 10, 200, keep='newest')]
    sinks = results(callbacks, [30, 1], 350)
    assert sinks['fast']['dropped'] >= 10
    assert sinks['fast']['response_ns']['max'] <= 20 * TICK


def test_the_age_of_a_dropped_execution_is_passed_on_to_the_next_one_only():
    """If that is in time, an execution that is late much later is demoted like any other."""
    core = live(declaration([
        single(name, 100, 100, on_late='demote', keep=keep)
        for name, keep in (('slow', 'newest'), ('other', 'all'))]), workers=1)

    def ready(dag, job, now):
        x = core.source(core.release(dag, job, now * TICK, now * TICK))
        core.ready(x, now * TICK)
        return x

    def take(now):
        return core.take(0, now * TICK)

    job = 0
    for begin in (0, 1_000_000):
        first = ready(1, job, begin)
        assert take(begin) == first
        late = ready(0, job, begin)
        core.complete(first, (begin + 150) * TICK)
        other = ready(1, job + 1, begin + 150)
        assert take(begin + 150) == other
        newest = ready(0, job + 1, begin + 160)  # drops the late one
        assert core.state.x_state[late] == DROPPED
        core.complete(other, (begin + 170) * TICK)
        assert take(begin + 170) == newest
        core.complete(newest, (begin + 180) * TICK)
        job += 2
