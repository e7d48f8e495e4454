# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Names in traces, bags and diagnostics may be hostile: they are shown, and do nothing.

A recorded run is written again with all of its texts changed into ones that would work as terminal
escapes, HTML, paths, templates, formulas or code, and given to every verb that reads traces.
"""

from itertools import count, islice
import json
from pathlib import Path
from types import SimpleNamespace

from mddag_executor.report.board import Board, MOST_STATUSES
from mddag_executor.trace import read_events, TraceFile
from mddag_executor.trace.schema import EVENTS
import pytest
import yaml

TOP = Path(__file__).resolve().parents[2]
BAG = TOP / 'bags' / 'demo_short.mcap'

HOSTILE = [
    '\x1b]0;owned\x07', '\x1b[2J\x1b[31m', '\x9b31m', '\r\n\x08', '\x00', '\u202e\u2066',
    '<script>window.hacked=1</script>', '"><img src=x onerror=alert(1)>', "=HYPERLINK('http://x')",
    '../../../../tmp/mddag-owned', '/etc/passwd', '{0.__class__}%s%n$(id)`id`', '{{7*7}}',
    "'); import os; os.system('id')", '[bold red]rich[/]', 'a' * 5000, '\udbff'.encode(
        'utf-8', 'replace').decode(), '💣' * 40, '',
]


# Without these two it would not be a run at all, and is refused; see below.
KEPT = {('task_set', 'yaml'), ('task_set', 'policy')}


@pytest.fixture(scope='module')
def trace(tmp_path_factory):
    """Give the recorded run with other texts."""
    path, numbers = tmp_path_factory.mktemp('hostile') / 'run.mcap', count()
    with TraceFile(path) as file:
        for event in islice(read_events(BAG), 2500):
            kind = EVENTS[event['_name']]
            values = [
                HOSTILE[next(numbers) % len(HOSTILE)]
                if type_name == 'string' and (kind.name, field) not in KEPT
                else event.get(field, 0)    # the bag is older than some
                for field, type_name in kind.fields]
            file.add(event['_name'], event['_timestamp'], event['_vpid'], event['_vtid'], *values)
    assert next(numbers) > 100
    return path


def harmless(text):
    """Check that a terminal has nothing to obey."""
    assert [c for c in text if not c.isprintable() and c != '\n'] == []


VERBS = (
    'replay TRACE', 'replay TRACE --reschedule --workers 2', 'diff TRACE TRACE',
    'graph from-trace TRACE -o graph.yaml', 'export TRACE -o out.csv',
    'replay TRACE --report out.html', 'replay TRACE --json out.json')


@pytest.mark.parametrize('command', VERBS)
def test_no_verb_obeys_a_name(call, trace, tmp_path, command):
    before = {path for path in Path('/tmp').iterdir() if 'mddag-owned' in path.name}
    done = call(*command.replace('TRACE', str(trace)).split(), cwd=tmp_path)
    # Nodes with such names cannot be drafted; all other verbs use the trace.
    drafts = 'from-trace' in command
    assert done.returncode == 2 * drafts and 'Traceback' not in done.stderr, done.stderr
    assert drafts or done.stdout or list(tmp_path.iterdir())
    harmless(done.stdout + done.stderr)
    for path in tmp_path.iterdir():
        text = path.read_text(encoding='utf-8')
        if path.suffix == '.html':
            assert '<script>window.hacked' not in text and '<img src=x' not in text
            harmless(text.replace('\t', ''))
        elif path.suffix == '.json':
            json.loads(text)
        elif path.suffix == '.csv':
            harmless(text.replace('\r\n', '\n'))
            assert not any(cell.startswith('=') for row in text.splitlines()
                           for cell in row.split(','))
        elif path.suffix == '.yaml':
            yaml.safe_load(text)
            harmless(text)
    assert {path for path in Path('/tmp').iterdir() if 'mddag-owned' in path.name} == before


SMALL = 'mddag: 1\nnodes: [{node: /n, callbacks: [{name: t, timer: 1s, deadline: 1s}]}]\n'


def task_set(path, **changes):
    """Write a trace of one event, that of the declaration, with changes."""
    event = next(event for event in read_events(BAG) if event['_name'] == 'mddag:task_set')
    with TraceFile(path, overwrite=True) as file:
        file.add('task_set', event['_timestamp'], 1, 1, *(
            {**event, **changes}.get(name, 0) for name, _ in EVENTS['mddag:task_set'].fields))
    return path


@pytest.mark.parametrize('field', ['yaml', 'policy', 'file'])
def test_a_hostile_declaration_in_a_trace(call, tmp_path, field):
    """It is refused, or its name is only a name."""
    for text in HOSTILE:
        done = call('replay', task_set(tmp_path / 'run.mcap', **{'yaml': SMALL, field: text}))
        assert done.returncode in (0, 2) and 'Traceback' not in done.stderr, done.stderr
        harmless(done.stdout + done.stderr)


@pytest.mark.parametrize('include', ['/etc/passwd', 'secret.yaml', '../secret.yaml'])
def test_a_declaration_in_a_trace_includes_nothing(call, tmp_path, include):
    (tmp_path / 'secret.yaml').write_text('mddag: 1\nnodes: [this is secret]\n')
    task_set(tmp_path / 'run.mcap', yaml=f'mddag: 1\ninclude: [{include}]\n',
             file=str(tmp_path / 'graph.yaml'))
    done = call('replay', 'run.mcap', cwd=tmp_path)
    assert (done.returncode, done.stderr.count('\n')) == (2, 1)
    assert 'secret]' not in done.stderr and 'root:' not in done.stderr
    assert 'includes nothing' in done.stderr or 'relative' in done.stderr


@pytest.mark.parametrize('names', [
    ['../secret.mcap'], ['/etc/passwd'], ['sub/../../secret.mcap'], ['\x00'], [5], {}, [[]], None])
def test_a_bag_names_only_its_own_files(call, tmp_path, names):
    (tmp_path / 'secret.mcap').write_bytes(BAG.read_bytes())
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'metadata.yaml').write_text(yaml.safe_dump(
        {'rosbag2_bagfile_information': {'relative_file_paths': names, 'message_count': 1}}))
    done = call('replay', 'bag', TOP / 'config' / 'autoware.yaml', '--reschedule', cwd=tmp_path)
    assert (done.returncode, done.stderr.count('\n')) == (2, 1), done.stdout
    assert done.stderr.startswith('error: ')
    harmless(done.stderr)


def test_a_flood_of_diagnostics_fills_no_memory():
    board = Board()

    def say(process):
        board.take(SimpleNamespace(status=[SimpleNamespace(
            hardware_id=process, name='mddag: d', level=b'\0', message='',
            values=[SimpleNamespace(key='window_missed_ratio', value='0')])]))

    say('robot')
    for i in range(3 * MOST_STATUSES):
        say(f'flood {i}')
        if i % 500 == 0:
            say('robot')
    shown = [status.process for status in board.statuses()]
    assert len(shown) == MOST_STATUSES
    assert 'robot' in shown and f'flood {3 * MOST_STATUSES - 1}' in shown
