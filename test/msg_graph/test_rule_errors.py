# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The rules of the model, one by one: where each error is seen, and what it names."""

from __future__ import annotations

from msg_graph import GraphError, GraphErrors, loads
import pytest

from .helpers import graph, MARK, nodes_error


def test_topic_nobody_publishes() -> None:
    nodes_error(f"""
        - node: /n
          callbacks:
            - {{name: t, timer: 10ms, publishes: [/points]}}
            - name: s
              subscription: /point {MARK}
              deadline: 10ms
    """, "callback '/n:s': nobody publishes '/point': did you mean '/points'?")
    nodes_error(f"""
        - node: /n
          callbacks:
            - name: s
              subscription: /point {MARK}
              deadline: 10ms
    """, "nobody publishes '/point': add it to a 'publishes:', or add 'period:'")
    nodes_error(f"""
        - node: /n
          callbacks:
            - {{name: t, timer: 10ms, publishes: [/points]}}
            - name: s
              sync:
                - /points
                - /xyz {MARK}
              deadline: 10ms
    """, "nobody publishes '/xyz': add it to a 'publishes:'")


def test_what_only_a_source_may_have() -> None:
    for key, value in (
        ('dag', 'd'), ('on_late', 'continue'), ('max_active_jobs', '3'),
        ('release_from', 'header_stamp'),
    ):
        nodes_error(f"""
            - node: /n
              callbacks:
                - {{name: t, timer: 10ms, publishes: [/a]}}
                - name: s
                  subscription: /a
                  {key}: {value} {MARK}
                  deadline: 10ms
        """, f"callback '/n:s': '{key}:' is for the source of a DAG", 'move it to the source')
    nodes_error(f"""
        - node: /n
          callbacks:
            - {{name: t, timer: 10ms, publishes: [/a]}}
            - {{name: m, subscription: /a, publishes: [/b],
               keep: newest}} {MARK}
            - {{name: s, subscription: /b, deadline: 10ms}}
    """, "'keep:' is for a source or a sink")
    for key, value in ('importance', 'high'), ('tolerate', '1 of 10'):
        nodes_error(f"""
            - node: /n
              callbacks:
                - name: t
                  timer: 10ms
                  publishes: [/a]
                  {key}: {value} {MARK}
                - {{name: s, subscription: /a, deadline: 10ms}}
        """, f"'{key}:' is for a sink", 'move it to the sinks after it')
    nodes_error(f"""
        - node: /n
          callbacks:
            - {{name: t, timer: 10ms, publishes: [/a]}}
            - name: s
              subscription: /a
              period: 10ms {MARK}
              deadline: 10ms
    """, "only a source has a period, but '/n:t' publishes '/a': remove 'period:'")
    nodes_error(f"""
        - node: /n
          callbacks:
            - name: s
              sync: [/a, /b]
              period: 10ms {MARK}
              deadline: 10ms
    """, 'a sync callback joins topics, so it cannot be a source')
    nodes_error(f"""
        - node: /n
          callbacks:
            - name: s
              timer: 10ms
              release_from: source_timestamp {MARK}
              deadline: 10ms
    """, 'a timer is released when it is due')


def test_service_without_a_period() -> None:
    nodes_error(f"""
        - node: /n
          callbacks:
            - name: s
              service: /ask {MARK}
              deadline: 10ms
    """, "has no period: add 'period:'")


def test_cycle() -> None:
    says = (
        'callbacks start each other in a cycle: /n:x -> /n:y -> /n:z -> /n:x: cut it with a '
        "queue edge: in '/n:x' list '/c' under 'reads:' and start it by a timer or another "
        "topic than '/c'")
    nodes_error(f"""
        - node: /n
          callbacks:
            - name: x
              subscription: /c {MARK}
              publishes: [/a]
            - {{name: y, subscription: /a, publishes: [/b]}}
            - {{name: z, subscription: /b, publishes: [/c]}}
            - {{name: after, subscription: /c, deadline: 10ms}}
    """, says)


def test_cycle_through_a_sync_is_cut_there() -> None:
    says = (
        "/n:detect -> /n:track -> /n:detect: cut it with a queue edge: in '/n:detect' list "
        "'/tracks' under 'reads:' and take '/tracks' out of its 'sync:'")
    nodes_error(f"""
        - node: /n
          callbacks:
            - {{name: t, timer: 10ms, publishes: [/in]}}
            - {{name: track, subscription: /objects, publishes: [/tracks]}}
            - name: detect
              sync:
                - /in
                - /tracks {MARK}
              publishes: [/objects]
    """, says)


def test_cycle_of_one() -> None:
    nodes_error(f"""
        - node: /n
          callbacks:
            - {{name: t, timer: 10ms, publishes: [/a]}}
            - name: x
              subscription: /a {MARK}
              publishes: [/a]
    """, 'in a cycle: /n:x -> /n:x')


def test_cycle_is_found_behind_what_waits_for_it() -> None:
    nodes_error(f"""
        - node: /n
          callbacks:
            - {{name: late, subscription: /c, publishes: [/later]}}
            - {{name: later, subscription: /later, deadline: 1ms}}
            - name: x
              subscription: /y {MARK}
              publishes: [/x]
            - {{name: y, subscription: /x, publishes: [/y, /c]}}
    """, '/n:x -> /n:y -> /n:x')


def test_all_cycles_are_told() -> None:
    with pytest.raises(GraphErrors) as caught:
        graph("""
            - node: /n
              callbacks:
                - {name: a, subscription: /y, publishes: [/x]}
                - {name: b, subscription: /x, publishes: [/y]}
                - {name: c, subscription: /x, publishes: [/w]}
                - {name: d, subscription: /w, publishes: [/v, /x]}
                - {name: e, subscription: /self, publishes: [/self, /v]}
                - {name: f, subscription: /v, deadline: 1ms}
        """)
    assert [error.problem.partition(': ')[2] for error in caught.value.errors] == [
        '/n:a -> /n:b -> /n:a', '/n:c -> /n:d -> /n:c', '/n:e -> /n:e']


def test_long_cycle_is_not_spelt_out() -> None:
    text = '- node: /n\n  callbacks:\n'
    for i in range(500):
        mark = MARK if i == 0 else ''
        text += f'  - name: c{i}\n    subscription: /t{i} {mark}\n'
        text += f'    publishes: [/t{(i + 1) % 500}]\n'
    found = nodes_error(text, '/n:c0 -> /n:c1', '… (492 more) -> /n:c0')
    assert len(str(found)) < 400


def test_a_queue_edge_cuts_a_cycle() -> None:
    tasks = graph("""
        - node: /n
          callbacks:
            - {name: t, timer: 10ms, publishes: [/in]}
            - {name: track, subscription: /objects, publishes: [/tracks], deadline: 1ms}
            - {name: detect, subscription: /in, reads: [/tracks], publishes: [/objects]}
    """)
    assert tasks.dags[0].edges == ((0, 2), (2, 1))


def test_two_sources_joined_by_a_sync() -> None:
    says = (
        "callback '/n:s': it joins two sources, '/n:t' and '/n:u', but a DAG has one: read '/c' "
        "by a queue edge: take it out of 'sync:' and list it under 'reads:'")
    nodes_error(f"""
        - node: /n
          callbacks:
            - {{name: t, timer: 10ms, publishes: [/a]}}
            - {{name: u, timer: 20ms, publishes: [/b], dag: u}}
            - {{name: v, subscription: /b, publishes: [/c]}}
            - name: s
              sync:
                - /a
                - /c {MARK}
              deadline: 10ms
    """, says)


def test_two_sources_joined_by_one_topic_of_a_sync() -> None:
    nodes_error(f"""
        - node: /n
          callbacks:
            - {{name: t, timer: 10ms, publishes: [/a, /b]}}
            - {{name: u, timer: 20ms, publishes: [/a], dag: u}}
            - name: s
              sync: [/a, /b] {MARK}
              deadline: 10ms
    """, "joins two sources, '/n:t' and '/n:u'")


def test_missing_deadline() -> None:
    says = (
        "callback '/n:s': it is a sink (it starts no other callback) and has no deadline: add "
        "'deadline:'")
    nodes_error(f"""
        - node: /n
          callbacks:
            - {{name: t, timer: 10ms, publishes: [/a]}}
            - name: s {MARK}
              subscription: /a
              publishes: [/unheard]
    """, says)


def test_deadline_on_what_is_no_sink() -> None:
    nodes_error(f"""
        - node: /n
          callbacks:
            - name: t
              timer: 10ms
              publishes: [/a]
              deadline: 10ms {MARK}
            - {{name: s, subscription: /a, deadline: 10ms}}
    """, "callback '/n:t': it has a deadline but is no sink: it starts '/n:s' by '/a': move")


def test_reads_of_what_is_unknown() -> None:
    says = (
        "callback '/n:callback_1': it reads '/twits', which nobody publishes: did you mean "
        "'/twist'?")
    nodes_error(f"""
        - node: /n
          callbacks:
            - {{name: t, timer: 10ms, publishes: [/twist], deadline: 1ms}}
            - name: callback_1
              timer: 10ms
              dag: d
              deadline: 1ms
              reads:
                - /twist
                - /twits {MARK}
    """, says)
    nodes_error(f"""
        - node: /n
          callbacks:
            - name: callback_1
              timer: 10ms
              deadline: 1ms
              reads: [callback_2] {MARK}
    """, "it reads the unknown callback 'callback_2': did you mean 'callback_1'?")
    nodes_error(f"""
        - node: /m
          callbacks: [{{name: other, timer: 1ms, deadline: 1ms}}]
        - node: /n
          callbacks:
            - name: callback_1
              timer: 10ms
              deadline: 1ms
              reads: [other] {MARK}
    """, "name a callback of its node: 'callback_1'")


def test_names_of_dags_are_unique() -> None:
    says = (
        "callback '/m:u': its DAG has the name '/n', as that of '/n:t': give it another one "
        "with 'dag:'")
    nodes_error(f"""
        - node: /n
          callbacks:
            - {{name: t, timer: 10ms, deadline: 1ms}}
        - node: /m
          callbacks:
            - {{name: u, timer: 10ms, deadline: 1ms, dag: /n}} {MARK}
    """, says)
    nodes_error(f"""
        - node: /n
          callbacks:
            - {{name: t, timer: 10ms, deadline: 1ms, dag: d}}
            - name: u
              timer: 10ms
              deadline: 1ms
              dag: d {MARK}
    """, "its DAG has the name 'd'")


def doubling(levels: int) -> str:
    """Return a graph in which each level has twice the vertices of the one before."""
    text = 'mddag: 1\nnodes:\n- node: /n\n  callbacks:\n'
    text += '  - {name: t, timer: 10ms, publishes: [/t0]}\n'
    for i in range(levels):
        for side in 'ab':
            text += (
                f'  - {{name: {side}{i}, subscription: /t{i}, publishes: [/t{i + 1}]}}\n')
    return text + f'  - {{name: end, subscription: /t{levels}, deadline: 1s}}\n'


def test_or_must_not_explode() -> None:
    assert len(loads(doubling(5)).vertices) == 1 + 2 + 4 + 8 + 16 + 32 + 32
    for levels in (16, 60, 2_000):
        with pytest.raises(GraphError) as caught:
            loads(doubling(levels))
        assert 'vertices, more than 100000' in caught.value.problem
        assert "'reads:'" in caught.value.remedy
        assert caught.value.line is not None


def test_edges_must_not_explode() -> None:
    text = 'mddag: 1\nnodes:\n- node: /n\n  callbacks:\n'
    text += '  - {name: t, timer: 10ms, publishes: [/t, /v]}\n'
    for i in range(1_100):
        text += f'  - {{name: p{i}, subscription: /t, publishes: [/u]}}\n'
    for i in range(1_100):
        text += f'  - {{name: s{i}, sync: [/u, /v], deadline: 1s}}\n'
    with pytest.raises(GraphError, match='edges, more than 1000000'):
        loads(text)
