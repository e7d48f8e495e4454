# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Maps the callbacks of a recording to the declaration that judges it.

Theory of operation: recorded with a declaration
------------------------------------------------
Events name DAGs and vertices by their index in the recorded declaration.  The judging declaration
may differ: other deadlines, another order, more or fewer callbacks.

* A recorded DAG matches the DAG with the same source callback (``/node:callback``).
* Within it a vertex matches the vertex of the same name.  Names have ``@dag`` only if several DAGs
  contain the callback; so otherwise it matches the only vertex of the same callback.
* The legs of a sync vertex are matched by their topics; different topics mean different vertices.

A recorded vertex without match counts as undeclared.  A declared vertex without match has never
run: its jobs were not released, its sinks not completed.

Theory of operation: imported
-----------------------------
Callbacks are matched by node and trigger; ``msg_graph.binding`` has the rules.  A node that was
started several times, or in several processes, is matched each time.  Of several callbacks with
the same trigger the first declared one matches the first created one.

A CARET or ros2_tracing recording has no other information.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence, Set
from dataclasses import replace
from itertools import accumulate
from typing import NamedTuple

from mddag_executor.core import legs_of
from mddag_executor.recording.columns import Table
from mddag_executor.recording.head import ReplayError
from mddag_executor.recording.losses import Loss
from mddag_executor.recording.names import Callback, Names, Node
from mddag_executor.recording.recording import Recording
from mddag_executor.text import counted, listed
from msg_graph import Callback as Declared
from msg_graph import Dag, EMPTY_TASK_SET, TaskSet, Vertex
from msg_graph.binding import Binder, entities_of, Entity, function_of, suggest_entity
import numpy as np


def judged_by(recording: Recording, judge: TaskSet | None) -> Recording:
    """
    Return a recording in terms of the judging declaration.

    :param judge: None: the recorded one.
    :raises ReplayError: if the recording has none of its callbacks.
    """
    run, columns = recording.run, recording.columns
    recorded = run.recorded_set
    if judge is None or judge.text == recorded.text:    # it judged the run itself
        return replace(recording, run=replace(run, task_set=judge or recorded))
    known, wanted = ([each.key for each in of.callbacks] for of in (recorded, judge))
    missing = report_missing(recording.name, judge, set(known), known, [
        each for callback in recorded.callbacks if callback.key not in wanted
        for each in entities_of(callback)])
    dags, vertices, legs = _matches(recorded, judge)
    unreleased = [each.name for each in judge.dags if each.index not in dags]
    if unreleased:
        missing.append(Loss(
            'callbacks', len(unreleased),
            f'{judge.file}: {counted(len(unreleased), "DAG")} without jobs, because the '
            f'source is not a source in the recording: {listed(unreleased)}'))
    dag, vertex = np.array([*dags, -1]), np.array([*vertices, -1])
    n_legs = max(map(len, legs), default=1)
    leg = np.array([[*each, *[-1] * (n_legs - len(each))] for each in [*legs, []]])

    def moved(table: Table) -> Table:
        table = table.copy()
        of = table['vertex'].copy()
        if 'leg' in table.names:
            known = (table['leg'] >= 0) & (table['leg'] < n_legs)
            table['leg'][known] = leg[of[known], table['leg'][known]]
        table['vertex'] = vertex[of]
        if 'dag' in table.names:
            table['dag'] = np.where(vertex[of] >= 0, dag[table['dag']], -1)
        if 'completes' in table.names:
            table['completes'][vertex[of] < 0] = 0
        return table

    def of_dags(table: Table) -> Table:
        table = table.copy()
        table['dag'] = dag[table['dag']]
        if 'vertex' in table.names:
            failed = table['vertex'] >= 0
            table['vertex'] = np.where(failed, vertex[table['vertex']], -1)
            table = table[~failed | (table['vertex'] >= 0)]
        return table[table['dag'] >= 0]

    hosted = [(order, dags[of], frozenset(int(vertex[v]) for v in here) - {-1})
              for order, of, here in run.hosted if dags[of] >= 0]
    return replace(
        recording, run=replace(run, task_set=judge, same=False, hosted=hosted),
        missing=recording.missing.more(*missing), columns=replace(
            columns, executions=moved(columns.executions),
            publications=moved(columns.publications), drops=moved(columns.drops),
            demotions=moved(columns.demotions), misses=moved(columns.misses),
            releases=of_dags(columns.releases), job_ends=of_dags(columns.job_ends)))


def _matches(
    recorded: TaskSet, judge: TaskSet
) -> tuple[list[int], list[int], list[list[int]]]:
    """Return by recorded DAG its DAG, by vertex its vertex (-1: none), and the legs of that."""
    first = [*accumulate((len(dag.vertices) for dag in judge.dags), initial=0)]
    by_source = {dag.vertices[dag.source].callback.key: dag for dag in judge.dags}
    dags, vertices, legs = list[int](), list[int](), list[list[int]]()
    for dag in recorded.dags:
        target = by_source.get(dag.vertices[dag.source].callback.key)
        dags.append(-1 if target is None else target.index)
        for vertex in dag.vertices:
            match = None if target is None else _match(vertex, dag, target)
            found = [] if target is None or match is None else _legs(vertex, dag, match, target)
            legs.append(found)
            vertices.append(first[target.index] + match.index if found and target and match
                            else -1)
    return dags, vertices, legs


def _match(vertex: Vertex, dag: Dag, target: Dag) -> Vertex | None:
    """Return the vertex of a DAG that matches a recorded vertex."""
    for other in target.vertices:
        if other.name == vertex.name:
            return other
    key = vertex.callback.key
    same = [other for other in target.vertices if other.callback.key == key]
    alone = Counter(other.callback.key for other in dag.vertices)[key] == 1
    return same[0] if alone and len(same) == 1 else None


def _legs(vertex: Vertex, dag: Dag, other: Vertex, target: Dag) -> list[int]:
    """Return for each leg of a vertex the other vertex's leg with its topic; empty: no match."""
    topics, theirs = (
        [each.callback.topics[place] for place, _ in legs_of(each, of.vertices)]
        for each, of in ((vertex, dag), (other, target)))
    if max(len(topics), len(theirs)) <= 1:
        return [0]
    if sorted(topics) != sorted(theirs):
        return []
    places: dict[str, list[int]] = {}
    for place, topic in enumerate(theirs):
        places.setdefault(topic, []).append(place)
    return [places[topic].pop(0) for topic in topics]


def report_missing(
    name: str, judge: TaskSet, found: Set[str], known: Sequence[str], others: Sequence[Entity]
) -> list[Loss]:
    """
    Return the warning about declared callbacks that are not recorded, if any.

    :param found: keys of the recorded ones.
    :param known: names in the recording; ``others``: entities without match.
    :raises ReplayError: if none is recorded.
    """
    absent = [callback for callback in judge.callbacks if callback.key not in found]
    if not absent:
        return []
    questions = {c.key: suggest_entity(c, others) for c in absent}
    if len(absent) == len(judge.callbacks):
        has = f'it has {listed(known)}' if known else 'it does not say what its callbacks are'
        raise ReplayError(
            name, f'none of the callbacks of {judge.file} is in it: {has}',
            next((f'{key}: {each}' for key, each in questions.items() if each is not None),
                 'give the graph of the nodes that were recorded, or none'))
    return [Loss('callbacks', len(absent), (
        f'{name}: not in it: {len(absent)} of the {len(judge.callbacks)} callbacks of '
        f'{judge.file}, so results that need them are missed, not judged or never due: '
        + listed([key if each is None else f'{key} ({each})'
                  for key, each in questions.items()])))]


class Target(NamedTuple):
    """The declared callback that a recorded one matches, and its leg."""

    callback: Declared
    leg: int
    topic: str


def nodes_of(names: Names) -> list[list[Callback]]:
    """Return the timers, subscriptions and services of each node, in the order of creation."""
    found: dict[Node, list[Callback]] = {}
    for each in sorted(names.made, key=lambda c: (c.made, c.number)):
        if each.node is not None:
            found.setdefault(each.node, []).append(each)
    return list(found.values())


def matches(names: Names, declared: TaskSet) -> dict[int, Target]:
    """Return by the number of a recorded callback the declared one that it matches."""
    found: dict[int, Target] = {}
    # one for each time that a node of the same name runs, for example in several processes
    binders: list[Binder] = []
    times = Counter[str]()
    for callbacks in nodes_of(names):
        node = callbacks[0].node_name
        if times[node] == len(binders):
            binders.append(Binder(declared))
        binder = binders[times[node]]
        times[node] += 1
        goes: list[tuple[int, Target]] = []
        for each in callbacks:
            # as in the executor, a new one may be the next of a callback that lost its entity
            for time, target in goes:
                if time <= each.made:
                    binder.release(target.callback, target.topic or None)
            goes = [(time, target) for time, target in goes if time > each.made]
            bound = binder.bind(each.entity, function_of(each.symbol)) if (
                each.entity and each.number) else None
            if bound is not None:
                leg = bound.topics.index(each.start) if each.start in bound.topics else 0
                target = Target(bound, leg, each.start if bound.topics else '')
                found[each.number] = target
                if each.gone is not None:
                    goes.append((each.gone, target))
    return found


def declared_keys(names: Names, declared: TaskSet) -> dict[int, str]:
    """Return by callback number the key of the declared callback."""
    return {number: target.callback.key for number, target in matches(names, declared).items()}


class Matching:
    """
    Maps the callbacks of an imported recording to declared ones.

    :param names: the nodes and callbacks of the recording.
    :param judge: the judging declaration; None: none.
    """

    def __init__(
        self, name: str, names: Names, judge: TaskSet | None
    ) -> None:
        self.task_set = judge or EMPTY_TASK_SET
        self.losses: list[Loss] = []
        #: By number of a recorded callback.
        self.target: dict[int, Target] = {}
        if judge is None:
            return
        self.target = matches(names, judge)
        found = {target.callback.key for target in self.target.values()}
        self.losses += report_missing(
            name, judge, found, list(dict.fromkeys(
                c.label for c in names.callbacks if c.kind != 'service')),
            [c.entity for c in names.callbacks
             if c.entity is not None and c.number not in self.target])
