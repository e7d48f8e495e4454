# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
From the recorded declaration to the one that judges.

Theory of operation
-------------------
Events name DAGs and vertices by their index in the declaration that was recorded.  The one that
judges may be another: other deadlines, another order, more or fewer callbacks.

* A recorded DAG stands for the one whose source is the same callback (``/node:callback``).
* Within it a vertex stands for the one of the same name, or, because names have ``@dag`` only
  where several DAGs hold a callback, for the only one of the same callback.
* The legs of a sync vertex are matched by their topics; with other topics it is another vertex.

What stands for nothing ran as a callback that no DAG declares.  What nothing stands for has never
run: its jobs were not released, its sinks not completed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence, Set

from mddag_executor.core import legs_of
from mddag_executor.replay.recording import ReplayError
from mddag_executor.text import counted, listed
from msg_graph import Dag, TaskSet, Vertex
from msg_graph.binding import entities_of, Entity, meant


class Mapping:
    """
    Where the recorded DAGs and vertices are in the declaration that judges.

    :param recorded: the declaration that it was recorded with.
    :param judge: the declaration that judges; None: the recorded one.
    """

    def __init__(self, name: str, recorded: TaskSet, judge: TaskSet | None) -> None:
        self.task_set = recorded if judge is None else judge
        #: Whether the declaration that judges is the one that the run itself was judged by.
        self.same = judge is None or judge.text == recorded.text
        self.warnings: list[str] = []
        first = _first_vertices(self.task_set)
        if judge is not None and not self.same:
            self._compare(name, recorded, judge)
        by_source = {dag.vertices[dag.source].callback.key: dag for dag in self.task_set.dags}
        #: By recorded DAG: the DAG that it stands for, or -1.
        self.dag: list[int] = []
        #: By recorded DAG and vertex: the global vertex that it stands for, or -1.
        self.vertex: list[list[int]] = []
        #: By recorded DAG, vertex and leg: the leg that it stands for.
        self.leg: list[list[list[int]]] = []
        for dag in recorded.dags:
            target = by_source.get(dag.vertices[dag.source].callback.key)
            self.dag.append(-1 if target is None else target.index)
            self._add_vertices(dag, target, first)
        self._report_unreleased()

    def _add_vertices(self, dag: Dag, target: Dag | None, first: list[int]) -> None:
        vertices: list[int] = []
        legs: list[list[int]] = []
        for vertex in dag.vertices:
            match = None if target is None else _match(vertex, dag, target)
            map_of_legs = []
            if target is not None and match is not None:
                map_of_legs = _legs(vertex, dag, match, target)
            if target is None or match is None or not map_of_legs:
                vertices.append(-1)
            else:
                vertices.append(first[target.index] + match.index)
            legs.append(map_of_legs)
        self.vertex.append(vertices)
        self.leg.append(legs)

    def _compare(self, name: str, recorded: TaskSet, judge: TaskSet) -> None:
        """Find out which callbacks of the graph the trace does not have."""
        known = [callback.key for callback in recorded.callbacks]
        wanted = {callback.key for callback in judge.callbacks}
        self.warnings += report_missing(name, judge, set(known), known, [
            each for callback in recorded.callbacks if callback.key not in wanted
            for each in entities_of(callback)])

    def _report_unreleased(self) -> None:
        if self.same:
            return
        missing = [dag.name for dag in self.task_set.dags if dag.index not in self.dag]
        if missing:
            self.warnings.append(
                f'{self.task_set.file}: {counted(len(missing), "DAG")} without jobs, because the '
                f'source is no source in the recording: {listed(missing)}')


def _first_vertices(task_set: TaskSet) -> list[int]:
    first = [0]
    for dag in task_set.dags:
        first.append(first[-1] + len(dag.vertices))
    return first


def _match(vertex: Vertex, dag: Dag, target: Dag) -> Vertex | None:
    """Return the vertex of a DAG that a vertex of a recorded one stands for."""
    for other in target.vertices:
        if other.name == vertex.name:
            return other
    key = vertex.callback.key
    same = [other for other in target.vertices if other.callback.key == key]
    alone = Counter(other.callback.key for other in dag.vertices)[key] == 1
    return same[0] if alone and len(same) == 1 else None


def _legs(vertex: Vertex, dag: Dag, other: Vertex, target: Dag) -> list[int]:
    """Return for each leg of a vertex the leg of the other with its topic; none: no match."""
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
) -> list[str]:
    """
    Return the line about callbacks of a declaration that are not in a recording, if any.

    :param found: the keys of those that are.
    :param known: what is called how in the recording; ``others``: what stands for nothing.
    :raises ReplayError: when it has none of them.
    """
    absent = [callback for callback in judge.callbacks if callback.key not in found]
    if not absent:
        return []
    questions = ((c.key, meant(c, others)) for c in absent)
    question = next((f'{key}: {each}' for key, each in questions if each is not None), None)
    if len(absent) == len(judge.callbacks):
        has = f'it has {listed(known)}' if known else 'it does not say what its callbacks are'
        raise ReplayError(
            name, f'none of the callbacks of {judge.file} is in it: {has}',
            question or 'give the graph of the nodes that were recorded, or none')
    return [f'{name}: not in it: {len(absent)} of the {len(judge.callbacks)} callbacks of '
            f'{judge.file}, which count as never completed: {listed([c.key for c in absent])}'
            + ('' if question is None else f': {question}')]
