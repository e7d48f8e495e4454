# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `import`: the trace as a whole or nothing, bad input in one line."""

from mddag_executor.trace import read_events
import pytest

from ..trace.ctf_session import session


def of_session(folder, name, made, host='robot', callback=1):
    """Write a trace of a session: an event of a callback."""
    session(folder, [('ros2:callback_end', [('callback', 'u64')])],
            [(0, callback, callback, 1, 'p', callback)],
            environment={'domain': 'ust', 'trace_name': name, 'trace_creation_datetime': made,
                         'hostname': host})


def test_several_sessions_are_named_one_by_one(tmp_path, call):
    """Parts of one session are one recording, wherever they lie; two sessions need to be named."""
    out = tmp_path / 'out.mcap'
    of_session(tmp_path / 'one' / 'ust/uid/1000/64-bit', 'drive', 'monday', callback=1)
    of_session(tmp_path / 'one' / 'archives/chunk-0/ust/uid/1000/64-bit', 'drive', 'monday',
               callback=2)
    of_session(tmp_path / 'one' / 'kernel', 'drive (kernel)', 'mon', callback=3)
    status, text, errors = call('import', 'ctf', tmp_path / 'one', '-o', out)
    assert (status, errors) == (0, '')
    assert [event['callback'] for event in read_events(out)] == [1, 2, 3]
    out.unlink()
    for name, host in (('another', 'robot'), ('elsewhere', 'tower')):
        of_session(tmp_path / name / 'ust/uid/1000/64-bit', 'drive', 'tuesday', host, callback=4)
        status, text, errors = call('import', 'ctf', tmp_path, '-o', out)
        assert (status, text, errors.count('\n')) == (2, '', 1)
        count = 2 if name == 'another' else 3
        assert errors.startswith(f'error: {tmp_path}: it holds {count} sessions: another, ')
        assert 'name the folder of one' in errors
        assert not out.exists()
    done = call('import', 'ctf', tmp_path / 'one', tmp_path / 'elsewhere', '-o', out)
    assert (done.returncode, done.stderr) == (0, '')
    assert [event['callback'] for event in read_events(out)] == [1, 2, 3, 4]
    out.unlink()
    done = call('import', 'ctf', tmp_path / 'one', tmp_path / 'one' / 'kernel', '-o', out)
    assert (done.returncode, done.stderr.count('\n')) == (2, 1)
    assert done.stderr.endswith(': a session is named twice: name each once\n')


def test_processes_of_several_containers_may_have_the_same_numbers(tmp_path, call):
    # in both containers process 1 runs a callback of the same address, at overlapping times
    kinds = [(f'ros2:callback_{what}', [('callback', 'u64')]) for what in ('start', 'end')]
    for name, made, late in (('camera', '12:00:01', 0), ('control', '12:00:02', 3)):
        events = [(what, 10 * k + late + 6 * what, 1, 1, name, 0x5550)
                  for k in range(5) for what in (0, 1)]
        session(tmp_path / name / 'ust', kinds, events, environment={
            'trace_name': 'drive', 'trace_creation_datetime': made, 'hostname': 'robot'})
    out = tmp_path / 'out.mcap'
    done = call('import', 'ctf', tmp_path / 'camera', tmp_path / 'control', '-o', out)
    assert (done.returncode, done.stderr) == (0, '') and 'from 2 processes' in done.stdout
    result = call('replay', out, '--json', '-').result
    assert [(use['executions'], use['unfinished'], use['busy_ns'])
            for use in result['recorded_callbacks'].values()] == [(5, 0, 30), (5, 0, 30)]


INIT = ('ros2:rcl_node_init', [('node_handle', 'u64'), ('rmw_handle', 'u64'),
                               ('node_name', 'str'), ('namespace', 'str')])
CALLBACK = [(f'ros2:callback_{what}', [('callback', 'u64')]) for what in ('start', 'end')]
BOOT = 'b5f5b5ae-2f0a-4d0c-8f6e-2a6a2f7a0001'


@pytest.mark.parametrize('given', [('dual',), ('dual/runtime', 'dual/snapshot')])
def test_both_sessions_of_a_dual_session_are_of_the_same_processes(given, tmp_path, call):
    """The first has the initialisation, the second what ran, and an event of a late node too."""
    late = (0, 70, 11, 12, 'node', 2, 2, 'late', '/')
    for name, kinds, events in (
            ('snapshot', [INIT], [(0, 10 + n, 10 + n, 10 + n, 'node', 1, 1, 'n', '/')
                                  for n in range(2)] + [late]),
            ('runtime', [*CALLBACK, INIT], [
                *((what, 50 + n, 10 + n, 12, 'node', 7) for what in (0, 1) for n in range(2)),
                (2, 71, *late[2:])])):
        events.sort(key=lambda event: event[1])
        session(tmp_path / 'dual' / name / 'ust/uid/1000/64-bit', kinds, events, boot=BOOT,
                environment={'hostname': 'robot', 'trace_name': name})
    out = tmp_path / 'out.mcap'
    done = call('import', 'ctf', *(tmp_path / name for name in given), '-o', out)
    assert done.returncode == 0 and ': 1 event in more than one session' in done.stderr
    assert '7 events of 3 kinds from 2 processes' in done.stdout
    assert [(event['_name'].split(':')[1], event['_vpid']) for event in read_events(out)] == [
        ('rcl_node_init', 10), ('rcl_node_init', 11), ('callback_start', 10),
        ('callback_end', 10), ('callback_start', 11), ('callback_end', 11),
        ('rcl_node_init', 11)]


def test_two_sessions_of_one_run_are_not_counted_twice(tmp_path, call):
    """The second began later and lost some events; the times differ a little."""
    events = [(n % 2, 10 * n, 5, 6, 'node', 7) for n in range(20)]
    for name, shift, part in (('one', 0, slice(0, 14)), ('two', 1, slice(4, 20))):
        kept = [(kind, time + shift, *rest) for kind, time, *rest in events[part]]
        if name == 'two':
            del kept[2:4]
        session(tmp_path / name / 'ust', CALLBACK, kept, boot=BOOT,
                environment={'hostname': 'robot'})
    out = tmp_path / 'out.mcap'
    done = call('import', 'ctf', tmp_path / 'one', tmp_path / 'two', '-o', out)
    assert done.returncode == 0 and '8 events in more than one session' in done.stderr
    assert [event['_timestamp'] % 1000 // 10 for event in read_events(out)] == list(range(20))


@pytest.mark.parametrize('boot', [BOOT, BOOT.replace('1', '2')])
def test_containers_of_one_host_may_have_equal_process_names(boot, tmp_path, call):
    """What the sessions have of one thread is not the same, so it is not one thread."""
    for name, boot_of, shift in (('one', BOOT, 0), ('two', boot, 5)):
        session(tmp_path / name / 'ust', CALLBACK, [
            (n % 2, 10 * n + shift, 1, 1, 'node', 7 + shift) for n in range(300)], boot=boot_of,
            environment={'hostname': 'robot'})
    out = tmp_path / 'out.mcap'
    done = call('import', 'ctf', tmp_path / 'one', tmp_path / 'two', '-o', out)
    assert (done.returncode, done.stderr) == (0, '')
    assert '600 events of 2 kinds from 2 processes' in done.stdout
