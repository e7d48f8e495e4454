# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A run for Foxglove, Lichtblick and PlotJuggler: an MCAP file of JSON messages, and a layout.

Theory of operation
-------------------
Topics are `/workers/N` (a message when a callback starts, with its name, and one when the worker
is idle again), `/sinks/NODE/CALLBACK` (one for each job, when it completed or should have), and
`/misses`, whose schema is Foxglove's own, `foxglove.Log`, so that its log panel shows it.  Others
have a schema of this project.  In names of topics only letters, digits, `_`, `-` and `/` stand, as
message paths want it.

Rows come when executions end and jobs are judged; messages are written in the order of time as far
as ``MOST_ORDERED`` of them can be held back.
"""

from __future__ import annotations

import heapq
import json
import re
from typing import Any, BinaryIO

from mcap.writer import CompressionType, Writer
from mddag_executor.report.export import JobRow, MOST_ORDERED, Ran, Target
from mddag_executor.report.text import format_ns, printable

_WARNING, _ERROR = 3, 4
_NUMBER, _TEXT = {'type': 'number'}, {'type': 'string'}
_LOG = {
    'title': 'foxglove.Log', 'type': 'object', 'properties': {
        'timestamp': {'type': 'object', 'title': 'time', 'properties': {
            'sec': {'type': 'integer', 'minimum': 0},
            'nsec': {'type': 'integer', 'minimum': 0, 'maximum': 999_999_999}}},
        'level': {'title': 'foxglove.LogLevel', 'oneOf': [
            {'title': name, 'const': i} for i, name in enumerate(
                ('UNKNOWN', 'DEBUG', 'INFO', 'WARNING', 'ERROR', 'FATAL'))]},
        'message': _TEXT, 'name': _TEXT, 'file': _TEXT,
        'line': {'type': 'integer', 'minimum': 0}}}
_WORKER = {
    'title': 'mddag.Worker', 'type': 'object', 'properties': {
        'state': _TEXT, 'busy': _NUMBER, 'job': _NUMBER, 'waited_ms': _NUMBER, 'late': _NUMBER}}
_SINK = {
    'title': 'mddag.Sink', 'type': 'object', 'properties': {
        'job': _NUMBER, 'verdict': _TEXT, 'missed': _NUMBER, 'deadline_ms': _NUMBER,
        'response_ms': _NUMBER, 'margin_ms': _NUMBER}}


class FoxgloveTarget(Target):
    """
    Writes a run as an MCAP file for Foxglove.

    :ivar layout: a layout that shows it, once the run is over.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._writer = Writer(file, compression=CompressionType.ZSTD)
        self._writer.start('', 'mddag_executor')
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._topics: dict[str, str] = {}
        # (time, order, channel, message)
        self._held: list[tuple[int, int, int, bytes]] = []
        self._count = 0

    def execution(self, ran: Ran) -> None:
        """Write when a worker began to run a callback, and when it was idle again."""
        row = ran.row
        name = str(row.worker) if row.worker >= 0 else 'spare'
        late = int(row.slack_ns is not None and row.slack_ns < 0)
        begin: dict[str, Any] = {'state': printable(row.vertex), 'busy': 1, 'late': late}
        if row.job is not None:
            begin['job'] = row.job
        if row.waiting_ns is not None:
            begin['waited_ms'] = row.waiting_ns / 1e6
        channel = self._channel(f'/workers/{name}', _WORKER)
        self._put(row.start_ns, channel, begin)
        self._put(row.end_ns, channel, {'state': 'idle', 'busy': 0, 'late': 0})

    def verdict(self, row: JobRow, vertex: int) -> None:
        """Write what came of a job at a sink."""
        message: dict[str, Any] = {
            'job': row.job, 'verdict': row.verdict, 'missed': int(row.verdict != 'in_time'),
            'deadline_ms': (row.deadline_ns - row.release_ns) / 1e6}
        if row.response_ns is not None and row.slack_ns is not None:
            message['response_ms'] = row.response_ns / 1e6
            message['margin_ms'] = row.slack_ns / 1e6
        time = row.deadline_ns if row.completed_ns is None else row.completed_ns
        self._put(time, self._channel(self._topic(row.sink), _SINK), message)
        if row.verdict != 'in_time':
            self._miss(row, max(0, time))

    def _miss(self, row: JobRow, time: int) -> None:
        late = '' if row.slack_ns is None else f' by {format_ns(-row.slack_ns, 3)}'
        level = _WARNING if row.completed_ns is not None else _ERROR
        self._put(time, self._channel('/misses', _LOG), {
            'timestamp': {'sec': time // 10 ** 9, 'nsec': time % 10 ** 9}, 'level': level,
            'message': printable(f'job {row.job} of {row.dag} {row.verdict}{late}'),
            'name': printable(row.sink), 'file': '', 'line': 0})

    def _topic(self, sink: str) -> str:
        """Return the topic of a sink; different ones stay different."""
        if sink not in self._topics:
            topic = '/sinks/' + re.sub('[^A-Za-z0-9_/-]', '_', sink.replace(':', '/').strip('/'))
            while topic in self._topics.values():
                topic += '_'
            self._topics[sink] = topic
        return self._topics[sink]

    def _channel(self, topic: str, schema: dict[str, Any]) -> int:
        """Return the channel of a topic."""
        if topic not in self._channels:
            name = schema['title']
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(
                    name, 'jsonschema', json.dumps(schema).encode())
            self._channels[topic] = self._writer.register_channel(
                topic, 'json', self._schemas[name])
        return self._channels[topic]

    def _put(self, time: int, channel: int, message: dict[str, Any]) -> None:
        self._count += 1
        heapq.heappush(self._held, (
            max(0, time), self._count, channel, json.dumps(message).encode()))
        if len(self._held) > MOST_ORDERED:
            self._write(*heapq.heappop(self._held))

    def _write(self, time: int, count: int, channel: int, data: bytes) -> None:
        self._writer.add_message(channel, time, data, time, count & 0xFFFFFFFF)

    def finish(self) -> None:
        """Write what is left, and the summary."""
        self._channel('/misses', _LOG)      # the layout shows it, also where there are none
        for held in sorted(self._held):
            self._write(*held)
        self._writer.finish()       # type: ignore[no-untyped-call]

    @property
    def layout(self) -> dict[str, Any]:
        """Return a layout: workers above, responses and margins in the middle, misses below."""
        workers = sorted(
            (topic for topic in self._channels if topic.startswith('/workers/')),
            key=lambda topic: (len(topic), topic))
        sinks = list(self._topics.values())
        return {
            'configById': {
                'StateTransitions!workers': {'isSynced': True, 'paths': [
                    {'value': f'{topic}.state', 'label': topic, 'timestampMethod': 'receiveTime'}
                    for topic in workers]},
                'Plot!responses': _plot('Response times, ms', sinks, 'response_ms'),
                'Plot!margins': _plot('Margins, ms', sinks, 'margin_ms'),
                'RosOut!misses': {
                    'topicToRender': '/misses', 'minLogLevel': 1, 'searchTerms': []}},
            'globalVariables': {}, 'userNodes': {}, 'playbackConfig': {'speed': 1},
            'layout': {
                'direction': 'column', 'splitPercentage': 40,
                'first': 'StateTransitions!workers',
                'second': {
                    'direction': 'column', 'splitPercentage': 65,
                    'first': {'direction': 'row', 'first': 'Plot!responses',
                              'second': 'Plot!margins', 'splitPercentage': 50},
                    'second': 'RosOut!misses'}}}


def _plot(title: str, topics: list[str], field: str) -> dict[str, Any]:
    return {
        'foxglovePanelTitle': title, 'isSynced': True, 'xAxisVal': 'timestamp', 'showLegend': True,
        'legendDisplay': 'left', 'paths': [
            {'value': f'{topic}.{field}', 'label': topic.removeprefix('/sinks/'), 'enabled': True,
             'timestampMethod': 'receiveTime'} for topic in topics]}
