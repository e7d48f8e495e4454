# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Times as text (``100ms``, ``20 us``, ``1.5s``) to integer nanoseconds and back."""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal, ROUND_HALF_EVEN
import re

from msg_graph.errors import quoted, ValueProblem

MICROSECOND = 1_000
MILLISECOND = 1_000_000
SECOND = 1_000_000_000
DAY = 86_400 * SECOND

UNITS = {
    'ns': 1,
    'us': MICROSECOND,
    'µs': MICROSECOND,  # micro sign
    'μs': MICROSECOND,  # Greek letter mu
    'ms': MILLISECOND,
    's': SECOND,
    'min': 60 * SECOND,
}
_DURATION = re.compile(
    r'[ \t]*(?P<number>[0-9]{1,18}(?:\.[0-9]{0,18})?|\.[0-9]{1,18})[ \t]*'
    r'(?P<unit>[^\W\d_]*)[ \t]*')


class DurationError(ValueProblem):
    """A text that is not a valid time."""


def parse_duration(
    text: str, *, minimum_ns: int = MICROSECOND, maximum_ns: int = DAY
) -> int:
    """
    Return the nanoseconds in a text such as ``100ms``, ``20 us`` or ``1.5s``.

    Units are ns, us (or µs), ms, s and min; zero needs none. Fractions of a nanosecond are rounded
    to the nearest.

    :param minimum_ns: the least allowed time, ns.
    :param maximum_ns: the longest allowed time, ns.
    :raises DurationError: (a ``ValueError``) no number, no unit or an unknown one, or a time
        outside of the bounds.
    """
    match = _DURATION.fullmatch(text)
    if match is None or match['unit'] not in ('', *UNITS):
        raise DurationError(*(
            (f'{quoted(text)} is a rate', "write the time between two, as '100ms' for 10 Hz")
            if match is not None and match['unit'].lower() == 'hz' else
            (f'{quoted(text)} is not a time',
             "write a number and a unit (ns, us, ms, s, min), as '100ms'")))
    number = Decimal(match['number'])
    if number and not match['unit']:
        raise DurationError(
            f'{quoted(text)} has no unit',
            f"add one, as '{match['number']}ms' or '{match['number']}s' (ns, us, ms, s, min)")
    exact = number * UNITS[match['unit'] or 's']    # zero needs no unit
    value = int(exact.to_integral_value(ROUND_HALF_EVEN))
    if not minimum_ns <= value <= maximum_ns:
        raise DurationError(
            f'{quoted(text)} is too {"short" if value < minimum_ns else "long"}',
            f'write {format_duration(minimum_ns)} to {format_duration(maximum_ns)}')
    return value


def format_duration(ns: int) -> str:
    """Return a time for people, in the largest unit that fits, to three decimals at most."""
    return _in_first_unit(ns, lambda factor: abs(ns) >= factor)


def round_up_deadline(ns: float) -> int:
    """Round a time up to a valid deadline: whole us, at least one, at most a day."""
    return max(1, -int(-min(DAY, ns) // 1000)) * 1000


def exact_duration(ns: int) -> str:
    """
    Return exactly this time in the largest of s, ms, us and ns with three decimals at most.

    ``parse_duration`` reads it back if the time is valid.
    """
    return _in_first_unit(ns, lambda factor: factor <= ns <= DAY and ns % (factor // 1000) == 0)


def _in_first_unit(ns: int, fits: Callable[[int], bool]) -> str:
    for unit in ('s', 'ms', 'us'):
        if fits(UNITS[unit]):
            return f'{ns / UNITS[unit]:.3f}'.rstrip('0').rstrip('.') + unit
    return f'{ns}ns'
