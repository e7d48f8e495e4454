# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What is collected while an imported run is played: counts, communication, paths."""

from __future__ import annotations

from array import array
from collections import Counter
from typing import Any

from mddag_executor.replay.entities import Callback, Entities
from mddag_executor.replay.happenings import Batch
from mddag_executor.replay.imported_run import ImportedRun
from mddag_executor.replay.linker import Execution, KEEP, LinkObserver, Publication
from mddag_executor.replay.paths import PathBook
from mddag_executor.replay.spread import Spread
import numpy as np

_BATCH = 1024


class _Times:
    """Times that have to do with a callback, ns."""

    __slots__ = ('callback', '_spread', '_last')

    def __init__(self, callback: Callback) -> None:
        self.callback = callback
        self._spread = Spread()
        self._last = array('q')

    def add(self, time: int) -> None:
        """Add a time; many go on together, which is quicker."""
        self._last.append(time)
        if len(self._last) >= _BATCH:
            self.whole()

    def whole(self) -> Spread:
        """Return the distribution of all of them."""
        self._spread.add(np.array(self._last, dtype=np.int64))
        self._last = array('q')
        return self._spread


class Communications(LinkObserver):
    """Collects callbacks and messages while an imported run is played."""

    def __init__(self, who: Entities) -> None:
        self._who = who
        # by callback how often it started, and how long it ran; by publisher how often it sent,
        # and by both how long messages took to the start of the callback
        self._started: Counter[int] = Counter()
        self._ran: dict[int, _Times] = {}
        self._sent: Counter[int] = Counter()
        self._arrived: dict[tuple[int, int], _Times] = {}

    def began(self, run: Execution, message: Publication | None) -> None:
        """Count an execution, and the way of its message."""
        callback = run.callback
        self._started[callback.number] += 1
        if callback.number not in self._ran:
            self._ran[callback.number] = _Times(callback)
        if message is not None and message.publisher is not None and message.time:
            key = (message.publisher.number, callback.number)
            if key not in self._arrived:
                self._arrived[key] = _Times(callback)
            self._arrived[key].add(run.start - message.time)

    def over(self, run: Execution) -> None:
        """Add how long an execution took."""
        self._ran[run.callback.number].add(run.end - run.start)

    def sent(self, message: Publication) -> None:
        """Count a message of its publisher."""
        if message.publisher is not None:
            self._sent[message.publisher.number] += 1

    def callbacks(self) -> dict[str, dict[str, int]]:
        """Return counts and times (ns) of each recorded callback that ran."""
        found = {}
        for number, times in sorted(self._ran.items(), key=lambda each: each[1].callback.label):
            took = times.whole()
            found[times.callback.label] = {
                'executions': took.count, 'unfinished': self._started[number] - took.count,
                'busy_ns': took.total, 'shortest_ns': took.least if took.count else 0,
                'longest_ns': max(0, took.greatest)}
        return found

    def communications(self) -> list[dict[str, Any]]:
        """Return for each pair of publisher and callback messages, and publication to start."""
        found = []
        for (number, _), times in self._arrived.items():
            if number not in self._sent:
                continue
            publisher, latencies = self._who.every_publisher[number], times.whole()
            found.append({
                'topic': publisher.topic,
                'publisher': publisher.node.name if publisher.node is not None else None,
                'callback': times.callback.label, 'sent': self._sent[number],
                'arrived': latencies.count, 'latency_ns': latencies.result()})
        return sorted(found, key=lambda each: (each['topic'], each['callback']))


class ImportedPaths(LinkObserver):
    """Collects the flows along the declared paths of an imported run."""

    def __init__(self, run: ImportedRun) -> None:
        self.book = PathBook(run.task_set, kept=KEEP)
        self._target = run.targets
        self._order = 0
        self._rows: list[list[tuple[int, ...]]] = [[], [], [], []]
        self._number = 0

    def take(self, batch: Batch) -> None:
        """Hand over what came since the last batch."""
        self.book.add(self._order + 1, *(
            np.array(rows, dtype=np.int64).reshape(len(rows), width)
            for rows, width in zip(self._rows, (7, 4, 7, 4))))
        self._order, self._rows = 0, [[], [], [], []]

    def _add(self, what: int, run: Execution | None, *row: int) -> None:
        """Note what a callback did, if it is on a path."""
        target = None if run is None else self._target.get(run.callback.number)
        if run is None or target is None or target.callback.key not in self.book.on_path:
            return
        self._order += 1
        self._rows[what].append(
            (self._order, self.book.callbacks[target.callback.key], *row))

    def began(self, run: Execution, message: Publication | None) -> None:
        """Note what an execution runs for."""
        self._number += 1
        run.number = self._number
        target = self._target.get(run.callback.number)
        topic = '' if target is None else target.topic
        self._add(0, run, run.number, run.start,
                  self.book.topics.get(topic, -2) if topic else -1,
                  -1 if message is None else message.number, -1)

    def over(self, run: Execution) -> None:
        """Note the end of an execution."""
        self._add(1, run, run.number, run.end)

    def sent(self, message: Publication) -> None:
        """Note a publication."""
        self._number += 1
        message.number = self._number
        publisher, run = message.publisher, message.run
        if (publisher is None or publisher.node is None
                or publisher.topic not in self.book.topics):
            return
        node, topic = publisher.node.name, self.book.topics[publisher.topic]
        target = None if run is None else self._target.get(run.callback.number)
        if target is not None and run is not None and target.callback.node == node:
            self._add(2, run, -1, run.number, topic, message.number, message.time)
        else:
            self._order += 1
            self._rows[2].append((
                self._order, -1, self.book.nodes.get(node, -1), -1, topic, message.number,
                message.time))

    def took(self, run: Execution, message: Publication) -> None:
        """Note a message that a callback took itself."""
        self._add(3, run, run.number, message.number)
