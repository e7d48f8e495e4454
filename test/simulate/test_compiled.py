# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The compiled core against the plain one: the same starts, ends and decisions.

Both are the same source; what this finds is where compiled arithmetic, lists or heaps differ.
"""

from dataclasses import replace
from itertools import accumulate
import os
from pathlib import Path
import random
import shutil

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core import Tables, Tally
from mddag_executor.laboratory.experiment import judge_of
from mddag_executor.simulate import compiled, schedule, Settings, simulate
from mddag_executor.simulate.policies import ROS2
from mddag_executor.simulate.workload import as_arrays, FAILS, RUNS, SKIPPED
import numpy as np
import pytest

from ..conftest import examples, run_program
from ..core.task_sets import cases, TICK

pytestmark = pytest.mark.skipif(not compiled.available(), reason='llvmlite is not there')
EVERY_RULE = cases(overheads=True, importance=True)


def settings_of(case, horizon, judge, stop):
    return Settings(
        policy=case.policy, pools=(case.workers,), duration_ns=horizon * TICK,
        preemptive=case.preemptive, judge=judge, stop_at_first_miss=stop,
        dispatch_overhead_ns=case.dispatch_overhead * TICK,
        switch_overhead_ns=case.switch_overhead * TICK)


def compare(case, horizon, judge='horizon', stop=False):
    """Run a case both ways."""
    settings = settings_of(case, horizon, judge, stop)
    load_ = case.load(horizon)
    plain = simulate(case.task_set, load_, settings, log=True)
    tables = Tables.build(case.task_set)
    found = schedule(tables, load_, settings, log=True, compiled=True)
    tally = Tally(case.task_set, tables)
    found.count_into(tally, load_, settings)
    assert tally.result() == plain.tally.result()
    assert found.log == plain.log
    assert found.decisions == plain.decisions
    assert found.ended == plain.ended_ns


@examples(300)
@given(EVERY_RULE, st.integers(5, 60), st.sampled_from(['horizon', 'completions']),
       st.booleans())
def test_everything_at_once(case, horizon, judge, stop):
    """Groups, bounds and overheads too."""
    compare(case, horizon, judge, stop)


@examples(30)
@given(EVERY_RULE, st.integers(5, 60))
def test_large_results_stay_where_the_core_wrote_them(case, horizon):
    """Decisions and log have room from the beginning, and are not copied."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiled, '_MANY', 0)
        compare(case, horizon)
        compare(case, horizon, stop=True)
        load = case.load(horizon)
        found = schedule(Tables.build(case.task_set), load, settings_of(
            case, horizon, 'horizon', False), compiled=True)
        assert not len(found.decisions) or not np.asarray(found.decisions).flags.owndata


SLOW = 400
"""Times are multiplied by this, so that some are switch intervals and slices of a machine."""


def slowed(tables, processes, chances):
    """Return tables with longer times, and vertices in any of the processes."""
    columns = {name: [time * SLOW if time >= 0 else time for time in getattr(tables, name)]
               for name in ('period', 'dag_deadline', 'rad_offset', 'sink_deadline')}
    return tables._replace(
        **columns, process=[chances.randint(1, processes) for _ in tables.process])


def with_everything(load_, tables, chances):
    """Return a load, slowed, that is different for each job, with all that a load may have."""
    jobs = [load_.dags.count(dag) for dag in range(tables.n_dags)]
    sizes = [tables.n_region[dag] for dag in range(tables.n_dags)]
    first = [tables.first_successor[v] for v in tables.first_vertex]
    edges = [after - before for before, after in zip(first, first[1:])]
    vertices = [v for dag, size in enumerate(sizes) for _ in range(jobs[dag])
                for v in range(tables.first_vertex[dag], tables.first_vertex[dag] + size)]
    costs = [chances.randint(0, 9) * TICK * SLOW + chances.randint(0, 3) for _ in vertices]
    computes, sends, stops = (chances.random() < 0.7 for _ in range(3))

    def some(values, weights):
        return chances.choices(values, weights, k=len(costs))

    load_ = load_._replace(
        times=[time * SLOW for time in load_.times], costs=costs, cost_stride=sizes,
        cost_base=[0, *accumulate(a * b for a, b in zip(jobs, sizes))][:-1],
        fates=some([RUNS, FAILS, SKIPPED], [9, 1, 1]) if sends else [],
        releases=[max(0, time - chances.randint(0, 3) * TICK) * SLOW for time in load_.times])
    if stops:
        load_ = load_._replace(holds=[
            tables.process[v] * each for v, each in zip(vertices, some([0, 1], [1, 1]))])
    if stops and computes:
        load_ = load_._replace(
            computed=[chances.choice([cost, cost // 2, cost // 9, -1]) for cost in costs])
    if sends:
        delays = [chances.choice([0, 0, 1, 7, -1, -3, -8]) * TICK * SLOW
                  for dag, number in enumerate(edges) for _ in range(jobs[dag] * number)]
        load_ = load_._replace(
            delays=delays, delay_stride=edges,
            delay_base=[0, *accumulate(a * b for a, b in zip(jobs, edges))][:-1])
    return load_


@examples(250)
@given(EVERY_RULE, st.integers(5, 60), st.booleans(), st.integers(0, 2 ** 32))
def test_machine_messages_and_processes(case, horizon, stop, seed):
    chances = random.Random(seed)
    one = case.preemptive or case.policy == ROS2
    settings = replace(
        settings_of(case, horizon * SLOW, 'horizon', stop),
        cpus=chances.choice([None, 1, 2, 3]))
    if not one:
        settings = replace(settings, pools=tuple(
            chances.randint(1, 4) for _ in range(chances.randint(1, 3))))
    tables = slowed(Tables.build(case.task_set), len(settings.pools), chances)
    load_ = with_everything(case.load(horizon), tables, chances)
    plain, found = (
        schedule(tables, load_, settings, log=True, compiled=compiled)
        for compiled in (False, True))
    assert found == plain
    assert schedule(tables, as_arrays(load_), settings, log=True) == plain


@examples(10)
@given(cases(overheads=True, importance=True, max_callbacks=12))
def test_long_runs(case):
    """Overload for long: slots, queues and stale entries grow and are swept."""
    compare(case, 1500)


@examples(150)
@given(EVERY_RULE, st.integers(5, 60), st.sampled_from(['horizon', 'completions']), st.data())
def test_runs_do_not_disturb_one_another(case, horizon, judge, data):
    """Several runs in one memory give the verdicts that each gives alone."""
    settings = settings_of(case, horizon, judge, True)
    columns = len(case.task_set.vertices)
    times = np.array(data.draw(st.lists(
        st.lists(st.integers(1, 9), min_size=columns, max_size=columns), min_size=1,
        max_size=6)), dtype=np.int64) * TICK
    found, plain = (judge_of(case.task_set, settings.duration_ns, compiled)(settings, times)
                    for compiled in (True, False))
    assert found.tolist() == plain.tolist()


COMPILE = """
import sys
from mddag_executor.simulate import compiled
pays = compiled.pays(0.1)
assert 'llvmlite' not in sys.modules
compiled.prepare()
print(pays, 'mddag_executor.simulate.kernel' in sys.modules)
"""


def test_compiled_code_is_stored(tmp_path, monkeypatch):
    """It is used if it is whole; a folder that is not writable changes nothing but the time."""
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))

    def compiles():
        return run_program(COMPILE)[0]

    assert compiles() == 'False True\n'
    assert compiles() == 'True False\n'
    stored, = (path for path in (tmp_path / 'cache').rglob('*') if path.is_file())
    whole = stored.read_bytes()
    stored.write_bytes(whole[:-100])
    assert compiles() == 'False True\n' and stored.read_bytes() == whole
    monkeypatch.setenv('XDG_CACHE_HOME', '/dev/null')
    assert compiles() == 'False True\n'


def test_stored_code_is_that_of_the_sources(tmp_path, monkeypatch):
    package = Path(compiled.__file__).parent.parent
    for folder in ('core', 'compiler', 'simulate'):
        shutil.copytree(package / folder, tmp_path / folder)
    monkeypatch.setattr(compiled, '__file__', str(tmp_path / 'simulate' / 'compiled.py'))
    path_of = compiled._path.__wrapped__
    assert path_of() == compiled._path()
    found = {path_of()}
    for source in ('core/queues.py', 'compiler/writer.py', 'simulate/engine.py'):
        with (tmp_path / source).open('a') as file:
            file.write('#')
        found.add(path_of())
    assert len(found) == 4


def test_only_the_newest_versions_remain(tmp_path, monkeypatch):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    folder = compiled._path.__wrapped__().parent
    folder.mkdir()
    for number in range(20):
        old = folder / f'core-{number:02}.bin'
        old.touch()
        os.utime(old, (number, number))
    (folder / 'core-gone.bin').symlink_to('missing')  # just removed by another process
    for name in ('core-old.1.part', 'core-new.2.part'):
        (folder / name).touch()
    os.utime(folder / 'core-old.1.part', (0, 0))
    monkeypatch.setattr(compiled, '_path', lambda: folder / 'core-new.bin')
    compiled._store(b'code')
    assert sorted(path.name for path in folder.iterdir()) == [
        *(f'core-{number}.bin' for number in range(13, 20)), 'core-new.2.part', 'core-new.bin']
    assert compiled._stored_code() == b'code'
