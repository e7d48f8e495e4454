# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verbs `replay` and `explain`: damaged and piped traces, overheads, names of sinks."""

import json
from pathlib import Path

import pytest

from ..report.runs import by_hand, GRAPH
from ..sources.recorded import MS


@pytest.fixture
def trace(tmp_path):
    """Give a trace of three jobs; the third is 2 ms late, its first vertex took 6 ms."""
    return by_hand(tmp_path / 'run.mcap', undeclared=False)


def test_overheads(trace, call):
    # the second callback was dispatched 1 ms after it was ready, though its worker was free
    for options, longest in ((), 10), (('recorded',), 10), (('none',), 9), (('2ms',), 13):
        result = call('replay', trace, '--reschedule', '--json', '-',
                      *(['--overheads', *options] if options else [])).result
        sink = result['dags']['/driver']['sinks']['/filter:run']
        assert sink['response_ns']['max'] == longest * MS
        assert result['overheads']['dispatch_median_ns'] == 0


def test_a_truncated_trace_gives_what_is_there(trace, call):
    data = trace.read_bytes()
    trace.write_bytes(data[:-40])
    status, out, err = call('replay', trace)
    assert (status, err.count('\n')) == (0, 1) and '3 results due' in out
    assert err.startswith(f'warning: {trace}: the summary at the end is damaged or missing: ')
    trace.write_bytes(data[:100])
    status, _, err = call('replay', trace)
    assert status == 2 and err.startswith(f'error: {trace}: it is damaged (')
    assert err.endswith('nothing of a run is left in it: take another copy of the file, or record '
                        'the run again\n')


def test_standard_input(trace, call):
    assert call('replay', '-', stdin=trace.read_bytes()) == call('replay', trace, '--from', '0s')
    status, out, err = call('replay', '-', '--json', '-', stdin=trace.read_bytes()[:-40])
    assert err.startswith('warning: <stdin>: the summary')
    assert json.loads(out)['recording']['trace'] == '<stdin>'
    assert call('replay', '-', stdin=b'nonsense') == (
        2, '', 'error: <stdin>: is not an MCAP file: give a trace written by this program or '
        'another MCAP recording\n')
    assert call('replay', trace, '-', stdin=GRAPH)[::2] == (0, '')


def test_a_sink_is_named_as_tables_do_or_by_a_unique_end(call, folder):
    Path('g.yaml').write_text('mddag: 1\nworkers: 1\nnodes:\n' + ''.join(
        f'  - {{node: /{name}, callbacks: [{{name: t, timer: 10ms, deadline: {ms}ms, '
        'execution_time: 2ms}]}\n' for name, ms in (('a/one', 1), ('b/two', 2))))
    assert call('simulate', 'g.yaml', '--duration', '50ms', '--trace', 'r.mcap').returncode == 0
    assert '  one:t  ' in call('replay', 'r.mcap').stdout
    for name in ('one:t', '/a/one:t', '/one:t', 'ne:t'):
        done = call('explain', 'r.mcap', '--sink', name, '--job', '1')
        assert (done.returncode, done.stderr) == (0, '')
        assert done.stdout.startswith('Job 1 of one:t: late by ')
    for name, says in ((':t', "':t' fits '/a/one:t', '/b/two:t': write more of the name"),
                       ('ona:t', "there is no sink 'ona:t': did you mean '/a/one:t'?")):
        assert call('explain', 'r.mcap', '--sink', name) == (2, '', f'error: --sink: {says}\n')


def test_a_run_in_which_nothing_was_due_is_not_judged(tmp_path, call):
    """The status is 2, as with the declaration of another robot."""
    graph, trace = tmp_path / 'graph.yaml', tmp_path / 'run.mcap'
    graph.write_text(
        'mddag: 1\nnodes:\n  - node: /n\n    callbacks:\n'
        '      - {name: tick, timer: 10s, publishes: [/a], execution_time: 50ms}\n'
        '      - {name: done, subscription: /a, deadline: 9s, execution_time: 50ms}\n')
    assert call('simulate', graph, '--duration', '20ms', '--trace', trace).returncode == 0
    for verb in ('replay', 'explain'):
        done = call(verb, trace)
        assert done.returncode == 2 and done.stderr.splitlines()[-1].startswith(
            f'error: {trace}: no job was due at any sink, so no deadline was judged: '), done
    assert call('replay', trace, '--fail-on-miss').returncode == 1


def test_a_timer_that_fired_once_before_the_judged_part_is_no_difference(call, folder):
    Path('g.yaml').write_text('mddag: 1\nnodes:\n' + ''.join(
        f'  - {{node: /{name}, callbacks: [{{name: t, timer: 10ms, {more}deadline: 10ms, '
        'execution_time: 1ms}]}\n'
        for name, more in (('up', 'once: true, '), ('works', ''))))
    assert call('simulate', 'g.yaml', '--duration', '1s', '--trace', 'r.mcap').returncode == 0
    for part in ('0s',), ('500ms',), ('500ms', '--to', '800ms'):
        assert call('replay', 'r.mcap', '--json', '-', '--from', *part).result['drift'] == []
