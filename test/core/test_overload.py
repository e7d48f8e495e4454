# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the core does in an overload, and that it does nothing without one (rules 7, 11, 12)."""

from dataclasses import replace
import random

from hypothesis import assume, given
from hypothesis import strategies as st
from mddag_executor.core import NEVER, Scheduler, Tables
from mddag_executor.core.estimates import ADMIT_NS, Estimates
from mddag_executor.core.jobs import is_miss
from mddag_executor.core.overload import admit, gives_way, note_late
from mddag_executor.core.tables import importances
from mddag_executor.core.tally import counts
from mddag_executor.resources import find
from mddag_executor.simulate import Settings, simulate
from msg_graph import ExecutionTime, load
import pytest

from ..conftest import examples
from .task_sets import Case, cases, declaration, live, single, TICK


def with_times(case, on_late=None, **more):
    """Return a case that declares its execution times, and ``more`` for each callback."""
    return replace(case, task_set=replace(case.task_set, dags=tuple(
        replace(dag, on_late=on_late, vertices=tuple(
            replace(vertex, callback=replace(
                vertex.callback, execution_time=ExecutionTime((ticks * TICK,), (50.0,)), **more))
            for vertex, ticks in zip(dag.vertices, row)))
        for dag, row in zip(case.task_set.dags, case.ticks))))


@examples(150)
@given(cases(bounds=False, importance=True), st.integers(5, 60))
def test_demote_without_an_overload_changes_nothing(case, horizon):
    case = with_times(case)
    run = case.run(horizon)
    assume(not run.tally.missed and demand(case) <= case.workers)
    end = horizon - max(v.deadline_ns or 0 for v in case.task_set.vertices) // TICK
    # what is released later may be too much for the workers
    before, after = ([event for event in each.events(each.run(horizon)) if event[0] < end]
                     for each in (case, with_times(case, on_late='demote')))
    assert before == after


def demand(case):
    """Return how many workers the executions need."""
    return sum(sum(row) * TICK / dag.period_ns
               for dag, row in zip(case.task_set.dags, case.ticks))


@examples(150)
@given(cases(importance=True), st.integers(5, 60))
def test_importance_means_nothing_if_late_jobs_are_not_demoted(case, horizon):
    """Policies whose keys are not times never demote them."""
    by_time = case.policy in ('rad', 'gedf', 'llf')
    important = with_times(case, on_late='continue' if by_time else 'demote')
    plain = with_times(case, on_late='continue', importance='normal', tolerate=None)
    assert case.events(important.run(horizon)) == case.events(plain.run(horizon))


@examples(150)
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


@examples(150)
@given(st.lists(st.sampled_from((0, 1, 'run', 'wait')), min_size=4, max_size=40))
def test_messages_of_each_topic_of_a_sync_keep_their_order(steps):
    """Also if those of the other topic belong to jobs released earlier or later."""
    scheduler = live(workers=1, on_late='demote')
    sync = 3
    executions = {}
    for job in range(len(steps) + 1):
        now = 10 * TICK * job
        slot = scheduler.release(0, job, now, now)
        scheduler.ready(scheduler.source(slot), now)
        scheduler.complete(scheduler.take(0, now), now)
        executions.update({(leg, job): scheduler.execution(slot, sync, leg) for leg in (0, 1)})
    legs = {x: each for each, x in executions.items()}
    arrived, ran = [0, 0], [0, 0]
    for step in (*steps, *['run'] * len(steps)):
        if step == 'wait':
            now += 5 * TICK
        elif step == 'run':
            x = scheduler.take(0, now)
            if x >= 0:
                leg, job = legs[x]
                assert job == ran[leg]
                ran[leg] += 1
                scheduler.complete(x, now)
        else:
            scheduler.ready(executions[step, arrived[step]], now)
            arrived[step] += 1
    assert ran == arrived


def timer(name, period, deadline, time, on_late='demote', **more):
    if on_late:
        more['on_late'] = on_late
    return single(name, period, deadline, execution_time=f'{time}us', **more)


def case_of(*timers, workers=1, preemptive=False):
    ticks = tuple((int(each['execution_time'][:-2]),) for each in timers)
    return Case(declaration(timers), ticks, workers, 'rad', preemptive)


def simulated(case, load, horizon, on_late='demote'):
    return simulate(case.task_set, load, Settings(
        pools=(case.workers,), duration_ns=horizon * TICK, preemptive=case.preemptive,
        on_late=on_late), log=True)


def results(case, horizon, holds=False):
    """Return the counts of each sink, and how many of its jobs were in time."""
    load = case.load(horizon)._replace(holds=[1] * len(case.ticks) if holds else [])
    dags = simulated(case, load, horizon).result()['dags']
    sinks = {name: next(iter(dag['sinks'].values())) for name, dag in dags.items()}
    return {name: {**sink, 'in_time': counts(sink).in_time} for name, sink in sinks.items()}


def test_demoted_callbacks_do_not_starve():
    # The sensor is always late, because the others block it for longer than its deadline.
    sinks = results(case_of(
        timer('sensor', 10, 2, 1), timer('a', 40, 80, 20), timer('b', 40, 80, 20)), 4000)
    assert sinks['sensor']['in_time'] < 200 and sinks['sensor']['demoted'] > 0
    assert sinks['sensor']['completed'] >= 4000 // (9 * 2 + 20)  # one in nine deadlines


# --- importance ----------------------------------------------------------------------------------


@pytest.mark.parametrize('preemptive', [True, False])
def test_less_important_sinks_are_demoted_first(preemptive):
    high, normal = (results(case_of(
        timer('low', 20, 20, 8, importance='low'), timer('main', 30, 40, 24, importance=main),
        preemptive=preemptive), 6000) for main in ('high', 'normal'))
    assert high['main']['in_time'] >= 199 == 6000 // 30 - 1
    assert high == normal  # normal is more than low


def test_the_highest_importance_never_gives_way():
    low, high, undeclared = (results(case_of(*(
        timer(name, 10, 10, 8, **more) for name in 'ab')), 2000)
        for more in ({'importance': 'low'}, {'importance': 'high'}, {}))
    assert low == high == undeclared


@pytest.mark.parametrize('keep', ['all', 'newest'])
def test_less_important_work_runs_when_nothing_more_important_is_ready(keep):
    """However long it takes: nothing is kept free for what may come later."""
    sinks = results(case_of(
        timer('low', 20, 20, 20, importance='low', keep=keep), timer('high', 20, 20, 10)),
        20_000)
    assert sinks['low']['completed'] >= 450 and sinks['high']['completed'] >= 900


def test_less_important_work_gives_way_to_a_late_important_sink():
    # There is room for both, but the first has the earlier deadline.
    low, high = (results(case_of(
        timer('first', 40, 10, 10, importance='low'),
        timer('second', 40, 20, 15, importance=importance)), 8000)['second']['in_time']
        for importance in ('low', 'high'))
    assert low == 0 and high >= 0.7 * 200  # the first has a turn in each eight of its deadlines


def test_nothing_gives_way_to_a_late_sink_that_gives_way_itself():
    """Neither does anything when the overload ends that it was late in."""
    scheduler = live(case_of(
        timer('low', 10, 10, 2, importance='low'), timer('normal', 10, 10, 6),
        timer('high', 10, 10, 6, importance='high')).task_set, 1)
    t, s = scheduler.tables, scheduler.state
    admit(t, s)
    assert [gives_way(t, s, vertex) for vertex in range(3)] == [True, True, False]
    note_late(t, s, 1, 0)
    s.mean[1] = TICK
    admit(t, s)
    assert not any(gives_way(t, s, vertex) for vertex in range(3))
    note_late(t, s, 1, 0)   # now it is in its own right
    assert [gives_way(t, s, vertex) for vertex in range(3)] == [True, False, False]


def test_an_important_sink_shares_its_importance_with_what_it_reads():
    """Over trigger and queue edges: topics that it takes, and callbacks of its node."""
    found = importances(declaration([
        {'node': '/camera', 'name': 'grab', 'timer': '100us', 'publishes': ['/image']},
        {'node': '/logger', 'name': 'log', 'subscription': '/image', 'deadline': '90us',
         'importance': 'low'},
        {'node': '/detector', 'name': 'detect', 'subscription': '/image', 'deadline': '90us',
         'publishes': ['/objects'], 'importance': 'low'},
        {'node': '/odometry', 'name': 'step', 'timer': '50us', 'deadline': '50us'},
        {'node': '/brake', 'name': 'listen', 'timer': '20us', 'deadline': '20us',
         'importance': 'low'},
        {'node': '/brake', 'name': 'brake', 'timer': '10us', 'deadline': '10us',
         'reads': ['/objects', 'listen'], 'importance': 'high'}]))
    names = {0: 'low', 1: 'normal', 2: 'high'}
    assert [names[each] for each in found] == ['high', 'low', 'high', 'normal', 'high', 'high']


def simulated_runs(late, **keys):
    """Return when a timer of 40 ticks, deadline 100, starts next to two others with load 1."""
    case = case_of(
        timer('rare', 40, 100, 5, **keys), timer('a', 10, 10 + late, 5), timer('b', 10, 10, 5))
    load = case.load(20_000)
    events = case.events(simulated(case, load, 20_000))
    return [time for time, kind, _, dag, _, _ in events if (kind, dag) == ('start', 0)]


@pytest.mark.parametrize('keep', ['all', 'newest'])
@pytest.mark.parametrize('importance', ['low', 'normal'])
@pytest.mark.parametrize('late', [0, 1])
def test_each_callback_runs_once_in_about_eight_deadlines(keep, importance, late):
    """Also if each message is replaced before it is late: its age stays with the queue."""
    starts = [0, *simulated_runs(late, keep=keep, importance=importance), 20_000]
    assert max(after - before for before, after in zip(starts, starts[1:])) <= 8 * 100 + 30


@examples(150)
@given(cases(('rad', 'gedf', 'llf'), max_dags=4, max_callbacks=1, groups=False, bounds=False,
             importance=True, newest=True), st.integers(1, 5))
def test_no_callback_starves(case, heavier):
    """
    Each timer starts within eight of its relative deadlines, in an overload of any size.

    While it waits, executions of others may have to run that have begun, or are as late: twice one
    of each callback at the most.
    """
    assume(all(len(dag.vertices) == 1 for dag in case.task_set.dags))
    case = with_times(replace(case, preemptive=False, ticks=tuple(
        tuple(heavier * ticks for ticks in row) for row in case.ticks)), on_late='demote')
    deadlines = [dag.vertices[0].deadline_ns // TICK for dag in case.task_set.dags]
    horizon = 24 * max(deadlines) + 200
    load = case.load(horizon)
    starts = [[-1] for _ in deadlines]
    for time, kind, _, dag, _, _ in case.events(case.run(horizon)):
        if kind == 'start':
            starts[dag].append(time)
    for dag, times in enumerate(starts):
        releases = [time // TICK for time, other in zip(load.times, load.dags) if other == dag]
        most = 8 * deadlines[dag] + 2 * sum(map(sum, case.ticks))
        for last, start in zip(times, [*times[1:], horizon]):
            waits_since = min((time for time in releases if time > last), default=start)
            assert start - waits_since <= most, (dag, last, waits_since, start)


def chain(name, period, deadline, times, **more):
    """
    Declare a DAG of callbacks one after the other, each with its execution time; in ticks.

    :param more: keys of its sink.
    """
    last = len(times) - 1
    return [{'node': f'/{name}{place}', 'name': f'{name}{place}', 'execution_time': f'{time}us',
             **({'publishes': [f'/{name}{place}']} if place < last else {
                 'deadline': deadline, **more}),
             **({'subscription': f'/{name}{place - 1}'} if place else {
                 'timer': f'{period}us', 'dag': name, 'on_late': 'demote'})}
            for place, time in enumerate(times)]


@pytest.mark.parametrize('capacity', [2, 5, 13, 20])
def test_no_dag_of_several_callbacks_starves(capacity):
    """
    Each callback starts again and again, however far the load is above the capacity.

    One sink of the short DAG is never in time.  When its source comes first, it has a release that
    can be in time at the other sink, but later than all the late work that the others have.
    """
    short = [1, 2, 2, 2, 1]
    others = [(100, 60, (40, 60, 90)), (50, 45, (30, 80)), (50, 33, (17, 17)), (100, 74, (70, 40)),
              (50, 30, (30, 35))]
    usual = sum(sum(times) / period for period, _, times in others)
    rows = [tuple(max(1, round(time * (capacity - 0.3) / usual)) for time in times)
            for _, _, times in others]
    task_set = declaration([
        *chain('short', 10, '6us', short[:4]),
        {'node': '/quick', 'name': 'quick', 'subscription': '/short0', 'deadline': '9us',
         'execution_time': '1us'}, *(
            each for number, ((period, deadline, _), row) in enumerate(zip(others, rows))
            for each in chain(f'd{number}x', period, f'{deadline}us', row))])
    case = Case(task_set, (tuple(short), *rows), 1, 'rad', False)
    each_once = sum(map(sum, case.ticks))
    horizon = 40 * each_once
    starts = {}
    load = case.load(horizon)
    for time, kind, _, dag, vertex, _ in case.events(simulated(case, load, horizon)):
        if kind == 'start':
            starts.setdefault((dag, vertex), [0]).append(time)
    assert len(starts) == len(task_set.vertices)
    for (dag, _), times in starts.items():
        longest = max(after - before for before, after in zip(times, [*times[1:], horizon]))
        assert longest <= 10 * max(
            task_set.dags[dag].vertices[sink].deadline_ns for sink in task_set.dags[dag].sinks
        ) / TICK + 4 * each_once, (dag, times[-3:])


def overloaded(seed):
    """Return chains at three times the capacity, with callback groups and importance, by seed."""
    rng = random.Random(seed)
    callbacks, rows = [], []
    shares = [rng.expovariate(1) + 0.05 for _ in range(rng.randint(4, 8))]
    for number, share in enumerate(shares):
        period = rng.choice([10, 20, 50, 100, 500])
        parts = [rng.random() + 0.1 for _ in range(rng.randint(1, 3))]
        row = tuple(max(1, round(3 * period * share / sum(shares) * part / sum(parts)))
                    for part in parts)
        deadline = rng.choice([f'{round(period * rng.uniform(0.5, 2))}us'] * 3 + ['none'])
        more = {} if deadline == 'none' else {
            'importance': rng.choice(['high', 'normal', 'low'])}
        mine = chain(f'd{number}x', period, deadline, row, **more)
        for callback in mine:
            callback['node'] = rng.choice(['/n', '/m'])
            if rng.random() < 0.7:
                callback['group'] = rng.choice('gh')
        callbacks += mine
        rows.append(row)
    return Case(declaration(callbacks), tuple(rows), rng.randint(1, 2), 'rad', rng.random() < 0.5)


@pytest.mark.parametrize('seed', [12, 30, 50, 58, 81, 94, 110, 113])
def test_each_callback_of_a_chain_has_its_turn(seed):
    """Also if its callback group is busy, or a preempted callback owns the group."""
    case, horizon = overloaded(seed), 12_000
    starts = {}
    for time, kind, _, dag, vertex, _ in case.events(
            simulated(case, case.load(horizon), horizon)):
        if kind == 'start':
            starts.setdefault((dag, vertex), [0]).append(time)
    each_once = sum(map(sum, case.ticks))
    for dag in case.task_set.dags:
        deadlines = [dag.vertices[sink].deadline_ns for sink in dag.sinks]
        most = (dag.period_ns + 8 * max(deadlines, default=NEVER)) / TICK + 2 * each_once
        for vertex in dag.vertices:
            times = starts.get((dag.index, vertex.index), [0])
            assert max(after - before for before, after in zip(times, [*times[1:], horizon])) <= (
                most), (vertex.name, times[-3:])


def test_a_measured_time_that_is_not_renewed_is_forgotten():
    """If a callback no longer runs, or runs seldom, its declared time counts again."""
    scheduler = live(with_times(case_of(timer('a', 10, 10, 4), timer('b', 10, 10, 4))).task_set)
    s = scheduler.state
    note = Estimates(scheduler.tables, s).note
    slow = 1000 * TICK
    for vertex, now in ((0, 0), (1, 0), (1, 90), (1, 100)):
        note(vertex, slow, 0, now * TICK)
    assert s.mean[:2] == [slow, slow] and s.reach_by[:2] == [10 * TICK - slow] * 2
    note(1, slow, 0, 101 * TICK)
    assert s.mean[:2] == [4 * TICK, slow] and s.reach_by[0] == 6 * TICK


def test_measured_times_change_the_latest_starts_of_all_vertices_before():
    """As computed from the sinks, in a declaration of eleven DAGs; the demand follows soon."""
    scheduler = Scheduler(Tables.build(load(find('config/autoware.yaml')), legs=True), 7)
    t, s = scheduler.tables, scheduler.state
    admit(t, s)
    estimates, rng = Estimates(t, s), random.Random(1)
    for now in range(200):
        estimates.note(rng.randrange(t.n_vertices), rng.randrange(1_000_000), 0, now)
    for vertex in range(t.n_vertices):
        for i in range(t.first_reach[vertex], t.first_reach[vertex + 1]):
            assert s.reach_by[i] == latest_start(t, s.mean, vertex, t.reach_sink[i])
    assert not s.overloaded[1]
    for vertex in range(t.n_vertices):
        estimates.note(vertex, 10 ** 9, 0, 200)
    assert not s.overloaded[1]
    estimates.note(0, 10 ** 9, 0, 200 + ADMIT_NS)
    assert s.overloaded[1]


def latest_start(t, means, vertex, sink):
    """Return by when a vertex must start, after its release, so that a sink is in time; ns."""
    after = t.successors[t.first_successor[vertex]:t.first_successor[vertex + 1]]
    starts = [latest_start(t, means, each, sink) for each in after]
    if vertex == sink:
        starts.append(t.sink_deadline[sink])
    return min(starts, default=NEVER) - means[vertex]


# --- bursts --------------------------------------------------------------------------------------


def test_a_backlog_of_a_heavy_callback_leaves_the_others_in_time():
    # One interpreter for all; the heavy one has a long deadline, but its late jobs have the first.
    plain, demoted = (results(case_of(
        timer('publisher', 2000, 2000, 50, on_late), timer('heavy', 5000, 50000, 4000, on_late),
        timer('other', 10000, 10000, 2500, on_late), workers=7), 1_000_000, holds=True)
        for on_late in ('continue', 'demote'))
    assert plain['publisher']['in_time'] < 0.96 * 500 <= demoted['publisher']['in_time']


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
    return [(dag, times[dag][job] // TICK)
            for kind, dag, _, job, _, _ in simulated(case, load, horizon, on_late).decisions
            if is_miss(kind)]


@pytest.mark.parametrize('extra', [3, 6, 10, 20])
def test_a_burst_is_worked_off(extra):
    """No more is late than with ``continue``, and nothing once there is room for the backlog."""
    case = case_of(timer('burst', 20, 40, 8, None), timer('other', 10, 10, 4, None),
                   timer('slow', 60, 60, 3, None))
    missed = {on_late: misses_of_a_burst(case, 7, extra, 2000, on_late)
              for on_late in ('continue', 'demote')}
    assert 0 < len(missed['demote']) <= len(missed['continue'])
    assert max(time for _, time in missed['demote']) < 500 + extra * 8 / (1 - demand(case))
