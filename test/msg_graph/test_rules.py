# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The rules of the model, one by one: what is derived."""

from __future__ import annotations

from msg_graph import TaskSet

from .helpers import graph


def names(tasks: TaskSet) -> dict[str, list[str]]:
    return {dag.name: [vertex.name for vertex in dag.vertices] for dag in tasks.dags}


def edges(tasks: TaskSet) -> dict[str, list[tuple[str, str]]]:
    return {
        dag.name: [(dag.vertices[a].name, dag.vertices[b].name) for a, b in dag.edges]
        for dag in tasks.dags}


def test_trigger_edges_come_from_topics() -> None:
    tasks = graph("""
        - node: /n
          callbacks:
            - {name: end, subscription: /b, deadline: 30ms}
            - {name: middle, subscription: /a, publishes: [/b, /unheard]}
            - {name: start, timer: 10ms, publishes: [/a]}
    """)
    assert names(tasks) == {'/n': ['/n:end', '/n:middle', '/n:start']}
    assert edges(tasks) == {'/n': [('/n:middle', '/n:end'), ('/n:start', '/n:middle')]}
    dag = tasks.dags[0]
    assert (dag.source, dag.sinks, dag.edges) == (2, (0,), ((1, 0), (2, 1)))
    assert [vertex.predecessors for vertex in dag.vertices] == [(1,), (2,), ()]
    assert [vertex.successors for vertex in dag.vertices] == [(), (0,), (1,)]
    assert [vertex.deadline_ns for vertex in dag.vertices] == [30_000_000, None, None]
    assert dag.period_ns == 10_000_000


def test_queue_edges_start_nothing_and_are_kept() -> None:
    tasks = graph("""
        - node: /n
          callbacks:
            - {name: a, timer: 10ms, publishes: [/a], deadline: 10ms, reads: [/b]}
        - node: /m
          callbacks:
            - {name: b, timer: 20ms, publishes: [/b], deadline: 10ms, reads: [/a, c, b]}
            - {name: c, timer: 20ms, publishes: [/b], deadline: 10ms, dag: c}
    """)
    assert names(tasks) == {'/n': ['/n:a'], '/m': ['/m:b'], 'c': ['/m:c']}
    assert [(e.reader, e.topic, e.writers) for e in tasks.queue_edges] == [
        ('/n:a', '/b', ('/m:b', '/m:c')), ('/m:b', '/a', ('/n:a',)),
        ('/m:b', None, ('/m:c',)), ('/m:b', None, ('/m:b',))]


def test_or_gives_a_vertex_for_each_publisher_and_so_after_it() -> None:
    tasks = graph("""
        - node: /end
          callbacks:
            - {name: e, subscription: /c, deadline: 10ms}
        - node: /first
          callbacks:
            - {name: t, timer: 10ms, publishes: [/a], dag: one}
        - node: /middle
          callbacks:
            - {name: m, subscription: /a, publishes: [/c]}
        - node: /second
          callbacks:
            - {name: t, timer: 20ms, publishes: [/a], dag: two}
    """)
    assert edges(tasks) == {
        'one': [('/first:t', '/middle:m@one'), ('/middle:m@one', '/end:e@one')],
        'two': [('/middle:m@two', '/end:e@two'), ('/second:t', '/middle:m@two')]}
    assert [(d.index, d.source, d.sinks) for d in tasks.dags] == [(0, 1, (0,)), (1, 2, (0,))]
    assert all(v.dag == d.index for d in tasks.dags for v in d.vertices)
    assert len(tasks.vertices) == 6
    assert len(tasks.callbacks) == 4


def test_dags_are_called_after_their_sources() -> None:
    tasks = graph("""
        - node: /one
          callbacks:
            - {name: t, timer: 10ms, deadline: 10ms}
        - node: /several
          callbacks:
            - {name: t, timer: 10ms, deadline: 10ms}
            - {name: s, service: /s, period: 1s, deadline: 10ms}
            - {name: u, timer: 20ms, deadline: 10ms, dag: own}
    """)
    assert [dag.name for dag in tasks.dags] == ['/one', '/several/t', '/several/s', 'own']


def test_or_within_one_dag() -> None:
    """Copies are ordered by their callbacks, then by what starts them, and are numbered."""
    tasks = graph("""
        - node: /n
          callbacks:
            - {name: end, subscription: /c, deadline: 10ms}
            - {name: right, subscription: /a, publishes: [/b]}
            - {name: start, timer: 10ms, publishes: [/a], dag: d}
            - {name: left, subscription: /a, publishes: [/b, /c]}
            - {name: join, subscription: /b, publishes: [/c]}
    """)
    dag = tasks.dags[0]
    assert [v.name for v in dag.vertices] == [
        '/n:end@d#1', '/n:end@d#2', '/n:end@d#3', '/n:right', '/n:start', '/n:left',
        '/n:join@d#1', '/n:join@d#2']
    # end: for left (in the file before join), then for join's two vertices
    assert dag.edges == ((3, 6), (4, 3), (4, 5), (5, 0), (5, 7), (6, 1), (7, 2))
    assert dag.sinks == (0, 1, 2)


def test_or_in_one_dag_and_another() -> None:
    tasks = graph("""
        - node: /n
          callbacks:
            - {name: one, timer: 10ms, publishes: [/a, /b], dag: one}
            - {name: two, timer: 10ms, publishes: [/b], dag: two}
            - {name: again, subscription: /a, publishes: [/b]}
            - {name: end, subscription: /b, deadline: 10ms}
    """)
    assert names(tasks) == {
        'one': ['/n:one', '/n:again', '/n:end@one#1', '/n:end@one#2'],
        'two': ['/n:two', '/n:end@two']}


def test_and_gives_one_vertex_with_all_predecessors() -> None:
    tasks = graph("""
        - node: /n
          callbacks:
            - {name: t, timer: 10ms, publishes: [/a, /b, /c]}
            - {name: x, subscription: /a, publishes: [/d]}
            - {name: y, subscription: /b, publishes: [/d]}
            - {name: s, sync: [/d, /c, /a], deadline: 10ms}
    """)
    dag = tasks.dags[0]
    assert dag.vertices[3].name == '/n:s'
    assert dag.vertices[3].predecessors == (0, 1, 2)
    assert dag.edges == ((0, 1), (0, 2), (0, 3), (1, 3), (2, 3))


def test_and_joins_copies_made_by_or() -> None:
    tasks = graph("""
        - node: /n
          callbacks:
            - {name: s, sync: [/d, /a], deadline: 10ms}
            - {name: t, timer: 10ms, publishes: [/a, /b]}
            - {name: u, subscription: /a, publishes: [/b]}
            - {name: v, subscription: /b, publishes: [/d]}
    """)
    assert edges(tasks)['/n'] == [
        ('/n:t', '/n:s'), ('/n:t', '/n:u'), ('/n:t', '/n:v@/n#1'), ('/n:u', '/n:v@/n#2'),
        ('/n:v@/n#1', '/n:s'), ('/n:v@/n#2', '/n:s')]


def test_one_edge_where_a_sync_takes_two_topics_of_one_publisher() -> None:
    tasks = graph("""
        - node: /n
          callbacks:
            - {name: t, timer: 10ms, publishes: [/a, /b]}
            - {name: s, sync: [/a, /b], deadline: 10ms}
    """)
    assert tasks.dags[0].edges == ((0, 1),)


def test_sources_from_outside_need_no_publisher() -> None:
    tasks = graph("""
        - node: /n
          callbacks:
            - {name: t, subscription: /camera, period: 33ms, publishes: [/a]}
            - {name: u, service: /ask, period: 1s, deadline: 100ms, dag: ask}
            - {name: v, subscription: /a, deadline: 100ms}
    """)
    assert names(tasks) == {'/n': ['/n:t', '/n:v'], 'ask': ['/n:u']}
    assert [dag.period_ns for dag in tasks.dags] == [33_000_000, 1_000_000_000]


def test_two_sources_from_outside_by_one_topic() -> None:
    tasks = graph("""
        - node: /n
          callbacks:
            - {name: t, subscription: /camera, period: 33ms, deadline: 33ms}
        - node: /m
          callbacks:
            - {name: t, subscription: /camera, period: 33ms, deadline: 33ms}
    """)
    assert names(tasks) == {'/n': ['/n:t'], '/m': ['/m:t']}


def test_sinks_have_deadlines_of_their_own_also_beyond_the_period() -> None:
    tasks = graph("""
        - node: /n
          callbacks:
            - {name: t, timer: 10ms, publishes: [/a]}
            - {name: x, subscription: /a, deadline: 5ms}
            - {name: y, subscription: /a, deadline: 500ms}
    """)
    assert [tasks.dags[0].vertices[i].deadline_ns for i in tasks.dags[0].sinks] == [
        5_000_000, 500_000_000]


def test_a_lone_callback_is_source_and_sink() -> None:
    dag = graph("""
        - node: /n
          callbacks:
            - {name: t, timer: 10ms, deadline: 7ms}
    """).dags[0]
    assert (dag.source, dag.sinks, dag.edges) == (0, (0,), ())
