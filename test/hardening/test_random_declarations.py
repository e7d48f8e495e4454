# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Random declarations, and simulated recordings of them, through every verb that reads them.

Each verb does its work, or refuses it in one line; there is no traceback.

Half of them are those of `test/msg_graph` with more keys, half come from `mddag generate` and are
then damaged. `HARDENING_EXAMPLES=10000` draws that many of each.
"""

import os
from pathlib import Path
import tempfile

from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
import pytest
import yaml

from ..msg_graph.brute import as_yaml
from ..msg_graph.random_declarations import declarations
from .verbs import run

EXAMPLES = int(os.environ.get('HARDENING_EXAMPLES', '30'))
TIMES = st.sampled_from(
    ['1us', '7us', '1ms', '10ms', '33.3ms', '999.999ms', '1s', '86400s', '1440min', '0.5ms'])
TIME = st.sampled_from(['1us', '3us', '1ms', {'quantiles_us': [1, 2, 3]}])
MORE = {
    'deadline': TIMES | st.just('none'), 'timer': TIMES, 'period': TIMES,
    'once': st.booleans(), 'sporadic': st.booleans(), 'may_publish': st.none(),
    'on_late': st.sampled_from(['demote', 'continue']),
    'keep': st.sampled_from(['newest', 'all']), 'importance': st.sampled_from(['high', 'low']),
    'tolerate': st.sampled_from(['1 of 100', '2 of 3']),
    'max_active_jobs': st.sampled_from([1, 2, 10**6]),
    'release_from': st.sampled_from(['arrival', 'header_stamp', 'source_timestamp']),
    'group': st.sampled_from(['g', 'h', 'reentrant'])}
EXTREME = {
    'execution_time': ['0ns', '86400s', {'quantiles_us': [0, 10**10]}],
    'tolerate': ['0 of 1', '5'], 'max_active_jobs': [2**31, 10**30, 0], 'may_publish': [[]]}
REQUIREMENTS = st.dictionaries(
    st.sampled_from(['reaction', 'age']), st.sampled_from(['1us', '20us', '1ms', '1s']))
# They read the recording that `simulate` has written, if it has.
OF_RECORDINGS = (
    ('replay', '--report', 'out.html', '--json', 'out.json', '--callbacks'), ('explain',),
    ('replay', '--reschedule', '--workers', '1', '--report', 'out.html'), ('slack',),
    ('export', '-o', 'out.pftrace'), ('export', '-o', 'out.csv', '--rows', 'jobs'),
    ('diff', 'out.mcap'),
)
VERBS = (
    ('graph', 'check'), ('graph', 'check', '--budget', 'max', '--fail-on-unschedulable'),
    ('graph', 'draw', '-o', 'out.mmd'), ('graph', 'draw', '-o', 'out.dot'),
    ('graph', 'assign-deadlines', '--runs', '2', '--duration', '300us', '-o', 'out.yaml'),
    ('simulate', '--duration', '300us', '--workers', '2'),
    ('simulate', '--duration', '300us', '--policy', 'llf', '--preemptive', '--trace', 'out.mcap'),
    ('evaluate', '--runs', '2', '--duration', '300us', '--policies', 'rad', '--parallel', '1'),
)


def keys(data, *kinds):
    """Return by callback the topics that it has under some keys."""
    for node in data['nodes']:
        callback, = node['callbacks']
        topics = set()
        for kind in kinds:
            value = callback.get(kind, ())
            value = value['topics'] if isinstance(value, dict) else value
            topics.update([value] if isinstance(value, str) else value)
        yield f"{node['node']}:{callback['name']}", topics


def is_out_of_place(key, callback):
    """Return whether a key is an error at a callback."""
    if key in ('deadline', 'timer', 'period'):
        return True
    if key in ('tolerate', 'importance'):
        return callback.get('deadline', 'none') == 'none'
    if key == 'group':
        return False
    is_source = 'period' in callback or 'timer' in callback
    if key in ('once', 'sporadic'):
        return not is_source or (key == 'once') != ('timer' in callback)
    return not is_source


@st.composite
def composed(draw):
    data = as_yaml(draw(declarations()))
    for node in data['nodes']:
        callback, = node['callbacks']
        callback['execution_time'] = draw(TIME)
        if 'deadline' in callback and draw(st.integers(0, 3)) == 3:
            callback['deadline'] = 'none'
        for key in draw(st.lists(st.sampled_from(sorted(MORE)), max_size=2)):
            if key == 'may_publish':
                if callback.get('publishes'):
                    callback[key] = callback.pop('publishes')
            elif key in callback or not is_out_of_place(key, callback):
                callback[key] = draw(MORE[key])
        if 'sync' in callback and draw(st.booleans()):
            callback['sync'] = {'topics': callback['sync'], 'driven_by': callback['sync'][0]}
    pairs = [[first, then] for first, published in keys(data, 'publishes', 'may_publish')
             for then, used in keys(data, 'subscription', 'sync', 'reads')
             if first != then and published & used]
    chosen = draw(st.lists(st.sampled_from(pairs), max_size=2)) if pairs else ()
    if chosen:
        data['paths'] = [{'name': f'p{number}', 'callbacks': pair, **draw(REQUIREMENTS)}
                         for number, pair in enumerate(chosen)]
    if draw(st.booleans()):
        data['workers'] = draw(st.sampled_from([1, 7, 64]))
    if draw(st.integers(0, 3)) == 3:  # something wrong or extreme
        callback, = draw(st.sampled_from(data['nodes']))['callbacks']
        key = draw(st.sampled_from(sorted(EXTREME)))
        callback[key] = draw(st.sampled_from(EXTREME[key]))
    return str(yaml.safe_dump(data, sort_keys=False))


def through_all_verbs(text):
    """Give a declaration to all verbs; return how many used it."""
    used = 0
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as here:
        here.chdir(folder)
        Path('graph.yaml').write_text(text, encoding='utf-8')
        for verb in VERBS:
            kind = 2 if verb[0] == 'graph' else 1
            used += run(*verb[:kind], 'graph.yaml', *verb[kind:], about=text)[0] != 2
        if Path('out.mcap').exists():
            for verb in OF_RECORDINGS:
                run(verb[0], 'out.mcap', *verb[1:], about=text)
        assert not list(Path().glob('.*.part'))
    return used


@settings(max_examples=EXAMPLES, suppress_health_check=[HealthCheck.too_slow])
@given(composed())
def test_composed(text):
    through_all_verbs(text)


@settings(max_examples=EXAMPLES, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 2**31), st.integers(0, 2**31), st.sampled_from(
    ['', 'cut', 'double', 'number', 'word']))
def test_generated_and_damaged(seed, place, how):
    status, text = run('generate', '--seed', str(seed), '--dags', '1:3', '--vertices', '1:6',
                       '--utilisation', str(0.1 + seed % 4 / 10), '--workers', '2')
    assert status == 0
    lines = text.splitlines(keepends=True)
    row = place % len(lines)
    if how == 'cut':
        del lines[row]
    elif how == 'double':
        lines.insert(row, lines[row])
    elif how == 'number':
        lines[row] = ''.join('9' if c.isdigit() else c for c in lines[row])
    elif how == 'word':
        lines[row] = lines[row].replace(':', ': "', 1)
    used = through_all_verbs(''.join(lines))
    assert used == len(VERBS) or how, 'what was generated is right'
