# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What is printed for people."""

from __future__ import annotations

import io

from hypothesis import given, strategies
from mddag_executor.cli.text import format_ns, one_line, printable, Progress
from msg_graph import errors
import pytest


@pytest.mark.parametrize(('ns', 'text'), [
    (0, '0 ns'),
    (999, '999 ns'),
    (1_000, '1 us'),
    (12_345, '12.35 us'),
    (999_960, '1.000 ms'),
    (999_940, '999.9 us'),
    (100_000_000, '100 ms'),
    (100_040_000, '100.0 ms'),
    (100_060_000, '100.1 ms'),
    (30_500_000, '30.5 ms'),
    (1_500_000_000, '1.5 s'),
    (20_000_000_000, '20 s'),
    (123_456_789_012_345, '123457 s'),
    (-1_500_000, '-1.5 ms'),
])
def test_times(ns: int, text: str) -> None:
    assert format_ns(ns) == text


@given(strategies.integers(-10**15, 10**15))
def test_times_are_right_to_four_digits(ns: int) -> None:
    number, unit = format_ns(ns).split()
    value = float(number) * {'ns': 1, 'us': 1e3, 'ms': 1e6, 's': 1e9}[unit]
    assert value == pytest.approx(ns, rel=5.01e-4)
    assert abs(float(number)) < 1000 or unit == 's'


@given(strategies.text())
def test_no_control_character_reaches_the_terminal(text: str) -> None:
    for line in (printable(text), one_line(text)):
        assert line.isprintable()
    if text.isprintable():
        assert printable(text) == text


class Terminal(io.StringIO):

    def isatty(self) -> bool:
        return True


class Clock:

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_progress_waits_two_seconds() -> None:
    stream, clock = Terminal(), Clock()
    with Progress('simulating', 10, stream=stream, clock=clock) as progress:
        clock.now += 1.9
        progress.update(3)
        assert stream.getvalue() == ''
        clock.now += 0.2
        progress.update(4, 'run\x1b 4')
        assert stream.getvalue() == '\rsimulating: 40 % run\\x1b 4'
        progress.update(5)
        assert '50 %' not in stream.getvalue(), 'more often than five times a second'
        clock.now += 0.2
        progress.update(20)
        assert '100 %' in stream.getvalue()
    assert stream.getvalue().endswith('\r'), 'the line is wiped'


def test_both_packages_make_names_harmless_alike() -> None:
    every = ''.join(map(chr, range(0x11000))) + '\U000e0001\U0010ffff'
    assert printable(every) == errors.printable(every)
    assert printable(every).isprintable()
