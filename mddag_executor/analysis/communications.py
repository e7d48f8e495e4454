# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Executions of callbacks and transport of messages, of a recording without jobs as well."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mddag_executor.analysis.spread import spread_of, sum_of
from mddag_executor.recording.joins import different, rows_by
from mddag_executor.recording.recording import Recording
import numpy as np

if TYPE_CHECKING:
    from mddag_executor.results.replays import Communication, RecordedCallback


def recorded_callbacks(recording: Recording) -> dict[str, RecordedCallback]:
    """Return by label counts and times (ns) of the recorded callbacks that ran."""
    start, end, piece = (recording.executions[name] for name in ('start', 'end', 'piece'))
    numbers, index = different(recording.executions['callback'])
    labels, which = recording.labels(numbers)
    found: dict[str, RecordedCallback] = {}
    for label, mine in zip(labels, rows_by(which[index], len(labels))):
        ended = mine[end[mine] >= 0]
        took = end[ended] - start[ended]
        found[label] = {
            # a coroutine that waited is one execution
            'executions': int((piece[ended] == 0).sum()), 'unfinished': len(mine) - len(took),
            'busy_ns': sum_of(took), 'shortest_ns': int(took.min()) if len(took) else 0,
            'longest_ns': max(0, int(took.max(initial=0)))}
    return found


def communications(recording: Recording) -> list[Communication]:
    """Return by publisher and callback the messages, and times from publication to start."""
    table, messages = recording.executions, recording.publications
    found: list[Communication] = []
    started = np.flatnonzero(table['message'] >= 0)
    message = messages[['publisher', 'time']][table['message'][started]]
    known = (message['publisher'] >= 0) & (message['time'] > 0)
    started, message = started[known], message[known]
    publishers, publisher_of = different(message['publisher'])
    pairs, which = different(
        recording.callbacks()[1][started].astype(np.int64) * len(publishers) + publisher_of)
    latency = table['start'][started] - message['time']
    sent = dict(zip(*(each.tolist() for each in np.unique(
        messages['publisher'], return_counts=True))))
    for mine in sorted(rows_by(which, len(pairs)), key=lambda each: int(each[0])):
        number = int(message['publisher'][mine[0]])
        publisher = recording.names.publishers[number]
        found.append({
            'topic': publisher.topic,
            'publisher': publisher.node.name if publisher.node is not None else None,
            'callback': recording.names.name(int(table['callback'][started[mine[0]]])),
            'sent': sent[number], 'arrived': len(mine), 'latency_ns': spread_of(latency[mine])})
    return sorted(found, key=lambda each: (each['topic'], each['callback']))
