# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Executions of callbacks and transport of messages in an imported recording."""

from __future__ import annotations

from typing import Any

from mddag_executor.recording.tables import Recording
from mddag_executor.replay.spread import spread, sum_of
import numpy as np


def recorded_callbacks(recording: Recording) -> dict[str, dict[str, int]]:
    """Return counts and times (ns) of each recorded callback that ran."""
    table, found = recording.executions, {}
    for number in np.unique(table['callback']).tolist():
        mine = table[table['callback'] == number]
        ended = mine[mine['end'] >= 0]
        took = ended['end'] - ended['start']
        found[recording.who.name(number), number] = {
            'executions': len(took), 'unfinished': len(mine) - len(took),
            'busy_ns': sum_of(took), 'shortest_ns': int(took.min()) if len(took) else 0,
            'longest_ns': max(0, int(took.max(initial=0)))}
    return {label: each for (label, _), each in sorted(found.items(), key=lambda item: item[0])}


def communications(recording: Recording) -> list[dict[str, Any]]:
    """Return by publisher and callback the messages, and times from publication to start."""
    table, messages, found = recording.executions, recording.publications, []
    started = np.flatnonzero(table['message'] >= 0)
    message = messages[table['message'][started]]
    known = (message['publisher'] >= 0) & (message['time'] > 0)
    started, message = started[known], message[known]
    pairs = np.column_stack((message['publisher'], table['callback'][started]))
    latency = table['start'][started] - message['time']
    sent = dict(zip(*(each.tolist() for each in np.unique(
        messages['publisher'], return_counts=True))))
    different, first, which = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    for number in np.argsort(first).tolist():
        publisher_number, callback = different[number].tolist()
        publisher = recording.who.every_publisher[publisher_number]
        found.append({
            'topic': publisher.topic,
            'publisher': publisher.node.name if publisher.node is not None else None,
            'callback': recording.who.name(callback), 'sent': sent[publisher_number],
            'arrived': int((which.ravel() == number).sum()),
            'latency_ns': spread(latency[which.ravel() == number])})
    return sorted(found, key=lambda each: (each['topic'], each['callback']))
