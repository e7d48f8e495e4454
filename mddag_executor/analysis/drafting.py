# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Drafts systems from traces: nodes, callbacks, published topics, rates, execution times.

Theory of operation
-------------------
1. The tables of the recording have the executions and publications.  Entities of every node
   (parameter services and the like) and the timers of ``Rate`` are ignored, and so are nodes
   without others.
2. A coroutine is one execution, however often it was resumed.
3. A callback in the recorded declaration keeps its name and the declared properties that a trace
   does not show: deadline, queue edges, period, sync, group, name of the DAG, and topics that
   nothing published.  Other callbacks are named by their recorded function, otherwise
   ``callback_0``, ``callback_1``, … by node, in the order of creation.
4. A topic of a node is published by the callbacks that were seen to publish it. If none was, but
   messages of it were received, no callback publishes it: the node does so when it is made, or in
   a thread of its own.  Its subscribers are sources, and sporadic if they got at most one message.
   If none were received, every callback of the node may publish it; for a node without callbacks
   a timer is assumed.
5. A service without calls, and a subscription without messages whose topic no callback publishes,
   have no rate, so they cannot be the source of a DAG.  They are left out and reported, and take
   no name from those that ran.  So is a timer that never fired in ``NEVER_PERIODS`` periods.
6. A timer that was made again (``recording.timers``) is one callback, and ``sporadic``.  So is a
   timer that was reset: its due times are not whole periods apart, or the only one is much later
   than a period after it was made.
7. Subscriptions of a node are one sync (``_find_syncs``) if the messages that they publish have
   the header stamps of several of their topics, or are as many as the messages of one of them.
8. The period of a subscription or service comes from the times at which its messages or requests
   arrived (``usual_interval``), not from when it ran: executions of a busy pool come in bursts.
   If the gaps are alike, the period is their median.  Otherwise it is the median of the means of
   ``IN_A_ROW`` successive gaps, if these are alike: messages of two publishers, or of a network
   that delivers two at a time.  Otherwise it is the least of these means: a single gap may be
   arbitrarily short, and a simulation releases a job in each period.  With fewer gaps it is their
   mean, but not so short that ``IN_A_ROW`` of them would fit into the recording.
   A source is ``sporadic`` if nothing is alike, if pauses take a good part of the time, or if it
   is a service.
9. Execution times are the quantiles of ``PERCENT``. For a sync callback they are of the executions
   that completed it: the others only store a message.
"""

from __future__ import annotations

from itertools import pairwise
import os
from typing import NamedTuple

from mddag_executor.core import quantile
from mddag_executor.errors import InputError
from mddag_executor.recording.columns import Ints, Mask
from mddag_executor.recording.joins import rows_by, sort_by, whole_periods
from mddag_executor.recording.mapping import declared_keys
from mddag_executor.recording.names import Callback, KINDS
from mddag_executor.recording.recording import Recording
from mddag_executor.recording.tables import VERTEX
from mddag_executor.recording.timers import is_overdue, made_again
from mddag_executor.sources.open import open_to_draft, Traces
from mddag_executor.sources.progress import Progress
from msg_graph import Callback as Declared
from msg_graph import EMPTY_TASK_SET, ExecutionTime, TaskSet
from msg_graph.binding import function_of, is_background, is_side_output, OF_RATE
from msg_graph.draft import Draft, DraftCallback, DraftNode, DraftPath, leave_out_sources
from msg_graph.drift import TOLERANCE
from msg_graph.duration import DAY, exact_duration
from msg_graph.language import CALLBACK, NODE, SERVICE, TOPIC
import numpy as np

PERCENT = (0.0, 50.0, 90.0, 99.0, 100.0)
LEAST_SILENT, LEAST_SILENT_SHARE = 2, 0.02
"""A callback publishes only sometimes if more executions, and a larger share, were silent."""
DRIVEN_SHARE = 0.15
"""The largest difference of two numbers of executions that count as equal."""
COPIED_SHARE = 0.9
"""A callback copies header stamps if this share of its messages has one of a received topic."""
STORES_NS = 500_000
"""A callback that only stores its message takes no longer in nine of ten executions."""
IRREGULAR = 3
"""Gaps between arrivals are alike if the 90 % quantile is at most this many times the 10 % one."""
IN_A_ROW = 10
"""The mean of this many gaps is steady, even if messages come two or three at a time."""
_STEADY = 1.5
"""… and the means are alike up to this ratio.  That of purely random arrivals is about 2.3."""
_LONG_NS = 2_000_000_000
"""One message in at least this time has no rate."""
ONCE_PERIODS = 3
"""A timer fires once if it was silent for this many periods after its only execution."""
NEVER_PERIODS = 20
"""A timer never fires if a recording of this many periods has no execution of it."""
RESET_SHARE = 0.1
"""A timer was reset if a larger share of its due times are off its period."""
LEAST_COPIED = 5
"""From fewer messages with header stamps nothing is concluded."""
_NO_STAMPS: Ints = np.empty(0, dtype=np.int64)


class Runs(NamedTuple):
    """
    The executions of a callback.

    :ivar starts: of each, ns; ``arrivals``: when each became ready.
    :ivar times: how long each took, all pieces together.
    :ivar due: of a timer, when each was due, as far as it is known, ns.
    :ivar whole: which of them completed a vertex.
    :ivar topics: what they published on, in the order of time.
    :ivar published: by topic, in how many executions it was published.
    """

    starts: Ints
    arrivals: Ints
    due: Ints
    times: Ints
    whole: Mask
    topics: list[str]
    published: dict[str, int]


class System:
    """
    The recorded system, as far as a trace shows it.

    :param path: a trace of this executor, those of all processes of one run, or an imported
        recording of CARET or ros2_tracing.
    :ivar warnings: missing data of the trace, one line each.
    """

    def __init__(
        self, path: str | os.PathLike[str] | Traces, name: str | None = None,
        progress: Progress | None = None,
    ) -> None:
        self.name = name or str(path)
        recording = open_to_draft(path, self.name, progress)
        declared = recording.run.declared
        self.task_set: TaskSet | None = recording.task_set if declared else None
        self.workers: int | None = recording.run.head.workers if declared else None
        self.warnings = [
            loss.text for loss in recording.missing if loss.kind == 'damage']
        self._process_names = recording.names.processes
        self._names = recording.names
        self._end = recording.end
        self._length = recording.end - recording.run.begin
        self._entities = [entity for entity in sorted(
            self._names.made, key=lambda e: (e.made, KINDS.index(e.kind))) if _is_shown(entity)]
        if not self._entities:
            raise InputError(
                self.name, 'no timer, subscription or service of a node is recorded in it',
                'record the start of the nodes as well; actions and parameters, if nodes have '
                'nothing else, cannot be declared')
        # by callback's number
        numbers, index = recording.callbacks()
        self._declared: dict[int, Declared] = {
            number: recording.task_set.vertices[vertex].callback for number, vertex in zip(
                numbers.tolist(), recording.vertices_of_callbacks().tolist()) if vertex >= 0}
        # some ran as no vertex: those of the other topics of a driven sync, and those not yet due
        for number, key in declared_keys(self._names, recording.run.recorded_set).items():
            self._declared.setdefault(number, recording.run.recorded_set.callback(key))
        self._runs = {number: _runs_of(recording, chosen) for number, chosen in zip(
            numbers.tolist(), rows_by(index, len(numbers)))}
        self._find_publishers(recording)
        #: The numbers of the timers that were made again.
        self._made_again: set[int] = set()
        self._join_timers()

    def _find_publishers(self, recording: Recording) -> None:
        """Find the topics of callbacks and nodes."""
        #: By node its published topics, and whether a callback was seen to publish them.
        self._publishers: dict[str, dict[str, bool]] = {
            name: {} for name in self._names.nodes}
        publishers = self._names.publishers
        for publisher in publishers.values():
            if publisher.node is not None:
                self._publishers[publisher.node.name][publisher.topic] = False
        self._find_headers(recording)
        sent = recording.publications[recording.publications['execution'] >= 0]
        pairs = np.stack((recording.executions['callback'][sent['execution']], sent['publisher']))
        different, first, pair = np.unique(pairs, axis=1, return_index=True, return_inverse=True)
        several = np.unique(np.stack((pair.reshape(-1), sent['execution'])), axis=1)
        counts = np.bincount(several[0].astype(np.int64), minlength=len(first))
        by_time = np.argsort(first)
        for (callback, number), count in zip(
                different.T[by_time].tolist(), counts[by_time].tolist()):
            known = publishers.get(number)
            if known is not None:
                runs = self._runs[callback]
                runs.topics.append(known.topic)
                runs.published[known.topic] = runs.published.get(known.topic, 0) + count
                if known.node is not None:
                    self._publishers[known.node.name][known.topic] = True

    def _join_timers(self) -> None:
        """Join each timer with those that are the same callback (rule 6)."""
        timers = [each for each in self._entities if each.kind == 'timer']
        last = {number: int(runs.starts.max()) for number, runs in self._runs.items()
                if len(runs.starts)}
        again = [*made_again(
            [each for each in timers if each.number not in self._declared], last, self._end)]
        first: dict[str, Callback] = {}
        for entity in timers:
            declared = self._declared.get(entity.number)
            if declared is not None and declared.sporadic:
                before = first.setdefault(declared.key, entity)
                if before is not entity:
                    again.append((entity, before))
        self._join(again)

    def _join(self, pairs: list[tuple[Callback, Callback]]) -> None:
        """Make one callback of those of each pair: the second one, which was made first."""
        for entity, before in pairs:
            runs, again = (self._runs.get(each.number) for each in (before, entity))
            self._entities.remove(entity)
            self._made_again.add(before.number)
            if runs is not None and again is not None:
                again = Runs(
                    np.append(runs.starts, again.starts),
                    np.append(runs.arrivals, again.arrivals), np.append(runs.due, again.due),
                    np.append(runs.times, again.times), np.append(runs.whole, again.whole),
                    runs.topics + again.topics, {
                        topic: runs.published.get(topic, 0) + again.published.get(topic, 0)
                        for topic in {**runs.published, **again.published}})
            if again is not None:
                self._runs[before.number] = again

    def _is_silent(self, entity: Callback) -> bool:
        """Return whether an entity may be left out because it never ran (rule 5)."""
        runs = self._runs.get(entity.number)
        return (runs is None or not len(runs.starts)) and entity.number not in self._declared and (
            entity.kind != 'timer' or self._never_fires(entity.period))

    def _never_fires(self, period: int) -> bool:
        """Return whether the recording is so long that a timer that has not fired never does."""
        return self._length > NEVER_PERIODS * min(period, DAY)

    def _find_headers(self, recording: Recording) -> None:
        """Find the header stamps of messages: by topic, and of the executions of callbacks."""
        #: By callback's number and topic.
        self._sent_headers: dict[tuple[int, str], Ints] = {}
        self._headers: dict[str, list[Ints]] = {}
        sent = recording.publications
        sent = sent[sent['header_stamp'] > 0]
        by = np.where(sent['execution'] >= 0, np.append(
            recording.executions['callback'], 0)[sent['execution']], 0)
        pairs, which = np.unique(
            np.stack((by, sent['publisher'])), axis=1, return_inverse=True)
        for (callback, number), mine in zip(
                pairs.T.tolist(), rows_by(which.reshape(-1), pairs.shape[1])):
            publisher = self._names.publishers.get(number)
            if publisher is not None:
                stamps = np.unique(sent['header_stamp'][mine])
                self._headers.setdefault(publisher.topic, []).append(stamps)
                self._sent_headers[callback, publisher.topic] = stamps

    def _copied_from(
        self, node: str, topic: str, several: list[DraftCallback], total: int
    ) -> list[DraftCallback]:
        """
        Return those of the subscriptions of a node whose header stamps its messages have.

        None: there are no header stamps; or the same stamp is published again and again, as that
        of the latest value.
        """
        stamps = np.concatenate([_NO_STAMPS, *(
            self._sent_headers.get((entity.number, topic), _NO_STAMPS)
            for entity in self._entities
            if entity.node_name == node and entity.kind == 'subscription')])
        if len(stamps) < LEAST_COPIED or total > (1 + DRIVEN_SHARE) * len(stamps):
            return []
        return [each for each in several if np.isin(stamps, np.concatenate(
            self._headers.get(each.started_by[0], [_NO_STAMPS]))).mean() >= COPIED_SHARE]

    def draft(self) -> Draft:
        """Return the whole system."""
        nodes: dict[str, DraftNode] = {}
        for entity in sorted(self._entities, key=self._is_silent):  # names go to those that ran
            node = nodes.setdefault(entity.node_name, DraftNode(entity.node_name))
            callback = self._callback(entity, node)
            node.callbacks.setdefault(callback.name, callback)
        self._keep_declared_topics(nodes)
        received = {topic for node in nodes.values() for callback in node.callbacks.values()
                    if callback.kind == 'subscription' and callback.runs
                    for topic in callback.started_by}
        for name, topics in self._publishers.items():
            drafted = nodes[name].callbacks if name in nodes else {}
            known = {topic for each in drafted.values() for topic in each.publishes}
            unseen = [t for t, seen in topics.items() if not seen and t not in known
                      and t not in received
                      and not is_side_output(t, name) and TOPIC.fits(t)]
            if unseen and not drafted and NODE.fits(name):
                timer = DraftCallback(name, 'callback_0', 'timer')
                drafted = {timer.name: timer}
                nodes[name] = DraftNode(name, drafted)
            for each in drafted.values():
                each.possible_topics.extend(unseen)
        sources = _Sources(nodes)
        for node in nodes.values():
            self._find_syncs(node, sources)
            _find_stores(node)
        draft = Draft(
            f'the trace {self.name}', self._ordered(nodes), self._paths(nodes), self.workers)
        declared = {callback.key for callback in self._declared.values()}
        leave_out_sources(draft, lambda callback: (
            callback.runs == 0 and callback.kind != 'timer' and callback.key not in declared),
            'it never ran')
        leave_out_sources(draft, lambda callback: (
            callback.runs == 0 and callback.kind == 'timer' and callback.key not in declared
            and self._never_fires(callback.period_ns or DAY)),
            'it never fired, so it was cancelled, or reset each time before')
        draft.processes = self._processes([node.name for node in draft.nodes if node.callbacks])
        return draft

    def _keep_declared_topics(self, nodes: dict[str, DraftNode]) -> None:
        """Keep declared topics that no callback has published: the recording may be too short."""
        every = {c.key: c for node in nodes.values() for c in node.callbacks.values()}
        seen = {topic for callback in every.values() for topic in callback.publishes}
        for declared in self._declared.values():
            callback = every.get(declared.key)
            if callback is None:
                continue
            for topic in declared.publishes:
                if topic in seen or topic in callback.publishes:
                    continue
                callback.publishes.append(topic)
                if (callback.runs or 0) > LEAST_SILENT:
                    callback.sometimes[topic] = 0, callback.runs or 0

    def _find_syncs(self, node: DraftNode, sources: _Sources) -> None:
        """
        Join the subscriptions of a node that publish one topic from the messages of both.

        They are a sync of one rate if each of them publishes the topic, its messages have the
        header stamps of several of their topics, and these have the same source. They are a sync
        of different rates if several of them publish the topic, and its messages have the header
        stamps of just one of their topics, or are as many as those of one.
        """
        declared = {callback.key for callback in self._declared.values()}
        subscriptions = [each for each in node.callbacks.values()
                         if each.kind == 'subscription' and each.key not in declared]
        topics = dict.fromkeys(topic for each in subscriptions for topic in each.publishes)
        for topic in topics:
            left = [each for each in subscriptions
                    if each.kind == 'subscription' and each.name in node.callbacks]
            several = [each for each in left if topic in each.publishes]
            total = sum(_published_by(each, topic) for each in several)
            copied = self._copied_from(node.name, topic, left, total)
            if len(copied) > 1:
                if all(each in several for each in copied) and len(
                        {sources.of(each.started_by[0]) for each in copied}) == 1:
                    _join(node, copied[0], copied[1:], topic, (
                        f'{topic} has the header stamps of '
                        f'{" and ".join(each.started_by[0] for each in copied)}'), driven=False)
                    continue
                copied = []
            if copied and several != copied:
                driver, = copied
                if driver not in several:
                    several.append(driver)
                why = f'{topic} has the header stamps of {driver.started_by[0]}'
            elif copied or len({each.started_by[0] for each in several}) < 2:
                continue
            else:
                driver = min(several, key=lambda each: abs((each.runs or 0) - total))
                runs = [each.runs or 0 for each in several]
                if max(runs) - min(runs) <= DRIVEN_SHARE * max(runs) or abs(
                        (driver.runs or 0) - total) > max(LEAST_SILENT, DRIVEN_SHARE * total):
                    continue
                why = (f'its executions published {topic} {total} times, and '
                       f'{driver.started_by[0]} came {driver.runs} times')
            _join(node, driver, [each for each in several if each is not driver], topic, why)

    def _processes(self, nodes: list[str]) -> dict[str, list[str]]:
        """Return the given nodes of each process, as declared; none if there is one process."""
        if self.task_set is not None and self.task_set.processes:
            declared = {process.name: [node for node in process.nodes if node in nodes]
                        for process in self.task_set.processes}
            declared = {name: mine for name, mine in declared.items() if mine}
            return declared if len(declared) > 1 else {}
        pids = {entity.node.name: entity.node.pid for entity in reversed(self._entities)
                if entity.node is not None}
        found: dict[str, list[str]] = {}
        for node in nodes:
            if pids.get(node) in self._process_names:
                found.setdefault(self._process_names[pids[node]], []).append(node)
        return found if len(found) > 1 else {}

    def _ordered(self, nodes: dict[str, DraftNode]) -> list[DraftNode]:
        """
        Return the nodes in the order of the recorded declaration, which decides ties.

        Others are sorted by name: an executor's nodes are recorded in any order.
        """
        by_name = [nodes[name] for name in sorted(nodes)]
        if self.task_set is None:
            return by_name
        place = self.task_set.callback_indices()
        every = [callback for node in by_name for callback in node.callbacks.values()]
        found: list[DraftNode] = []
        for callback in sorted(every, key=lambda c: place.get(c.key, len(place))):
            if not found or found[-1].name != callback.node:
                found.append(DraftNode(callback.node))  # a node may have several entries
            found[-1].callbacks[callback.name] = callback
        return found

    def _paths(self, nodes: dict[str, DraftNode]) -> list[DraftPath]:
        """Return the declared paths without those of which a step was not recorded."""
        every = {c.key: c for node in nodes.values() for c in node.callbacks.values()}
        return [
            DraftPath(path.name, [], list(path.callbacks), {
                **{what: exact_duration(time) for what, time in path.requirements.items()},
                **({} if path.tolerate is None else {'tolerate': str(path.tolerate)})})
            for path in (self.task_set or EMPTY_TASK_SET).paths
            if every.keys() >= set(path.callbacks) and all(
                not {*before.publishes, before.name}.isdisjoint(after.started_by + after.reads)
                for before, after in pairwise(every[key] for key in path.callbacks))]

    def _callback(self, entity: Callback, node: DraftNode) -> DraftCallback:
        declared = self._declared.get(entity.number)
        if declared is not None and declared.node == entity.node_name:
            known = node.callbacks.get(declared.name)
            callback = known or _from_declared(declared)
        else:
            callback = DraftCallback(
                entity.node_name, self._free_name(entity, node), entity.kind,
                [entity.start] if entity.start else [],
                entity.period if entity.kind == 'timer' and entity.period <= DAY else None)
            callback.group = self._group_name(entity)
        self._measure(callback, entity)
        return callback

    def _free_name(self, entity: Callback, node: DraftNode) -> str:
        """Return a free name for a callback without name."""
        declared = () if self.task_set is None else self.task_set.callbacks
        taken = {*node.callbacks, *(c.name for c in declared if c.node == entity.node_name)}
        name = function_of(entity.symbol)
        if name is None or not CALLBACK.fits(name):
            names = [f'callback_{number}' for number in range(len(taken), 2 * len(taken) + 1)]
        else:
            names = [name, *(f'{name}_{number}' for number in range(2, len(taken) + 2))]
        return next(each for each in names if each not in taken)

    def _group_name(self, entity: Callback) -> str | None:
        """Return a name for a group that several callbacks of the node share."""
        groups = [e.group for e in self._entities
                  if e.node_name == entity.node_name and e.group not in (None, -1)]
        if entity.group is None or groups.count(entity.group) < 2:
            return None
        return f'callback_group_{list(dict.fromkeys(groups)).index(entity.group)}'

    def _measure(self, callback: DraftCallback, entity: Callback) -> bool:
        """Fill in the measured values of a callback; return whether there are any."""
        runs = self._runs.get(entity.number)
        count = 0 if runs is None else len(runs.starts)
        callback.runs = (callback.runs or 0) + count
        if runs is None or not count:
            return False
        declared = self._declared.get(entity.number)
        callback.publishes.extend(
            t for t in dict.fromkeys(runs.topics)
            if t not in callback.publishes and TOPIC.fits(t) and (
                declared is not None and t in declared.publishes
                or not is_side_output(t, callback.node)))
        callback.possible_topics = [
            t for t in callback.possible_topics if t not in callback.publishes]
        if callback.kind != 'sync':     # each of its messages runs it, and one of them publishes
            silent = {topic: count - n for topic, n in runs.published.items()}
            callback.sometimes.update({
                topic: (runs.published[topic], count) for topic in callback.publishes
                if silent.get(topic, 0) > max(LEAST_SILENT, LEAST_SILENT_SHARE * count)})
        if entity.number in self._made_again:
            callback.other_keys['sporadic'] = 'true'
        elif callback.kind == 'timer' and declared is None and _was_reset(entity, runs.due):
            callback.other_keys['sporadic'] = 'true  # proposed: it was reset'
        elif callback.kind == 'timer' and count == 1 and (
                'sporadic' not in callback.other_keys
                and self._end - int(runs.starts[0]) > ONCE_PERIODS * (callback.period_ns or DAY)):
            callback.other_keys['once'] = (
                "true  # proposed: it fired once; if the node resets it, 'sporadic: true'")
        if callback.kind == 'sync':
            legs = [self._runs[number] for number, declared in self._declared.items()
                    if declared.key == callback.key and number in self._runs]
            callback.times = execution_time(np.concatenate(
                [leg.times[leg.whole] for leg in legs or [runs]]))
        else:
            if count > 1:
                # a client sends a request when it needs one
                callback.interval_ns, callback.is_irregular = usual_interval(
                    runs.arrivals, self._end, False if callback.kind == 'service' else None)
            elif callback.kind != 'timer' and self._length > _LONG_NS:
                callback.came_once = True
            callback.times = execution_time(runs.times)
        return True

    def measure(self, draft: Draft) -> int:
        """
        Fill measured values into a draft of the same system; return the number of callbacks.

        Callbacks are matched by node and trigger; of several with the same trigger by the order of
        creation.
        """
        waiting: dict[tuple[str, str, str], list[Callback]] = {}
        for entity in self._entities:
            start = str(entity.period) if entity.kind == 'timer' else entity.start
            waiting.setdefault((entity.node_name, entity.kind, start), []).append(entity)
        count = 0
        for callback in draft.callbacks():
            start = callback.started_by[0] if callback.started_by else str(callback.period_ns)
            fits = waiting.get((callback.node, callback.kind, start))
            if fits:
                count += self._measure(callback, fits.pop(0))
        return count


class _Sources:
    """Finds the sources of topics: callbacks that no callback starts, or topics from outside."""

    def __init__(self, nodes: dict[str, DraftNode]) -> None:
        self._publishers: dict[str, list[DraftCallback]] = {}
        for node in nodes.values():
            for callback in node.callbacks.values():
                for topic in callback.publishes:
                    self._publishers.setdefault(topic, []).append(callback)

    def of(self, topic: str) -> frozenset[str]:
        """Return the sources of a topic."""
        found, seen, stack = set(), {topic}, [topic]
        while stack:
            each = stack.pop()
            publishers = self._publishers.get(each, [])
            if not publishers:
                found.add(each)
            for callback in publishers:
                if not callback.triggers:
                    found.add(callback.key)
                stack.extend(before for before in callback.triggers if before not in seen)
                seen.update(callback.triggers)
        return frozenset(found)


def _published_by(callback: DraftCallback, topic: str) -> int:
    """Return in how many executions a callback published a topic that it has published."""
    counts = callback.sometimes.get(topic)
    return counts[0] if counts is not None else (callback.runs or 0)


def _join(
    node: DraftNode, driver: DraftCallback, others: list[DraftCallback], topic: str, why: str,
    driven: bool = True,
) -> None:
    """Make one sync of subscriptions for a topic, which the topic of one of them may drive."""
    runs = driver.runs or 0
    driver.why = f'  # proposed: {why}'
    published = {
        each: sum(_published_by(c, each) for c in (driver, *others) if each in c.publishes)
        for each in dict.fromkeys(t for c in (driver, *others) for t in c.publishes)}
    driver.kind, driver.driven_by = 'sync', driver.started_by[0] if driven else None
    driver.publishes = list(published)
    driver.sometimes = {
        each: (count, runs) for each, count in published.items()
        if each != topic and runs - count > max(LEAST_SILENT, DRIVEN_SHARE * runs)}
    for other in others:
        driver.started_by += other.started_by
        if other.times is not None and (driver.times is None or (
                other.times[0].mean_ns > driver.times[0].mean_ns)):
            driver.times = other.times
        del node.callbacks[other.name]


def _find_stores(node: DraftNode) -> None:
    """Mark the subscriptions that seem to only store a message for another callback."""
    for callback in node.callbacks.values():
        others = [each for each in node.callbacks.values() if each is not callback]
        callback.stores = (
            callback.kind == 'subscription' and not callback.publishes
            and callback.times is not None
            and callback.times[0].draw(0.9) <= STORES_NS
            and any(each.publishes or each.kind == 'service' for each in others))


def _runs_of(recording: Recording, which: Ints) -> Runs:
    """Return the executions of a callback: the chosen rows."""
    table = recording.executions[which]
    table = table[table['start'] >= 0]
    table = table[sort_by(*(table[name] for name in ('vertex', 'job', 'ready', 'start')))]
    first = np.flatnonzero(table['piece'] == 0)
    last = np.append(first, len(table))[1:] - 1
    due = table['due'][first]
    return Runs(table['start'][first], table['ready'][first], due[due > 0], table['busy'][last],
                table['completes'][last] == VERTEX, [], {})


def usual_interval(arrivals: Ints, end: int, steady: bool | None = None) -> tuple[int, bool]:
    """
    Return the period of at least two arrivals, ns, and whether they are sporadic (rule 8).

    :param end: of the recording, ns.
    :param steady: whether the rate is known to be steady or not; None: it is found out.
    """
    arrivals = np.sort(arrivals)
    gaps = np.diff(arrivals)
    means = (arrivals[IN_A_ROW:] - arrivals[:-IN_A_ROW]) // IN_A_ROW
    alike = gaps if _ratio(gaps) <= IRREGULAR else means if (
        len(means) > 2 * IN_A_ROW and _ratio(means) <= _STEADY) else None
    usual = None if alike is None else int(np.median(alike))
    # a node may end before the recording; after a few messages its silence says more
    first, last = int(arrivals[0]), int(arrivals[-1]) if len(means) else end
    if steady is None:
        steady = usual is not None and last - first <= (1 + TOLERANCE) * usual * len(arrivals)
    if usual is None or not (steady or len(means)):
        usual = int(means.min() if len(means) else max(
            int(arrivals[-1] - first) // len(gaps), (end - first) // IN_A_ROW))
    return max(1_000, usual), not steady


def _ratio(times: Ints) -> float:
    """Return the 90 % quantile of times, divided by the 10 % quantile."""
    times = np.sort(times)
    low, high = times[len(times) // 10], times[len(times) * 9 // 10]
    return float(high) / max(1, int(low))


def _was_reset(timer: Callback, due: Ints) -> bool:
    """Return whether a timer did not keep to its period (rule 6)."""
    if not len(due) or not 0 < timer.period <= DAY:
        return False
    _, is_whole = whole_periods(due, timer.period)
    off = int((~is_whole).sum())
    return off > max(1, RESET_SHARE * len(is_whole)) or (
        len(due) == 1 and is_overdue(timer, int(due[0])))


def execution_time(took: Ints) -> tuple[ExecutionTime, int] | None:
    """Return the execution time of a callback and the number of executions; None without any."""
    times = np.sort(np.maximum(1, took[took >= 0])).tolist()
    if not times:
        return None
    quantiles = tuple(quantile(times, share / 100) for share in PERCENT)
    return ExecutionTime(quantiles, PERCENT), len(times)


def _is_shown(entity: Callback) -> bool:
    """Return whether an entity is a callback of the user's (rule 1)."""
    if not NODE.fits(entity.node_name):
        return False
    if entity.kind == 'timer':
        return entity.period >= 1_000 and entity.symbol != OF_RATE
    name = TOPIC if entity.kind == 'subscription' else SERVICE
    return not is_background(entity.start, entity.node_name) and name.fits(entity.start)


def _from_declared(declared: Declared) -> DraftCallback:
    starts = [declared.service] if declared.service else list(declared.topics)
    other_keys = {key: str(value).lower() for key, value, usual in (
        ('on_late', declared.on_late, None),
        ('keep', declared.keep, 'all'),
        ('importance', declared.importance, 'normal'),
        ('tolerate', declared.tolerate, None),
        ('max_active_jobs', declared.max_active_jobs, None),
        ('holds_interpreter', declared.holds_interpreter, None),
        ('once', declared.once, False), ('sporadic', declared.sporadic, False),
        ) if value != usual}
    return DraftCallback(
        declared.node, declared.name, declared.kind, starts, declared.period_ns,
        list(declared.may_publish), [],
        list(declared.reads), declared.group, declared.dag, declared.deadline_ns,
        declared.release_from, other_keys=other_keys, judged=declared.judged,
        driven_by=declared.driven_by,
        sometimes=dict.fromkeys(declared.may_publish))
