# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What is collected while an imported run is played: counts, communication, paths."""

from __future__ import annotations

from array import array
from typing import Any

from mddag_executor.replay.entities import Callback, Publisher
from mddag_executor.replay.happenings import Batch
from mddag_executor.replay.imported_run import ImportedRun
from mddag_executor.replay.linker import Execution, KEEP, LinkObserver, Publication
from mddag_executor.replay.paths import PathBook
from mddag_executor.replay.spread import Spread
import numpy as np

_BATCH = 1024


class _Executions:
    """Counts and sums of a recorded callback's executions, ns."""

    __slots__ = ('callback', 'started', 'finished', 'busy', 'shortest', 'longest')

    def __init__(self, callback: Callback) -> None:
        self.callback = callback
        self.started = 0
        self.finished = 0
        self.busy = 0
        self.shortest = 0
        self.longest = 0


class _Latencies:
    """From the publication to the start of a callback, ns."""

    __slots__ = ('callback', 'spread', '_last')

    def __init__(self, callback: Callback) -> None:
        self.callback = callback
        self.spread = Spread()
        self._last = array('q')

    def add(self, latency: int) -> None:
        self._last.append(latency)
        if len(self._last) >= _BATCH:
            self.flush()

    def flush(self) -> None:
        """Add what is left."""
        self.spread.add(np.array(self._last, dtype=np.int64))
        self._last = array('q')


class Communications(LinkObserver):
    """Collects callbacks and messages while an imported run is played."""

    def __init__(self) -> None:
        self._executions: dict[int, _Executions] = {}
        self._sent: dict[int, tuple[Publisher, int]] = {}
        self._arrived: dict[tuple[int, int], _Latencies] = {}

    def began(self, run: Execution, message: Publication | None) -> None:
        """Count an execution, and the way of its message."""
        callback = run.callback
        use = self._executions.get(callback.number)
        if use is None:
            use = self._executions[callback.number] = _Executions(callback)
        use.started += 1
        if message is not None and message.publisher is not None and message.time:
            key = (message.publisher.number, callback.number)
            found = self._arrived.get(key)
            if found is None:
                found = self._arrived[key] = _Latencies(callback)
            found.add(run.start - message.time)

    def over(self, run: Execution) -> None:
        """Add how long an execution took."""
        use = self._executions[run.callback.number]
        took = run.end - run.start
        use.shortest = took if not use.finished else min(use.shortest, took)
        use.longest = max(use.longest, took)
        use.finished += 1
        use.busy += took

    def sent(self, message: Publication) -> None:
        """Count a message of its publisher."""
        publisher = message.publisher
        if publisher is not None:
            _, count = self._sent.get(publisher.number, (publisher, 0))
            self._sent[publisher.number] = publisher, count + 1

    def callbacks(self) -> dict[str, dict[str, int]]:
        """Return counts and times (ns) of each recorded callback that ran."""
        return {
            use.callback.label: {
                'executions': use.finished, 'unfinished': use.started - use.finished,
                'busy_ns': use.busy, 'shortest_ns': use.shortest, 'longest_ns': use.longest}
            for use in sorted(self._executions.values(), key=lambda u: u.callback.label)}

    def communications(self) -> list[dict[str, Any]]:
        """Return for each pair of publisher and callback messages, and publication to start."""
        found = []
        for (number, _), latencies in self._arrived.items():
            latencies.flush()
            publisher, sent = self._sent.get(number, (None, 0))
            if publisher is None:
                continue
            found.append({
                'topic': publisher.topic,
                'publisher': publisher.node.name if publisher.node is not None else None,
                'callback': latencies.callback.label, 'sent': sent,
                'arrived': latencies.spread.count, 'latency_ns': latencies.spread.result()})
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
