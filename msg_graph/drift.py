# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Drift: differences between a system that ran and its declaration.

Theory of operation
-------------------
The rules are the same for live runs and recordings. Observations are counts by callback.

1. *publishes*: a callback published a topic that it does not declare. Topics of the client library
   and ``/diagnostics`` do not count.
2. *rate* of a source: its timer was created with another period, or the mean time between two
   releases differs from the declared period by more than ``TOLERANCE`` of it. At least ``LEAST``
   releases are needed. A sporadic source may be released less often.
   *stopped*: a source that is not sporadic and fires more than once was not released any more in
   the last ``LEAST`` of its periods, and not in the last ``SILENCE_NS``. Its results were all in
   time up to then, so no verdict shows this. A callback whose timer, subscription or service was
   destroyed has stopped as well, and so has a sync that lacks one of its subscriptions.
3. *rate* of a subscription: it received messages more or less often than the callbacks that
   publish them ran here, by more than ``TOLERANCE``. At least ``LEAST`` expected messages are
   needed. Dropped messages count as received: their loss says nothing about the declaration. So
   do messages that were published and did not arrive, if the publications are known. Syncs
   are not checked, because a declaration does not say how messages are joined. A topic that a
   callback may publish (``may_publish``) has only an upper bound, and its subscribers may never
   run.
4. *never ran*: a callback never ran and got nothing, or a sync never got one of its topics, but
   should have run at least twice. Callbacks after a sporadic source need not run. The report
   suggests an undeclared entity that may be meant (``binding.suggest_entity``).
5. A callback may run in another process if all its DAGs may span processes (``release_from:
   header_stamp``) or the declaration has ``processes:``, and its node was not seen here. Then it
   is not reported.
6. *published outside*: a node published a topic with which its declared callback starts another
   one, but neither in the callback nor in code that the callback waits for: in a thread, a task or
   an undeclared callback.  Such a message belongs to no job.  Declared callbacks that publish a
   topic without declaring it are rule 1.
7. Of consecutive callbacks only the first that differs by rule 2, 3 or 4 is reported: it is the
   reason why the others have no messages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from msg_graph.binding import Entity, is_period, is_side_output, suggest_entity
from msg_graph.duration import format_duration
from msg_graph.errors import printable
from msg_graph.model import (
    Callback,
    Dag,
    legs_of,
    optional_edges,
    TaskSet,
    topological_order,
    Vertex,
)

TOLERANCE = 0.2
LEAST = 10
SILENCE_NS = 1_000_000_000
_SPORADIC = 'has no fixed rate', 'is made, reset or cancelled when needed'
"""What ``sporadic`` says of a subscription or service, and of a timer."""


@dataclass
class Releases:
    """The releases of a DAG: the number, and the first and the last one, ns."""

    count: int = 0
    first: int = 0
    last: int = 0

    def add(self, release: int) -> None:
        """Note a release."""
        self.first = min(self.first, release) if self.count else release
        self.last = max(self.last, release)
        self.count += 1

    def mean_ns(self) -> int:
        """Return the mean time between releases; at least two are needed."""
        return (self.last - self.first) // (self.count - 1)


@dataclass
class Observed:
    """
    The observations of a system.

    :ivar duration_ns: how long it was watched.
    :ivar end_ns: until when, on the clock of the releases; 0: unknown.
    :ivar releases: the releases of each DAG, by the key of its source callback.
    :ivar messages: by callback, the number of its messages or of its timer's releases.
    :ivar executions: by callback, the number of its executions.
    :ivar topics_received: by sync, the topics that it got messages of; a sync that is missing is
        not checked.
    :ivar publishes: by callback, the topics that it published, declared or not.
    :ivar published: by callback and topic, the number of messages; without unknown ones.
    :ivar gone: by callback that lacks its timer, subscription or service at the end: for how long,
        ns.
    :ivar nodes: the nodes that were seen; None if unknown.
    :ivar undeclared: the undeclared entities that were seen.
    :ivar outside: messages that no declared callback has published: node, topic, the undeclared
        callback or task (empty: the thread ran none), and their number.
    :ivar blocked: callbacks that cannot run, as an execution has not ended: they have not stopped.
    :ivar periods: by timer, the period with which it was created, ns; without unknown ones.
    """

    duration_ns: int = 0
    releases: dict[str, Releases] = field(default_factory=dict)
    messages: dict[str, int] = field(default_factory=dict)
    executions: dict[str, int] = field(default_factory=dict)
    topics_received: Mapping[str, Set[str]] = field(default_factory=dict)
    publishes: dict[str, Set[str]] = field(default_factory=dict)
    nodes: Set[str] | None = None
    undeclared: Sequence[Entity] = ()
    periods: Mapping[str, int] = field(default_factory=dict)
    end_ns: int = 0
    blocked: Set[str] = frozenset()
    outside: Sequence[tuple[str, str, str, int]] = ()
    published: Mapping[tuple[str, str], int] = field(default_factory=dict)
    gone: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Drift:
    """
    One difference.

    :ivar kind: ``publishes``, ``published outside``, ``rate``, ``stopped`` or ``never ran``.
    :ivar topic: the topic that is published, or the one that a sync never got, or None.
    :ivar declared: the declared value: a period in ns, or a number of messages; or None.
    :ivar observed: the observed value, or None.
    """

    kind: str
    callback: str
    topic: str | None
    declared: int | None
    observed: int | None
    text: str

    def result(self) -> dict[str, Any]:
        """Return its form in JSON results."""
        return asdict(self)


def drift(task_set: TaskSet, observed: Observed) -> list[Drift]:
    """Return the differences between a system and its declaration, in the declaration's order."""
    found: dict[str, list[Drift]] = {}
    for callback in task_set.callbacks:
        extra = [topic for topic in sorted(observed.publishes.get(callback.key, ()))
                 if topic not in callback.publishes and not is_side_output(topic, callback.node)]
        found[callback.key] = [
            Drift('publishes', callback.key, topic, None, None,
                  printable(f'{callback.key} publishes {topic}, which it does not declare'))
            for topic in extra]
    _add_outside(task_set, observed, found)
    suspects = _suspects(task_set, observed)
    for key in _first(task_set, suspects):
        found[key].append(suspects[key])
    return [each for callback in task_set.callbacks for each in found[callback.key]]


def _add_outside(
    task_set: TaskSet, observed: Observed, found: dict[str, list[Drift]]
) -> None:
    """Add the messages that nodes published outside of their declared callbacks (rule 6)."""
    counts: dict[tuple[str, str], dict[str, int]] = {}
    for node, topic, by, count in observed.outside:
        of_topic = counts.setdefault((node, topic), {})
        of_topic[by] = of_topic.get(by, 0) + count
    for (node, topic), by_code in sorted(counts.items()):
        callbacks = _starting(task_set, node, topic)
        text = outside_text(task_set, node, topic, by_code)
        if text is not None:
            found[callbacks[0].key].append(Drift(
                'published outside', callbacks[0].key, topic, None, sum(by_code.values()), text))


def _starting(task_set: TaskSet, node: str, topic: str) -> list[Callback]:
    """Return the callbacks of a node that start other callbacks by a topic."""
    found = {}
    for dag in task_set.dags:
        for vertex in dag.vertices:
            callback = vertex.callback
            if callback.node == node and topic in callback.publishes and any(
                    topic in dag.vertices[after].callback.topics for after in vertex.successors):
                found[callback.key] = callback
    return list(found.values())


def outside_text(
    task_set: TaskSet, node: str, topic: str, by_code: Mapping[str, int],
    only_silent: bool = False,
) -> str | None:
    """
    Return a line about messages that no declared callback has published; None: they start nothing.

    :param by_code: their number by the undeclared callback or task; empty: the thread ran none.
    :param only_silent: return None as well if results are missed without them, which is seen.
    """
    callbacks = _starting(task_set, node, topic)
    is_silent = any(topic in callback.may_publish for callback in callbacks)
    if not callbacks or only_silent and not is_silent:
        return None
    count = sum(by_code.values())
    number = f'{count} message{"s" * (count != 1)} on {topic}'
    names = [by or 'threads of its own' for by in sorted(by_code, key=lambda by: -by_code[by])]
    keys = ' or '.join(callback.key for callback in callbacks)
    return printable(
        f'{node} published {number} in {_some(names)}, after {keys} had ended or without it: '
        f'{"it belongs" if count == 1 else "they belong"} to no job, and results that need '
        f'{"it" if count == 1 else "them"} are {"not due" if is_silent else "missed"}. Publish '
        f'in the callback, let it await or join what publishes'
        + (', or declare what publishes' if any(by_code) else ''))


def _some(names: Sequence[str]) -> str:
    return ', '.join(names[:3]) + (f' and {len(names) - 3} more' if len(names) > 3 else '')


def _suspects(task_set: TaskSet, observed: Observed) -> dict[str, Drift]:
    """Return the differences by rules 2, 3 and 4, by callback."""
    dags, certain = dags_of(task_set), _certain(task_set)
    suspects = {}
    for callback in task_set.callbacks:
        of_callback = dags.get(callback.key, [])
        if observed.nodes is not None and may_run_elsewhere(
                callback, of_callback, observed.nodes, task_set):
            continue
        why = None
        if callback.key in certain:
            why = _gone(callback, of_callback, observed) or _never_ran(
                callback, of_callback, observed)
        if why is None:
            if callback.period_ns is not None:
                why = _source_rate(callback, callback.period_ns, observed)
            elif callback.kind == 'subscription':
                why = _message_rate(callback, of_callback, observed, callback.key in certain)
        if why is not None:
            suspects[callback.key] = why
    return suspects


def dags_of(task_set: TaskSet) -> dict[str, list[Dag]]:
    """Return the DAGs of each callback."""
    dags: dict[str, list[Dag]] = {}
    for vertex in task_set.vertices:
        dags.setdefault(vertex.callback.key, []).append(task_set.dags[vertex.dag])
    return dags


def may_run_elsewhere(
    callback: Callback, dags: Sequence[Dag], nodes: Set[str], task_set: TaskSet
) -> bool:
    """Return whether a callback of these DAGs may run in another process (rule 5)."""
    return callback.node not in nodes and (
        bool(task_set.processes) or all(dag.release_from == 'header_stamp' for dag in dags))


def _never_ran(callback: Callback, dags: list[Dag], observed: Observed) -> Drift | None:
    ran = observed.executions.get(callback.key, 0)
    topic = None
    if ran and callback.kind == 'sync':
        received = observed.topics_received.get(callback.key, callback.topics)
        topic = next((each for each in callback.topics if each not in received), None)
    if ran and topic is None or not dags:
        return None
    slowest = min(dag.period_ns for dag in dags)
    latest = max((dag.vertices[sink].deadline_ns or 0 for dag in dags for sink in dag.sinks),
                 default=0)
    if observed.duration_ns < 2 * slowest + latest:
        return None
    due = _due_by_runs(callback, dags, observed)
    if topic is None and (observed.messages.get(callback.key, 0) or due is not None and due < 2):
        return None     # the callbacks before it, or its own executions, were late or dropped
    text = (f'{callback.key} never {"ran" if topic is None else f"got a message of {topic}"} in '
            f'the {observed.duration_ns / 1e9:.3f} s after the first release')
    question = suggest_entity(
        callback if topic is None else replace(callback, kind='subscription', topics=(topic,)),
        observed.undeclared)
    return Drift('never ran', callback.key, topic, None, 0,
                 printable(text if question is None else f'{text}: {question}'))


def _gone(callback: Callback, dags: list[Dag], observed: Observed) -> Drift | None:
    period = max((dag.period_ns for dag in dags), default=0)
    lacks = observed.gone.get(callback.key, 0)
    if callback.once or lacks <= max(SILENCE_NS, LEAST * period):
        return None
    what = 'a subscription' if callback.kind == 'sync' else f'the {callback.kind}'
    text = (f'{what} of {callback.key} was destroyed {lacks / 1e9:.3f} s before the end (its '
            'program destroyed it, or has ended)')
    if callback.kind == 'timer':
        text += f": if it {_SPORADIC[True]}, declare 'sporadic: true'"
    else:
        text += ': results that need it are missed after that'
    return Drift('stopped', callback.key, None, period, lacks, printable(text))


def _source_rate(callback: Callback, period: int, observed: Observed) -> Drift | None:
    created = observed.periods.get(callback.key)
    declared = callback.timer_period_ns
    if created is not None and declared is not None and not is_period(created, declared):
        return Drift('rate', callback.key, None, declared, created, printable(
            f'the timer of {callback.key} has a period of {format_duration(created)}, and '
            f'{format_duration(declared)} is declared'))
    releases = observed.releases.get(callback.key, Releases())
    is_regular = not (callback.once or callback.sporadic)
    if releases.count == 1 and callback.kind == 'timer' and is_regular and (
            observed.duration_ns > LEAST * period):
        return Drift('rate', callback.key, None, period, None, printable(
            f'{callback.key} was released once in {observed.duration_ns / 1e9:.3f} s, and every '
            f"{format_duration(period)} is declared: if it fires once, declare 'once: true'; if "
            "it is made again or reset when needed, 'sporadic: true'"))
    mean = releases.mean_ns() if releases.count >= LEAST else period
    if abs(mean - period) > TOLERANCE * period and not (callback.sporadic and mean > period):
        text = f'{callback.key} was released ' + (
            f'every {format_duration(mean)}, and {format_duration(period)} is declared' if mean
            else f'{releases.count} times at the same time, and every {format_duration(period)} '
            'is declared')
        if mean > period:
            text += f": if it {_SPORADIC[callback.kind == 'timer']}, declare 'sporadic: true'"
        return Drift('rate', callback.key, None, period, mean, printable(text))
    silent = observed.end_ns - releases.last
    if releases.count > 1 and silent > max(SILENCE_NS, LEAST * period) and is_regular and (
            callback.key not in observed.blocked):
        text = (f'{callback.key} was not released any more in the last {silent / 1e9:.3f} s, and '
                f'every {format_duration(period)} is declared')
        if callback.kind == 'timer':
            text += f": if it {_SPORADIC[True]}, declare 'sporadic: true'"
        return Drift('stopped', callback.key, None, period, silent, printable(text))
    return None


def _due_by_runs(
    callback: Callback, dags: list[Dag], observed: Observed, always: bool = False
) -> int | None:
    """
    Return the number of runs of the callbacks that publish to this one; None: unknown.

    :param always: count only those that publish to it each time.
    """
    before = {each.callback.key: (each, vertices)
              for each, vertices in _publishers(callback, dags, always)}
    if not before or not before.keys() <= observed.executions.keys():
        return None
    if any(vertex.callback.driven_by is not None for vertex, _ in before.values()):
        return None     # not each of its executions publishes
    # a sync runs once for each leg, and publishes once
    return sum(observed.executions[key] // max(1, len(legs_of(*each)))
               for key, each in before.items())


def _message_rate(
    callback: Callback, dags: list[Dag], observed: Observed, is_certain: bool
) -> Drift | None:
    expected = most = _due_by_runs(callback, dags, observed)
    got = observed.messages.get(callback.key, 0)
    if most is not None and got < most:
        expected = _due_by_runs(callback, dags, observed, always=True)
        if expected is not None and got > expected:
            return None     # as many as callbacks that publish sometimes may have published
    # The last release of each DAG may still be in progress.
    if expected is None or expected < LEAST or (
            abs(got - expected) <= TOLERANCE * expected + len(dags)) or (
            got < expected and not is_certain):
        return None
    text = f'{callback.key} got {got} messages, and by the declaration {expected} were due'
    if got < expected:
        topic = callback.topics[0]
        keys = sorted({before.callback.key for before, _ in _publishers(callback, dags, True)})
        numbers = [observed.published.get((key, topic)) for key in keys]
        sent = got if None in numbers else sum(filter(None, numbers))
        if expected - sent <= TOLERANCE * expected + len(dags):
            return None     # they were published, and did not arrive
        text += (f': if {" or ".join(keys)} published {topic} in {sent} of {expected} runs, '
                 f"declare 'may_publish: [{topic}]'")
    return Drift('rate', callback.key, None, expected, got, printable(text))


def _publishers(
    callback: Callback, dags: list[Dag], always: bool
) -> list[tuple[Vertex, Sequence[Vertex]]]:
    """
    Return the vertices that start the vertices of a callback, each with those of its DAG.

    :param always: only those that do so in each execution.
    """
    return [
        (dag.vertices[i], dag.vertices) for dag in dags for vertex in dag.vertices
        if vertex.callback.key == callback.key for i in vertex.predecessors
        if not always or all(after != vertex.index for after, _ in optional_edges(
            dag.vertices[i], dag.vertices))]


def _certain(task_set: TaskSet) -> set[str]:
    """
    Return the callbacks that must run by their declaration.

    The others have a sporadic source, or a topic that is published sometimes, on each path to
    them.
    """
    found: set[str] = set()
    for dag in task_set.dags:
        certain = [False] * len(dag.vertices)
        certain[dag.source] = not dag.sporadic
        for index in topological_order(dag):
            vertex = dag.vertices[index]
            if certain[index]:
                found.add(vertex.callback.key)
            maybe = {after for after, _ in optional_edges(vertex, dag.vertices)}
            for after in vertex.successors:
                certain[after] |= certain[index] and after not in maybe
    return found


def _first(task_set: TaskSet, suspects: Mapping[str, Drift]) -> list[str]:
    """Return the suspects with no suspect before them in any of their DAGs (rule 7)."""
    explained: set[str] = set()
    for dag in task_set.dags:
        behind = [False] * len(dag.vertices)
        for index in topological_order(dag):
            key = dag.vertices[index].callback.key
            if behind[index] and key in suspects:
                explained.add(key)
            for after in dag.vertices[index].successors:
                behind[after] = behind[after] or behind[index] or key in suspects
    return [key for key in suspects if key not in explained]
