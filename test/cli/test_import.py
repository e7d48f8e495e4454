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


@pytest.mark.needs('babeltrace2')
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


@pytest.mark.needs('babeltrace2')
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
