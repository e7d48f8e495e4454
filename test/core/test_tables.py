# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Task sets flattened into columns, and the keys of the policies."""

from __future__ import annotations

from mddag_executor.core import NEVER, policy, PolicyError, rad_offsets, Tables
from mddag_executor.core.tables import ABORT, CONTINUE
from msg_graph import TaskSet
import pytest

from .task_sets import declaration

US = 1_000


def two_dags() -> TaskSet:
    return declaration([
        {'node': '/a', 'name': 's', 'timer': '10us', 'publishes': ['/s', '/all'], 'dag': 'first',
         'max_active_jobs': 4, 'on_late': 'abort', 'group': 'g'},
        {'node': '/a', 'name': 'late', 'subscription': '/s', 'deadline': '30us', 'group': 'g'},
        {'node': '/b', 'name': 't', 'timer': '20us', 'publishes': ['/t', '/all'],
         'dag': 'second', 'group': 'g'},
        {'node': '/a', 'name': 'mid', 'subscription': '/s', 'publishes': ['/mid']},
        {'node': '/a', 'name': 'both', 'sync': ['/mid', '/s'], 'deadline': '25us'},
        {'node': '/b', 'name': 'shared', 'subscription': '/all', 'deadline': '40us',
         'group': 'g'},
    ])


def test_columns_of_two_dags() -> None:
    tables = Tables.build(two_dags(), max_active_jobs=9, expire_after=7, default_deadline=1)
    # first: s, late, mid, both, shared; second: t, shared; then the undeclared one.
    assert tables.n_dags == 2
    assert tables.n_vertices == 7
    assert tables.dag_of == [0, 0, 0, 0, 0, 1, 1, 2]
    assert tables.index_in_dag == [0, 1, 2, 3, 4, 0, 1, 0]
    assert tables.first_vertex == [0, 5, 7]
    assert tables.source == [0, 5, 7]
    assert tables.period == [10 * US, 20 * US, 1]
    assert tables.rad_offset == [us * US for us in (25, 30, 25, 25, 40, 40, 40)] + [1]
    assert tables.dag_deadline == [40 * US, 40 * US, 1]
    assert tables.sink_deadline == [-1, 30 * US, -1, 25 * US, 40 * US, -1, 40 * US, -1]
    assert tables.sinks == [1, 3, 4, 6]
    assert tables.first_sink == [0, 3, 4, 4]
    assert tables.on_late == [ABORT, CONTINUE, CONTINUE]
    assert tables.max_active_jobs == [4, 9, NEVER]
    assert tables.expire_after == [7, 7, NEVER]
    assert tables.n_predecessors == [0, 1, 1, 2, 1, 0, 1, 0]
    successors = [tables.successors[tables.first_successor[v]:tables.first_successor[v + 1]]
                  for v in range(7)]
    assert successors == [[4, 3, 2, 1], [], [3], [], [], [6], []]  # the last listed first


def test_groups_belong_to_their_node() -> None:
    tables = Tables.build(two_dags())
    assert tables.group == [0, 0, -1, -1, 1, 1, 1, -1]
    assert tables.n_groups == 2
    assert set(Tables.build(two_dags(), groups=False).group) == {-1}


def test_a_sync_has_a_leg_for_each_topic() -> None:
    plain, legs = Tables.build(two_dags()), Tables.build(two_dags(), legs=True)
    assert plain.n_legs == [1] * 8
    assert plain.n_region == [5, 2, 1]
    assert legs.n_legs == [1, 1, 1, 2, 1, 1, 1, 1]
    assert legs.n_region == [6, 2, 1]
    assert legs.region_offset == [0, 1, 2, 3, 5, 0, 1, 0]


def test_a_sync_has_a_leg_for_each_publisher_of_a_topic() -> None:
    tables = Tables.build(declaration([
        {'node': '/n', 'name': 's', 'timer': '10us', 'publishes': ['/s', '/x'], 'dag': 'd'},
        {'node': '/n', 'name': 'x', 'subscription': '/s', 'publishes': ['/x', '/y']},
        {'node': '/n', 'name': 'join', 'sync': ['/x', '/y'], 'deadline': '9us'}]), legs=True)
    assert tables.n_legs[:3] == [1, 1, 3]
    assert tables.n_predecessors[:3] == [0, 1, 3]
    assert tables.leg_topic[tables.first_leg[2]:tables.first_leg[3]] == [0, 0, 1]


def test_rad_of_a_long_chain_is_found_without_recursion() -> None:
    n = 3_000
    chain = [{'node': '/n', 'name': 'c0', 'timer': '1ms', 'publishes': ['/t0'], 'dag': 'd'}]
    chain += [{'node': '/n', 'name': f'c{i}', 'subscription': f'/t{i - 1}',
               'publishes': [f'/t{i}']} for i in range(1, n)]
    chain[-1] = {**{k: v for k, v in chain[-1].items() if k != 'publishes'}, 'deadline': '5ms'}
    assert rad_offsets(declaration(chain).dags[0]) == [5_000_000] * n


def test_latest_start_by_hand() -> None:
    """The sink with the earlier deadline is not the one that has to start first."""
    tables = Tables.build(declaration([
        {'node': '/n', 'name': 's', 'timer': '90us', 'publishes': ['/s'], 'dag': 'd',
         'execution_time': '2us'},
        {'node': '/n', 'name': 'quick', 'subscription': '/s', 'deadline': '40us'},
        {'node': '/n', 'name': 'way', 'subscription': '/s', 'publishes': ['/w'],
         'execution_time': {'quantiles_us': [10, 30]}},
        {'node': '/n', 'name': 'long', 'subscription': '/w', 'deadline': '60us',
         'execution_time': '15us'}]), default_deadline=7)
    assert tables.rad_offset == [40 * US, 40 * US, 60 * US, 60 * US, 7]
    assert tables.latest_start == [23 * US, 40 * US, 25 * US, 45 * US, 7]
    assert policy('llf').key(tables, 2, 1_000, 6, 9) == (1_000 + 25 * US, 2, 0, 9)


@pytest.mark.parametrize(('name', 'key'), [
    ('rad', (1_000 + 25 * US, 3, 0, 9)),
    ('gedf', (1_000 + 40 * US, 3, 0, 9)),
    ('rm', (10 * US, 6, 9, 0)),
    ('wc', (6, 9, 0, 0)),
    ('fifo', (9, 0, 0, 0)),
    ('dm', (25 * US, 6, 9, 0)),
    ('ros2', (4, 9, 0, 0)),
    ('picas', (0, 9, 0, 0)),
])
def test_keys(name: str, key: tuple[int, ...]) -> None:
    """Vertex 3 of the first DAG, job 6, released at 1000, order 9."""
    tables = Tables.build(two_dags())
    assert policy(name).key(tables, 3, 1_000, 6, 9) == key


def test_modes() -> None:
    assert [policy('rad').mode(asked) for asked in (None, True, False)] == [True, True, False]
    assert [policy('picas').mode(asked) for asked in (None, True, False)] == [False, True, False]
    assert [policy('ros2').mode(asked) for asked in (None, False)] == [False, False]
    with pytest.raises(PolicyError, match="policy 'ros2': .*: run it without preemption"):
        policy('ros2').mode(True)


def test_entities_are_callbacks_by_kind_and_place() -> None:
    """Timers s, t; then late, mid, both, shared, which is one entity for its two vertices."""
    tables = Tables.build(two_dags())
    assert tables.entity == [0, 2, 3, 4, 5, 1, 5, 6]
    assert tables.n_entities == 6
    legs = Tables.build(two_dags(), legs=True)  # both takes 4 and 5
    assert legs.entity == [0, 2, 3, 4, 6, 1, 6, 7]
    assert legs.n_entities == 7
    assert Tables.build(None).entity == [0]


def test_chain_ranks() -> None:
    """Most urgent is the chain s, mid, both (25 us), from its end; then late (30), shared, t."""
    tables = Tables.build(two_dags(), default_deadline=27 * US)
    # s, late, mid, both, shared; t, shared, which has the rank of its chain in the first DAG, with
    # the shorter period; the undeclared one stands between both chains.
    assert tables.chain_rank == [2, 4, 1, 0, 5, 6, 5, 3]


def test_chains_of_equal_deadlines_go_by_period_then_by_dag() -> None:
    tables = Tables.build(declaration([
        {'node': '/n', 'name': name, 'timer': f'{period}us', 'deadline': '90us', 'dag': name}
        for name, period in (('a', 20), ('b', 10), ('c', 20))]))
    assert tables.chain_rank[:3] == [1, 0, 2]
