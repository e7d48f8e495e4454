# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the callbacks of an imported recording did, declared or not, and how messages went."""

from __future__ import annotations

from collections import Counter, defaultdict
from typing import Any

from mddag_executor.replay.entities import Entities
from mddag_executor.replay.happenings import Batch, BEGAN, Observer, RAN, SENT
from mddag_executor.replay.spread import Spread
import numpy as np


class Communications(Observer):
    """Collects callbacks and messages while an imported run is played."""

    def __init__(self, who: Entities) -> None:
        self._who = who
        # by callback how often it began, and how long it ran; by publisher how often it sent,
        # and by both how long messages took to the start of the callback
        self._began: Counter[int] = Counter()
        self._ran: defaultdict[int, Spread] = defaultdict(Spread)
        self._sent: Counter[int] = Counter()
        self._arrived: defaultdict[tuple[int, int], Spread] = defaultdict(Spread)

    def take(self, batch: Batch) -> None:
        """Count executions and messages, and add up their times."""
        began, ran = batch.columns(BEGAN), batch.columns(RAN)
        self._began.update(began[:, 0].tolist())
        self._sent.update(batch.columns(SENT)[:, 0].tolist())
        for callback in np.unique(ran[:, 0]).tolist():
            mine = ran[ran[:, 0] == callback]
            self._ran[callback].add(mine[:, 7] - mine[:, 6])
        began = began[began[:, 5] >= 0]
        pairs, first, which = np.unique(
            began[:, [5, 0]], axis=0, return_index=True, return_inverse=True)
        for number in np.argsort(first).tolist():
            mine = began[which.ravel() == number]
            self._arrived[tuple(pairs[number].tolist())].add(mine[:, 3] - mine[:, 6])

    def callbacks(self) -> dict[str, dict[str, int]]:
        """Return counts and times (ns) of each recorded callback that ran."""
        found = {}
        for label, number in sorted((self._who.name(each), each) for each in self._began):
            took = self._ran[number]
            found[label] = {
                'executions': took.count, 'unfinished': self._began[number] - took.count,
                'busy_ns': took.total, 'shortest_ns': took.least if took.count else 0,
                'longest_ns': max(0, took.greatest)}
        return found

    def communications(self) -> list[dict[str, Any]]:
        """Return for each pair of publisher and callback messages, and publication to start."""
        found = []
        for (number, callback), latencies in self._arrived.items():
            if number not in self._sent:
                continue
            publisher = self._who.every_publisher[number]
            found.append({
                'topic': publisher.topic,
                'publisher': publisher.node.name if publisher.node is not None else None,
                'callback': self._who.name(callback), 'sent': self._sent[number],
                'arrived': latencies.count, 'latency_ns': latencies.result()})
        return sorted(found, key=lambda each: (each['topic'], each['callback']))
