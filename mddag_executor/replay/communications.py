# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What can be said of an imported recording without a graph: callbacks and communication."""

from __future__ import annotations

from array import array
from typing import Any

from mddag_executor.replay.entities import Callback, Publisher
from mddag_executor.replay.linker import Execution, LinkObserver, Publication
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
