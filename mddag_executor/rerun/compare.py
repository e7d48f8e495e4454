# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether two runs have published the same: message by message, field by field.

Theory of operation
-------------------
The messages of a topic are compared one by one, in their order. The report of a topic says
where it differs first, and whether only in *timing*: the same messages, but at other times, or
with other stamps in them (fields of type ``builtin_interfaces/Time``).

Floating-point numbers are equal within a tolerance ``x`` if their difference is at most ``x``, or
``x`` times the larger one. NaN equals itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from numbers import Integral, Real
from typing import Any, NamedTuple

from mddag_executor.rerun.inputs import RecordedMessage
from mddag_executor.rerun.message_types import type_name
from mddag_executor.rerun.outputs import Output
from mddag_executor.results.comparisons import TopicDifference
from rclpy.serialization import deserialize_message

CONTENT, TIMING, MISSING = 'content', 'timing', 'missing'


class Difference(NamedTuple):
    """
    How a topic differs.

    :ivar kind: ``content``, ``timing`` (only times differ), or ``missing`` (one side has none).
    :ivar number: which of its messages is the first that differs, from 0.
    :ivar time: the virtual time of that message in this run, ns after its start.
    :ivar field: the first field that differs; empty: when it was published.
    """

    topic: str
    kind: str
    number: int
    time: int
    field: str
    expected: str
    found: str
    messages: int
    expected_messages: int

    def result(self) -> TopicDifference:
        """Return its form in JSON results."""
        return {
            'topic': self.topic, 'kind': self.kind, 'number': self.number, 'time': self.time,
            'field': self.field, 'expected': self.expected, 'found': self.found,
            'messages': self.messages, 'expected_messages': self.expected_messages}

    def line(self) -> str:
        """Return it on one line."""
        counts = ''
        if self.messages != self.expected_messages:
            counts = f'; {self.messages} messages, expected {self.expected_messages}'
        what = self.field or 'the time of publication'
        return (
            f'{self.topic}: {self.kind}, first in message {self.number} at '
            f'{self.time / 1e9:.6f} s: {what} is {self.found}, expected {self.expected}{counts}')


def differences(
    outputs: Iterable[Output], expected: Iterable[RecordedMessage], start: int,
    tolerance: float = 0.0,
) -> list[Difference]:
    """
    Compare the published messages with the expected ones, topic by topic.

    :param start: the virtual time at which the run began.
    """
    topics: dict[str, tuple[list[Output], list[RecordedMessage]]] = {}
    for output in outputs:
        topics.setdefault(output.topic, ([], []))[0].append(output)
    for message in expected:
        topics.setdefault(message.topic, ([], []))[1].append(message)
    every = (_difference(topic, *both, start, tolerance) for topic, both in sorted(topics.items()))
    return [difference for difference in every if difference is not None]


def _difference(
    topic: str, found: Sequence[Output], expected: Sequence[RecordedMessage], start: int,
    tolerance: float,
) -> Difference | None:
    counts = len(found), len(expected)
    timing: Difference | None = None
    for number, (one, other) in enumerate(zip(found, expected)):
        for path, got, wanted, is_time in _fields(one, other, start, tolerance):
            difference = Difference(
                topic, TIMING if is_time else CONTENT, number, one.time - start, path, wanted,
                got, *counts)
            if not is_time:
                return difference
            timing = timing or difference
    if len(found) == len(expected):
        return timing
    if timing is not None:
        return timing._replace(kind=MISSING)
    number = min(counts)
    time = found[number].time if len(found) > number else expected[number].time
    sides = ('nothing', 'there') if len(found) > number else ('a message', 'missing')
    return Difference(
        topic, MISSING, number, time - start, 'it', *sides, *counts)


def _fields(
    one: Output, other: RecordedMessage, start: int, tolerance: float
) -> Iterator[tuple[str, str, str, bool]]:
    """Yield how messages differ: path of the field, both values, whether it is of a time."""
    if other.kind != type_name(one.kind):
        yield 'its type', type_name(one.kind), other.kind, False
    elif one.data != other.data:
        try:
            expected = deserialize_message(other.data, one.kind)
        except Exception:
            yield 'its content', 'a message', 'what does not decode', False
        else:
            yield from _unequal(
                '', deserialize_message(one.data, one.kind), expected, False, tolerance)
    if one.time != other.time:
        got, wanted = (f'{(each.time - start) / 1e9:.6f} s' for each in (one, other))
        yield '', got, wanted, True


def _unequal(
    path: str, a: Any, b: Any, is_time: bool, tolerance: float
) -> Iterator[tuple[str, str, str, bool]]:
    if hasattr(a, 'get_fields_and_field_types'):
        is_time = is_time or type_name(type(a)) == 'builtin_interfaces/msg/Time'
        for name in a.get_fields_and_field_types():
            yield from _unequal(
                f'{path}.{name}' if path else name, getattr(a, name), getattr(b, name),
                is_time, tolerance)
    elif isinstance(a, (str, bytes)) or not hasattr(a, '__len__'):
        if not _same(a, b, tolerance):
            yield path, _shown(a), _shown(b), is_time
    elif len(a) != len(b):
        yield f'the length of {path}', _shown(len(a)), _shown(len(b)), is_time
    elif not hasattr(a, 'tobytes') or a.tobytes() != b.tobytes():
        for i, (x, y) in enumerate(zip(a, b)):
            yield from _unequal(f'{path}[{i}]', x, y, is_time, tolerance)


def _same(a: Any, b: Any, tolerance: float) -> bool:
    if a == b or a != a and b != b:  # only NaN is not itself
        return True
    if isinstance(a, Integral) or not isinstance(a, Real):
        return False
    return bool(abs(a - b) <= tolerance * max(1.0, abs(a), abs(b)))


def _shown(value: Any) -> str:
    text = repr(value.item() if hasattr(value, 'item') else value)
    return text if len(text) <= 60 else f'{text[:57]}...'
