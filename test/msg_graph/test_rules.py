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
