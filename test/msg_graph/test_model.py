# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Execution times, durations, longest paths and load; look-ups by name."""

from hypothesis import assume, given
from hypothesis import strategies as st
from msg_graph import DurationError, ExecutionTime, format_duration, loads, model, parse_duration
from msg_graph.duration import DAY, exact_duration
import pytest
import yaml

from .brute import all_violations, as_yaml
from .helpers import graph
from .random_declarations import declarations


def test_draws_between_the_quantiles():
    time = ExecutionTime((100, 200, 400), (0.0, 50.0, 100.0))
    assert [time.draw(u) for u in (0.0, 0.25, 0.5, 0.75, 1.0)] == [100, 150, 200, 300, 400]
    assert time.mean_ns == 225
    for u in (-0.1, 1.1, float('nan'), float('inf')):
        with pytest.raises(ValueError):
            time.draw(u)


@given(
    st.lists(st.tuples(st.integers(0, 10 ** 9), st.floats(0, 100)), min_size=1, max_size=9,
             unique_by=lambda pair: pair[1]))
def test_mean_is_that_of_the_draws(pairs):
    percent = sorted(share for _, share in pairs)
    time = ExecutionTime(tuple(sorted(ns for ns, _ in pairs)), tuple(percent))
    steps = 2_000
    drawn = [time.draw((i + 0.5) / steps) for i in range(steps)]
    assert drawn == sorted(drawn)
    assert all(time.quantiles_ns[0] <= ns <= time.quantiles_ns[-1] for ns in drawn)
    spread = time.quantiles_ns[-1] - time.quantiles_ns[0]
    assert abs(sum(drawn) / steps - time.mean_ns) <= 1 + spread * len(pairs) / steps


def test_unknown_where_an_execution_time_is_missing():
    dag = graph("""
        - node: /n
          callbacks:
            - {name: t, timer: 10ms, publishes: [/a], execution_time: 1ms}
            - {name: s, subscription: /a, deadline: 1ms}
    """).dags[0]
    assert model.mean_execution_times(dag) is None
    assert model.load_of(dag) is None


@given(declarations(), st.data())
def test_path_lengths_are_those_of_all_paths(specs, data):
    assume(not all_violations(specs))
    for dag in loads(yaml.safe_dump(as_yaml(specs))).dags:
        count = len(dag.vertices)
        weights = data.draw(st.lists(st.integers(0, 9), min_size=count, max_size=count))

        def longest(i, dag=dag, weights=weights):
            return weights[i] + max(map(longest, dag.vertices[i].successors), default=0)

        assert max(model.path_lengths(dag, weights)) == longest(dag.source)


@pytest.mark.parametrize(('text', 'ns'), [
    ('100ms', 100_000_000), ('20 us', 20_000), ('1.5s', 1_500_000_000), ('1500ns', 1_500),
    ('2min', 120_000_000_000), ('20µs', 20_000), ('20μs', 20_000), ('.5ms', 500_000),
    ('5.ms', 5_000_000), (' 1ms\t', 1_000_000), ('33.333333333ms', 33_333_333), ('1us', 1_000)])
def test_reads_times(text, ns):
    assert parse_duration(text) == ns


@pytest.mark.parametrize(('text', 'says'), [
    ('100', 'has no unit'), ('0ms', 'too short'), ('999ns', 'is too short: write 1us to 86400s'),
    ('86401s', 'is too long: write 1us to 86400s'), ('999999999999999999min', 'is too long'),
    *((text, 'is not a time: write a number and a unit (ns, us, ms, s, min)') for text in (
        '-5ms', '1h', 'nanms', '1e9s', '', '.ms', '١ms', '1ms 2us', '1\nms', '9' * 100 + 's'))])
def test_refuses_the_rest(text, says):
    with pytest.raises(DurationError) as caught:
        parse_duration(text)
    assert says in str(caught.value) and isinstance(caught.value, ValueError)


@given(st.text())
def test_text_is_a_time_or_a_duration_error(text):
    try:
        assert 1_000 <= parse_duration(text) <= DAY
    except DurationError as error:
        assert str(error).isprintable()


@pytest.mark.parametrize(('ns', 'shown', 'exact'), [
    (0, '0ns', '0ns'), (1, '1ns', '1ns'), (999, '999ns', '999ns'), (1_000, '1us', '1us'),
    (1_001, '1.001us', '1.001us'), (100_000_000, '100ms', '100ms'), (DAY, '86400s', '86400s'),
    (1_234_567, '1.235ms', '1234.567us'), (1_234_000, '1.234ms', '1.234ms'),
    # Times that no declaration can have are texts as well: the reader says what is wrong.
    (-1_500_000, '-1.5ms', '-1500000ns'), (DAY + 1, '86400s', f'{DAY + 1}ns'),
    (2**63 - 1, '9223372036.855s', f'{2**63 - 1}ns')])
def test_formats_times(ns, shown, exact):
    assert (format_duration(ns), exact_duration(ns)) == (shown, exact)


@given(st.integers(1, 86_400_000))
def test_format_reads_back(us):
    exact = parse_duration(f'{us}us')
    assert parse_duration(exact_duration(exact)) == exact
    assert abs(parse_duration(format_duration(exact)) - exact) <= exact * 0.0005
