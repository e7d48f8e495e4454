# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Finds differences between a recorded run and a declaration; input of ``msg_graph.drift``.

Theory of operation
-------------------
A callback's declared key is that of the vertices that it ran as.  If it never ran as a vertex (its
messages did not fit), the declaration is searched for its node and trigger
(``msg_graph.binding``).  Runs judged by another declaration are matched by that key.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Set

from mddag_executor.recording.joins import different, distinct, rows_by, whole_periods
from mddag_executor.recording.mapping import declared_keys
from mddag_executor.recording.names import Names
from mddag_executor.recording.recording import Recording
from mddag_executor.recording.tables import VERTEX
from msg_graph.drift import Drift, drift, Observed, Releases
import numpy as np


def drift_of(recording: Recording, skip: int = 0) -> list[Drift]:
    """
    Return the differences between a recording and the declaration that judges it.

    :param skip: warm-up time after the first release that does not count for rates, ns.
    """
    judge, names, table = recording.task_set, recording.names, recording.executions
    vertices = judge.vertices
    keys = declared_keys(names, recording.run.recorded_set)
    periods = {key: each.period for each in names.made if each.kind == 'timer'
               and each.period > 0 and (key := keys.get(each.number)) is not None}
    releases: dict[str, Releases] = {}
    released, since = recording.releases, (recording.start or 0) + skip
    for dag, chosen in zip(judge.dags, rows_by(released['dag'], len(judge.dags))):
        mine = released['release'][chosen]
        mine = mine[mine >= since]
        key = dag.vertices[dag.source].callback.key
        if len(mine):
            of = releases[key] = Releases()
            of.add(int(mine.min()))
            of.add(int(mine.max()))
            of.count = len(mine)
            if not (recording.run.declared or dag.sporadic) and key in periods:
                # skipped releases have no jobs
                periods_between, is_whole = whole_periods(mine, periods[key])
                of.count += int((periods_between[is_whole] - 1).clip(0).sum())
    # declared callbacks that were started, and other executions, a coroutine's once each
    vertex, start, end = (table[name] for name in ('vertex', 'start', 'end'))
    declared = (vertex >= 0) & (start >= 0)
    every = (declared | (vertex < 0) & (end >= 0)) & (table['piece'] == 0)
    waits = (end < 0) & (start >= recording.end)
    late = (end >= since) | (end < 0)
    numbers, callback_of = recording.callbacks()
    keys.update(_ran_as(recording))
    counts, late_counts, late_got = (dict(zip(numbers.tolist(), np.bincount(
        callback_of[which], minlength=len(numbers)).tolist()))
        for which in (every & ~waits, every & ~waits & late, every & late))
    ran: Counter[str] = Counter()
    got = Counter(vertices[v].callback.key for v in recording.drops['vertex'][
        recording.drops['time'] >= since].tolist() if v >= 0)
    for number, key in keys.items():
        # once, if only in the warm-up
        ran[key] += late_counts.get(number, 0) or min(1, counts.get(number, 0))
        got[key] += late_got.get(number, 0)
    whole = (recording.whole or recording).releases['dag']
    for dag in judge.dags:      # what fires once may have fired before the part that is judged
        source = dag.vertices[dag.source].callback
        if source.once and (whole == dag.index).any():
            ran[source.key] = max(1, ran[source.key])
    came: defaultdict[str, Set[str]] = defaultdict(set)
    for each in names.made:
        if counts.get(each.number) and each.number in keys:
            came[keys[each.number]] |= {each.start}
    completed = table['vertex'][declared & (table['completes'] == VERTEX)]
    for vertex in distinct(completed).tolist():
        came.pop(vertices[vertex].callback.key, None)   # it got all of them
    publishes: defaultdict[str, Set[str]] = defaultdict(set)
    published: Counter[tuple[str, str]] = Counter()
    outside: Counter[tuple[str, str, str]] = Counter()
    sent = recording.publications
    publishers, publisher_of = different(sent['publisher'])
    # the last callback is for publications in no execution
    pair_of = publisher_of.astype(np.int64) * (len(numbers) + 1) + np.append(
        callback_of, len(numbers))[sent['execution']]
    is_judged = (sent['time'] >= max(since, recording.run.judge_from)) & (
        sent['time'] <= recording.run.judged_until)
    judged_counts, late_sent = (
        np.bincount(pair_of[which], minlength=int(pair_of.max(initial=0)) + 1)
        for which in (is_judged, sent['time'] >= since))
    for pair in np.flatnonzero(np.bincount(pair_of)).tolist():
        number, place = int(publishers[pair // (len(numbers) + 1)]), pair % (len(numbers) + 1)
        callback = int(numbers[place]) if place < len(numbers) else None
        publisher = names.publishers.get(number)
        if publisher is None or publisher.node is None:
            continue
        if callback in keys:
            publishes[keys[callback]] |= {publisher.topic}
            published[keys[callback], publisher.topic] += int(late_sent[pair])
        elif callback is not None or not recording.run.links:    # the events may be lost
            outside[publisher.node.name, publisher.topic, (
                '' if callback is None else names.name(callback))] += int(judged_counts[pair])
    bound = declared_keys(names, judge)
    gone = {key: max(0, recording.end - at) for key, at in gone_at(names, keys).items()}
    return drift(judge, Observed(
        max(0, recording.end - recording.run.begin), releases,
        dict(got), dict(ran), came, publishes, set(names.nodes) or None,
        [each.entity for each in names.made
         if each.entity is not None and each.number not in bound], periods, recording.end,
        _blocked(recording, keys),
        [(*key, count) for key, count in outside.items() if count], published, gone))


def keys_of(recording: Recording) -> dict[int, str]:
    """Return by callback the declared one: that of the vertex that it ran as, or that fits."""
    return {**declared_keys(recording.names, recording.run.recorded_set), **_ran_as(recording)}


def _ran_as(recording: Recording) -> dict[int, str]:
    """Return by callback the declared one of the vertex that it ran as."""
    table, vertices = recording.executions, recording.task_set.vertices
    ran_as = recording.vertices_of_callbacks((table['vertex'] >= 0) & (table['start'] >= 0))
    return {
        callback: vertices[vertex].callback.key
        for callback, vertex in zip(recording.callbacks()[0].tolist(), ran_as.tolist())
        if vertex >= 0}


def gone_at(names: Names, keys: Mapping[int, str]) -> dict[str, int]:
    """
    Return by declared callback when an entity disappeared that it lacks until the end.

    :param keys: the declared callback of each callback.
    """
    times: defaultdict[tuple[str, str], list[int | None]] = defaultdict(list)
    for callback in names.callbacks:
        if callback.number in keys:
            times[keys[callback.number], callback.start].append(callback.gone)
    gone: dict[str, int] = {}
    for (key, _), of_topic in times.items():
        known = [at for at in of_topic if at is not None]
        if len(known) == len(of_topic):
            gone[key] = min(gone.get(key, max(known)), max(known))
    return gone


def _blocked(recording: Recording, keys: Mapping[int, str]) -> set[str]:
    """Return the declared callbacks that cannot run, as an execution has not ended."""
    groups, hang = recording.names.groups, set(recording.unfinished['callback'].tolist())
    busy = {groups.get(each, -1) for each in hang} - {-1}
    return {key for callback, key in keys.items()
            if callback in hang or groups.get(callback, -1) in busy}
