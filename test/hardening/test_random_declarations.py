# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Random declarations through every verb that reads one: done or refused in one line, no traceback.

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

EXAMPLES = int(os.environ.get('HARDENING_EXAMPLES', '60'))
TIMES = st.sampled_from(
    ['1us', '7us', '1ms', '10ms', '33.3ms', '999.999ms', '1s', '86400s', '1440min', '0.5ms'])
TIME = st.sampled_from(['0ns', '1us', '1ms', '86400s', {'quantiles_us': [1, 2, 3]},
                        {'quantiles_us': [0, 10**10]}])
MORE = {
    'deadline': TIMES, 'timer': TIMES, 'period': TIMES,
    'on_late': st.sampled_from(['demote', 'continue']),
    'keep': st.sampled_from(['newest', 'all']), 'importance': st.sampled_from(['high', 'low']),
    'tolerate': st.sampled_from(['1 of 100', '0 of 1', '5']),
    'max_active_jobs': st.sampled_from([1, 2, 10**6, 2**31, 10**30, 0]),
    'release_from': st.sampled_from(['arrival', 'header_stamp', 'source_timestamp']),
    'group': st.sampled_from(['g', 'h', 'reentrant'])}
VERBS = (
    ('graph', 'check'), ('graph', 'check', '--budget', 'max', '--fail-on-unschedulable'),
    ('graph', 'draw', '-o', 'out.mmd'), ('graph', 'draw', '-o', 'out.dot'),
    ('graph', 'assign-deadlines', '--runs', '2', '--duration', '300us', '-o', 'out.yaml'),
    ('simulate', '--duration', '300us', '--workers', '2'),
    ('simulate', '--duration', '300us', '--policy', 'llf', '--preemptive', '--trace', 'out.mcap'),
    ('evaluate', '--runs', '2', '--duration', '300us', '--policies', 'rad', '--parallel', '1'),
)


@st.composite
def composed(draw):
    data = as_yaml(draw(declarations()))
    for node in data['nodes']:
        callback, = node['callbacks']
        if draw(st.integers(0, 9)):
            callback['execution_time'] = draw(TIME)
        for key in draw(st.lists(st.sampled_from(sorted(MORE)), max_size=2)):
            if key in callback or key not in ('deadline', 'timer', 'period'):
                callback[key] = draw(MORE[key])
    if draw(st.booleans()):
        data['workers'] = draw(st.sampled_from([1, 7, 4096, 10**9]))
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
