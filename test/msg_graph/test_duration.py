# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Times as people write them."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from msg_graph import DurationError, format_duration, parse_duration
from msg_graph.duration import DAY, exact_duration, whole_us
import pytest


@pytest.mark.parametrize('text, ns', [
    ('100ms', 100_000_000),
    ('20 us', 20_000),
    ('1.5s', 1_500_000_000),
    ('1500ns', 1_500),
    ('2min', 120_000_000_000),
    ('20µs', 20_000),
    ('20μs', 20_000),
    ('.5ms', 500_000),
    ('5.ms', 5_000_000),
    ('+1ms', 1_000_000),
    (' 1ms\t', 1_000_000),
    ('33.333333333ms', 33_333_333),
    ('1us', 1_000),
    ('86400s', 86_400_000_000_000),
    ('0.1s', 100_000_000),
])
def test_reads_times(text: str, ns: int) -> None:
    assert parse_duration(text) == ns


@pytest.mark.parametrize('text, says', [
    ('100', 'has no unit'),
    ('1.5', "'1.5ms'"),
    ('5 sec', "unknown unit 'sec'"),
    ('100 MS', "unknown unit 'MS'"),
    ('1h', "unknown unit 'h'"),
    ('-5ms', 'is negative'),
    ('-0ms', 'is negative'),
    ('0ms', 'too short'),
    ('999ns', 'at least 1us'),
    ('1ns', 'at least 1us'),
    ('86401s', 'at most 86400s'),
    ('999999999999999999min', 'at most 86400s'),
    ('nan', 'is not a time'),
    ('inf', 'is not a time'),
    ('nanms', 'is not a time'),
    ('1e9s', 'is not a time'),
    ('1_000ms', 'is not a time'),
    ('1,5s', 'is not a time'),
    ('soon', 'is not a time'),
    ('', 'is not a time'),
    ('ms', 'is not a time'),
    ('.ms', 'is not a time'),
    ('١ms', 'is not a time'),
    ('1ms 2us', 'is not a time'),
    ('1\nms', 'is not a time'),
    ('9' * 100 + 's', 'is not a time'),
])
def test_refuses_the_rest(text: str, says: str) -> None:
    with pytest.raises(DurationError) as caught:
        parse_duration(text)
    assert says in str(caught.value)
    assert caught.value.problem and caught.value.remedy
    assert isinstance(caught.value, ValueError)
    assert str(caught.value).isprintable()


@given(st.text())
def test_text_is_a_time_or_a_duration_error(text: str) -> None:
    try:
        assert 1_000 <= parse_duration(text) <= 86_400 * 10 ** 9
    except DurationError as error:
        assert str(error).isprintable()


@pytest.mark.parametrize('ns, text', [
    (0, '0ns'), (999, '999ns'), (1_000, '1us'), (1_500, '1.5us'), (100_000_000, '100ms'),
    (1_234_567, '1.235ms'), (60_000_000_000, '60s'), (-1_500_000, '-1.5ms'),
])
def test_formats_times(ns: int, text: str) -> None:
    assert format_duration(ns) == text


@given(st.integers(1, 86_400_000))
def test_format_reads_back(us: int) -> None:
    exact = parse_duration(f'{us}us')
    assert abs(parse_duration(format_duration(exact)) - exact) <= exact * 0.0005


@pytest.mark.parametrize('ns', [0, 1, 999, 1_234_567_891, DAY - 1, DAY])
def test_an_exact_text_reads_back(ns: int) -> None:
    assert parse_duration(exact_duration(ns), minimum_ns=0) == ns


@pytest.mark.parametrize('ns', [-1, -2**63, DAY + 1, 2**63 - 1])
def test_what_no_declaration_can_say_has_an_exact_text_too(ns: int) -> None:
    """Traces say such things; the reader of the text then says what is wrong."""
    assert exact_duration(ns) == f'{ns}ns'


@pytest.mark.parametrize(('ns', 'text'), [
    (1, '1ns'), (999, '999ns'), (1_000, '1us'), (1_001, '1.001us'), (1_234_567, '1234.567us'),
    (1_234_000, '1.234ms'), (1_500_000_000, '1.5s'), (DAY, '86400s')])
def test_exact_ones_are_short(ns: int, text: str) -> None:
    assert exact_duration(ns) == text
    assert parse_duration(text, minimum_ns=1) == ns


def test_deadlines_are_whole_us() -> None:
    assert [whole_us(ns) for ns in (0, 1, 1_000, 1_000.5, 1_001)] == [
        1_000, 1_000, 1_000, 2_000, 2_000]
    assert whole_us(float('inf')) == whole_us(DAY + 1) == DAY
