# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Importing CTF sessions: every event with every field, and damage said in one line."""

import pickle
import re
import struct

from mddag_executor.trace import import_ctf, read_events, TraceError, TraceReader
import pytest

from ..replay.test_caret_sample import CARET
from ..trace.ctf_session import CLOCK_OFFSET, session, stand_in

START = ('ros2:callback_start', [('callback', 'u64'), ('is_intra_process', 'i32')])
END = ('ros2:callback_end', [('callback', 'u64')])
BIND = ('ros2_caret:dds_bind_addr_to_stamp', [('addr', 'u64'), ('source_stamp', 'u64')])

UNREADABLE = r's: (cannot be read|babeltrace2 gave up) \('

bt2 = pytest.mark.needs('babeltrace2')


def imported(folder, tmp_path):
    import_ctf(folder, tmp_path / 'out.mcap')
    return tmp_path / 'out.mcap'


@bt2
def test_events_of_several_processes_come_in_the_order_of_time(tmp_path):
    session(tmp_path / 's/ust/pid/a', [START, END], [
        (0, 10, 100, 101, 'talker', 2**64 - 1, 1), (1, 40, 100, 101, 'renamed', 2**64 - 1)])
    session(tmp_path / 's/ust/pid/b', [END, START, BIND], [
        (1, 20, 200, 201, 'listener', 5, 0), (0, 30, 200, 201, 'listener', 5),
        (2, 50, 200, 202, 'dds', 7, 2**63 - 1)])
    result = import_ctf(tmp_path / 's', tmp_path / 'out.mcap')
    assert (result.events, result.processes, result.warnings) == (5, {100, 200}, [])

    def event(name, time, pid, tid, procname, **fields):
        return {'_name': name, '_timestamp': CLOCK_OFFSET + time, '_vpid': pid, '_vtid': tid,
                '_procname': procname, **fields}

    assert list(read_events(tmp_path / 'out.mcap')) == [
        event('ros2:callback_start', 10, 100, 101, 'talker', callback=2**64 - 1,
              is_intra_process=True),
        event('ros2:callback_start', 20, 200, 201, 'listener', callback=5,
              is_intra_process=False),
        event('ros2:callback_end', 30, 200, 201, 'listener', callback=5),
        event('ros2:callback_end', 40, 100, 101, 'renamed', callback=2**64 - 1),
        event('ros2_caret:dds_bind_addr_to_stamp', 50, 200, 202, 'dds', addr=7,
              source_stamp=2**63 - 1)]


@bt2
def test_unknown_events_keep_all_fields(tmp_path):
    kind = ('my-app:frame', [('timestamp', 'i64'), ('ratio', 'f64'), ('label', 'str'),
                             ('small', 'u8'), ('box', 'i32[4]'), ('points', 'f64[]')])
    folder = session(tmp_path / 's', [kind], [
        (0, 1, 1, 1, 'p', -5, 0.1, 'Größe', 255, (1, -2, 3, -2**31), (0.5, 1e300)),
        (0, 2, 1, 1, 'p', 6, -0.0, '', 0, (0, 0, 0, 0), ())])
    result = import_ctf(folder, tmp_path / 'out.mcap')
    assert result.warnings == []
    reader = TraceReader(tmp_path / 'out.mcap')
    events = [event for event in reader.events() if event[0] != 'mddag:process']
    assert events == [
        ('my_app:frame', CLOCK_OFFSET + 1, 1, 1, -5, 0.1, 'Größe', 255, (1, -2, 3, -2**31), 2,
         (0.5, 1e300)),
        ('my_app:frame', CLOCK_OFFSET + 2, 1, 1, 6, -0.0, '', 0, (0, 0, 0, 0), 0, ())]
    assert reader.fields['my_app:frame'] == (
        'timestamp_', 'ratio', 'label', 'small', 'box', 'points_length', 'points')


@bt2
def test_a_session_from_before_humble_is_refused_in_one_line(tmp_path):
    folder = session(tmp_path / 's', [('ros2_hook:dds_write', [('message_addr', 'u64')])],
                     [(0, 10, 1, 1, 'old', 11)])
    with pytest.raises(TraceError, match='/s: it was recorded before ROS 2 Humble, .*: record'):
        import_ctf(folder, tmp_path / 'out.mcap')
    assert not (tmp_path / 'out.mcap').exists()


@bt2
def test_one_event_with_other_fields_in_another_process(tmp_path):
    session(tmp_path / 's/a', [('ros2_caret:dds_write', [('message', 'u64')])],
            [(0, 10, 1, 1, 'old', 11)])
    session(tmp_path / 's/b', [('ros2_caret:dds_write',
                                [('rmw_publisher_handle', 'u64'), ('message', 'u64')])],
            [(0, 20, 2, 2, 'new', 7, 22)])
    path = imported(tmp_path / 's', tmp_path)
    assert [{name: value for name, value in event.items() if name[0] != '_'}
            for event in read_events(path)] == [
        {'message': 11}, {'rmw_publisher_handle': 7, 'message': 22}]
    assert [event[4:] for event in TraceReader(path).events({'ros2_caret:dds_write'})] == [
        (11,), (22,)]


@bt2
@pytest.mark.parametrize(('options', 'says'), [
    ({'discarded': 17}, 'discarded 17 events'), ({'context': False}, 'vpid and vtid')])
def test_babeltrace_says_what_is_discarded_or_has_no_context(tmp_path, options, says):
    folder = session(tmp_path / 's', [END], [(0, time, 0, 0, '', 3) for time in range(10)],
                     **options)
    result = import_ctf(folder, tmp_path / 'out.mcap')
    assert says in result.warnings[0] and result.discarded == options.get('discarded', 0)


@bt2
def test_damage_is_one_error(tmp_path):
    folder = session(tmp_path / 's', [END], [(0, time, 1, 1, 'p', 3) for time in range(10)])
    stream = folder / 'channel_0'
    whole = stream.read_bytes()
    for damaged in (whole[:-5], whole[:30], whole[:24] + b'\0\xff' + whole[26:]):
        stream.write_bytes(damaged)
        with pytest.raises(TraceError, match=UNREADABLE):
            import_ctf(folder, tmp_path / 'out.mcap')
        assert not (tmp_path / 'out.mcap').exists()
    stream.write_bytes(b'')
    with pytest.raises(TraceError, match='no event is recorded'):
        import_ctf(folder, tmp_path / 'out.mcap')
    (folder / 'metadata').write_text('trace {')
    with pytest.raises(TraceError, match=UNREADABLE):
        import_ctf(folder, tmp_path / 'out.mcap')


def test_cut_metadata_is_found_before_babeltrace_reads_it(tmp_path):
    head = struct.pack('<I16sIII5B', 0x75D11D57, b'', 0, 1000 * 8, 4096 * 8, 0, 0, 0, 1, 8)
    for data, what in ((head + bytes(3000), 'is cut or damaged at byte 0'), (head[:20], 'is cut'),
                       (head[:24] + bytes(13), 'is cut or damaged'), (b'', 'is empty')):
        (tmp_path / 'metadata').write_bytes(data)
        with pytest.raises(TraceError, match=what):
            import_ctf(tmp_path, tmp_path / 'out.mcap')


EVENTS = [['ready'], ['class', 0, 'ros2:callback_end', [['callback', 'uint64']], 0],
          ['event', 0, 5, 1, 2, 'p', [3]]]


@pytest.mark.parametrize('rows, then, what', [
    (EVENTS, 'os.kill(os.getpid(), 6)', r'babeltrace2 gave up \(ended by SIGABRT\)'),
    (EVENTS, '', r'babeltrace2 gave up \(exit status 0\)'),
    (EVENTS, 'os.kill(os.getpid(), 14)', '.*did nothing for'),
    (EVENTS, 'sys.stdout.buffer.write(bytes([255] * 9))', '.*gave up'),
    ([*EVENTS, ['error', 'because']], '', r'cannot be read \(because\)'),
    ([['missing', 'no module']], '', '.*are not installed: apt install python3-bt2'),
])
def test_what_was_there_stays_when_the_import_fails(rows, then, what, tmp_path, monkeypatch):
    folder, out = stand_in(tmp_path / 's', monkeypatch, rows, then), tmp_path / 'out.mcap'
    out.write_text('precious')
    with pytest.raises(TraceError, match='^' + re.escape(f'{folder}: ') + what):
        import_ctf(folder, out, overwrite=True)
    assert out.read_text() == 'precious' and sorted(tmp_path.iterdir()) == [out, folder]


def test_events_that_are_discarded_or_have_no_context_are_warned_of(tmp_path, monkeypatch):
    """A packet that was lost counts as an event at least."""
    folder = stand_in(tmp_path / 's', monkeypatch, [
        *EVENTS, ['discarded', 6, 17], ['event', 0, 7, None, None, None, [4]],
        ['discarded', 8, -1], ['end']])
    result = import_ctf(folder, tmp_path / 'out.mcap')
    discarded, nameless = result.warnings
    assert 'the tracer discarded 18 events at least: ' in discarded
    assert 'no process or thread is known of 1 event: add the contexts vpid and vtid' in nameless
    assert [event[4] for event in TraceReader(tmp_path / 'out.mcap').events(
        {END[0], 'mddag:lost'})] == [3, 17, 4, 1]


class Plain(pickle.Unpickler):
    """Reads pickles of plain values only."""

    def find_class(self, module, name):
        raise pickle.UnpicklingError(f'{module}.{name}')


@bt2
@pytest.mark.skipif(not CARET.is_dir(), reason='the sample recording is not here')
def test_events_of_a_real_recording_equal_what_caret_made_of_them(tmp_path):
    path = imported(CARET / 'end_to_end_sample', tmp_path)
    with open(CARET / 'end_to_end_sample' / 'caret_converted', 'rb') as file:
        expected = Plain(file).load()
    assert len(expected) == 2880
    assert list(read_events(path)) == expected
