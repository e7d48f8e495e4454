# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Importing CTF sessions: every event with every field, and damage said in one line."""

import json
import pickle
import random
import re
import struct
import subprocess

from mddag_executor.trace import import_ctf, read_events, TraceError, TraceReader
from mddag_executor.trace.ctf_decoder import Decoder
from mddag_executor.trace.schema import DAMAGED, DISCARDED, MISSING
import pytest

from ..sources.caret import CARET
from ..trace.ctf2 import fragments, to_ctf2
from ..trace.ctf_session import CLOCK_OFFSET, METADATA, session

START = ('ros2:callback_start', [('callback', 'u64'), ('is_intra_process', 'i32')])
END = ('ros2:callback_end', [('callback', 'u64')])
BIND = ('ros2_caret:dds_bind_addr_to_stamp', [('addr', 'u64'), ('source_stamp', 'u64')])

UNREADABLE = r'metadata: cannot be read \('


def imported(folder, tmp_path):
    import_ctf(folder, tmp_path / 'out.mcap')
    return tmp_path / 'out.mcap'


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


def test_a_session_from_before_humble_is_refused_in_one_line(tmp_path):
    folder = session(tmp_path / 's', [('ros2_hook:dds_write', [('message_addr', 'u64')])],
                     [(0, 10, 1, 1, 'old', 11)])
    with pytest.raises(TraceError, match='/s: it was recorded before ROS 2 Humble, .*: record'):
        import_ctf(folder, tmp_path / 'out.mcap')
    assert not (tmp_path / 'out.mcap').exists()


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


def _aligned(at, bits):
    return at + -at % (bits // 8)


def _whole(bits, align):
    return f'integer {{ size = {bits}; align = {align}; }}'


# Fields that are aligned as on ARM, texts and sequences: TSDL, and what is written at a place.
PARTS = {
    'byte': (_whole(8, 8), lambda rng, at: rng.randbytes(1)),
    'id': (_whole(32, 32), lambda rng, at: bytes(_aligned(at, 32) - at) + b'\1\0\0\0'),
    'word': (_whole(32, 32), lambda rng, at: bytes(_aligned(at, 32) - at) + rng.randbytes(4)),
    'long': (_whole(64, 64), lambda rng, at: bytes(_aligned(at, 64) - at) + rng.randbytes(8)),
    'text': ('string', lambda rng, at: bytes(rng.choices(range(1, 128), k=rng.randrange(9)))
             + b'\0')}


def _sequence(rng, at, bits):
    """Return a number of elements, and the elements."""
    count = rng.randrange(4)
    begin = _aligned(at + 1, bits)
    return bytes([count]) + bytes(begin - at - 1) + rng.randbytes(count * bits // 8)


@pytest.mark.parametrize('context', [True, False])
@pytest.mark.parametrize('seed', range(30))
def test_columns_are_what_is_read_event_by_event(context, seed, tmp_path, monkeypatch):
    """Texts and sequences in any order, in contexts and fields, at all places, and cut at some."""
    rng = random.Random(seed)
    layouts = [[rng.choice(['byte', 'word', 'long', 'text', 'bytes', 'longs'])
                for _ in range(rng.randrange(5))] for _ in range(3)]
    common = ['text', 'longs'] if context else []

    def declared(names, prefix):
        found = ''
        for place, name in enumerate(names):
            if name in PARTS:
                found += f'{PARTS[name][0]} {prefix}{place}; '
            else:
                bits = 8 if name == 'bytes' else 64
                found += (f'{_whole(8, 8)} n{prefix}{place}; {_whole(bits, bits)} '
                          f'{prefix}{place}[n{prefix}{place}]; ')
        return found

    folder = session(tmp_path / 's', [(f'my:k{n}', []) for n in range(3)], [], context=False)
    text = (folder / 'metadata').read_text().replace(
        'event.context := struct {  }', f'event.context := struct {{ {_whole(32, 32)} _vpid; '
        f'{_whole(32, 32)} _vtid; {declared(common, "_procname")}}}').replace(
            '_procname0;', '_procname;')
    for number, names in enumerate(layouts):
        text = text.replace(f'id = {number}; stream_id = 0; fields := struct {{  }}',
                            f'id = {number}; stream_id = 0; fields := struct {{ '
                            f'{declared(names, "f")} }}')
    (folder / 'metadata').write_text(text)
    body = b''

    def write(names):
        nonlocal body
        aligns = {'id': 32, 'word': 32, 'long': 64, 'longs': 64}
        at = 56 + len(body)
        body += bytes(_aligned(at, max([8, *(aligns.get(name, 8) for name in names)])) - at)
        for name in names:
            at = 56 + len(body)
            body += PARTS[name][1](rng, at) if name in PARTS else _sequence(
                rng, at, 8 if name == 'bytes' else 64)

    for event in range(200):
        kind = rng.randrange(3)
        body += struct.pack('<IQ', kind, event)
        write(['id', 'id', *common])
        write(layouts[kind])
    bits = (56 + len(body)) * 8
    data = struct.pack('<IIQQQQQQ', 0xC1FC1FC1, 0, 0, 1000, bits, bits, 0, 0) + body
    for cut in (len(data), rng.randrange(100, len(data))):
        (folder / 'channel_0').write_bytes(data[:cut])
        found = []
        for chain in (Decoder.chain, lambda *_: None):
            monkeypatch.setattr(Decoder, 'chain', chain)
            result = import_ctf(folder, tmp_path / 'out.mcap', overwrite=True)
            found.append((result, contents(tmp_path / 'out.mcap')))
            monkeypatch.undo()
        assert found[0] == found[1]
        assert found[0][0].events == 200 or cut < len(data)


@pytest.mark.parametrize(('options', 'says'), [
    ({'discarded': 17}, 'discarded 17 events'), ({'context': False}, 'vpid and vtid')])
def test_events_that_are_discarded_or_have_no_context_are_warned_of(tmp_path, options, says):
    folder = session(tmp_path / 's', [END], [(0, time, 0, 0, '', 3) for time in range(10)],
                     **options)
    result = import_ctf(folder, tmp_path / 'out.mcap')
    assert says in result.warnings[0] and result.discarded == options.get('discarded', 0)


HEADS = [(head, order, ids) for head in ('plain', 'compact', 'large') for order in '<>'
         for ids in (1, 20, 40000)]


def seconds(count, pace):
    """Return times that go beyond the few bits of the times in events several times."""
    return [k * pace + k % 3 for k in range(count)]


@pytest.mark.parametrize(('head', 'order', 'ids'), HEADS)
def test_heads_of_events_are_those_of_lttng(head, order, ids, tmp_path):
    """Times and numbers have few bits; the time goes on where they begin again."""
    pace = 2 ** 25 if head == 'compact' else 2 ** 30
    times = sorted([*seconds(40, pace), 41 * pace, 41 * pace + 2 ** 34])
    events = [(k % 3, time, 10 + k % 2, 20 + k % 4, 'p', *((2 ** 63 + k, k % 2), (k,), (k, k))[
        k % 3]) for k, time in enumerate(times)]
    folder = session(tmp_path / 's', [START, END, BIND], events, head=head, order=order, ids=ids,
                     packets=[0, 1, 2])
    result = import_ctf(folder, tmp_path / 'out.mcap')
    assert (result.events, result.kinds, result.warnings) == (42, 3, [])
    assert [(event['_timestamp'] - CLOCK_OFFSET, event['_vpid'], event['_vtid'],
             *list(event.values())[5:]) for event in read_events(tmp_path / 'out.mcap')] == [
        (time, pid, tid, *values) for _, time, pid, tid, _, *values in events]


def contents(path):
    """Return all that a trace has: types of events, and events with their fields."""
    reader = TraceReader(path)
    return dict(reader.fields), list(reader.events())


@pytest.mark.parametrize('renamed', [str, 'X{}'.format])
@pytest.mark.parametrize(('head', 'order', 'ids'), HEADS)
def test_ctf2_is_read_as_ctf_1_8(head, order, ids, renamed, tmp_path):
    """Roles say what the heads of packets and events mean, whatever the names of members are."""
    kinds = [START, ('my:frame', [('timestamp', 'i64'), ('ratio', 'f64'), ('label', 'str'),
                                  ('box', 'i32[4]'), ('points', 'f64[]'), ('comm', 'text[6]')])]
    events = [(k % 2, time, 10 + k % 2, 20 + k % 4, 'p', *(
        (2 ** 63 + k, k % 2), (-k, k / 8, 'Größe', (k, -2, 3, -2**31), (0.5,) * (k % 3), 'comm'))[
            k % 2]) for k, time in enumerate(seconds(40, 2 ** 25))]
    folder = session(
        tmp_path / 's', kinds, events, head=head, order=order, ids=ids, packets=[0, 1, -1, 3],
        discarded=5, environment={'hostname': 'robot', 'tracer_major': 2}, boot='a-b')
    first = import_ctf(folder, tmp_path / 'ctf1.mcap')
    second = import_ctf(to_ctf2(folder, packets=True, renamed=renamed), tmp_path / 'ctf2.mcap')
    assert second == first and (first.discarded, first.packets_missing) == (5, 1)
    assert contents(tmp_path / 'ctf2.mcap') == contents(tmp_path / 'ctf1.mcap')


def test_a_version_that_is_no_number_is_unknown(tmp_path):
    folder = session(tmp_path / 's', [START], [(0, 1, 1, 1, 'p', 5, 1)],
                     environment={'tracer_major': '²'})
    assert import_ctf(folder, tmp_path / 'out.mcap').events == 1


ODD = 'integer { size = %d; align = %d; signed = %d; }'
CHOICE = """struct { enum : integer { size = 8; } { none, number = 4 ... 6, word = 9 } what_tag;
  variant <what_tag> { struct { } none; integer { size = 32; align = 8; } number; string word; }
  what; }"""


@pytest.mark.parametrize('head', ['plain', 'compact', 'large'])
def test_fields_of_all_types(head, tmp_path):
    """Bits, texts of a known length, and variants; some kinds of events have no fixed size."""
    def bits(value):
        return struct.pack('<Hb', value[0] | (value[1] & 0x1FFF) << 3, value[2])

    kinds = [
        ('my:bits', [('a', ODD % (3, 1, 0), bits), ('b', ODD % (13, 1, 1), lambda _: b''),
                     ('c', ODD % (8, 8, 1), lambda _: b'')]),
        ('my:text', [('comm', 'text[6]'), ('tail', 'u32')]),
        ('my:either', [('given', CHOICE, lambda value: value), ('after', 'u8')])]
    events = [
        (0, 10, 1, 1, 'p', (5, -4096, -5), 0, 0), (1, 11, 1, 1, 'p', 'abc', 7),
        (2, 12, 1, 1, 'p', b'\0', 1), (2, 13, 1, 1, 'p', b'\5\1\1\0\0', 2),
        (0, 14, 1, 1, 'p', (0, 4095, 127), 0, 0), (1, 15, 1, 1, 'p', 'abcdef', 8),
        (2, 16, 1, 1, 'p', b'\x09word\0', 3), (2, 17, 1, 1, 'p', b'\0', 4)]
    folder = session(tmp_path / 's', kinds, events, head=head)
    assert import_ctf(folder, tmp_path / 'out.mcap').warnings == []
    assert [event[4:] for event in TraceReader(tmp_path / 'out.mcap').events(
        {name for name, _ in kinds}, sorted=True)] == [
        (5, -4096, -5), ('abc', 7), (0, '{}', 1), (5, '257', 2), (0, 4095, 127), ('abcdef', 8),
        (9, '"word"', 3), (0, '{}', 4)]
    import_ctf(to_ctf2(folder), tmp_path / 'ctf2.mcap')
    assert contents(tmp_path / 'ctf2.mcap') == contents(tmp_path / 'out.mcap')


def test_the_host_of_each_process_is_known(tmp_path):
    """By the name of the host and the UUID of its clock, which is that of its boot."""
    folders = [session(
        tmp_path / name, [START], [(0, 10 + k, pid, pid, 'p', k, 0) for k in range(3)
                                   for pid in (7, 8)], environment={'hostname': name}, boot=boot)
               for name, boot in (('arm', 'a-1'), ('base', 'b-2'))]
    to_ctf2(folders[1])
    for given, hosts in ((folders, [('arm', 'a-1')] * 2 + [('base', 'b-2')] * 2),
                         (folders[:1], [('arm', 'a-1')] * 2)):
        import_ctf(given, tmp_path / 'out.mcap', overwrite=True)
        events = list(TraceReader(tmp_path / 'out.mcap').events({'mddag:host', START[0]}))
        found = [event for event in events if event[0] == 'mddag:host']
        assert [event[4:] for event in found] == [(*host, CLOCK_OFFSET) for host in hosts]
        assert len({event[2] for event in found}) == len(hosts)
        for host in found:
            assert next(event for event in events if event[2] == host[2]) == host
        assert all(event['_name'] == START[0] for event in read_events(tmp_path / 'out.mcap'))


def test_an_array_without_elements_is_aligned(tmp_path):
    """As babeltrace2 reads it; LTTng aligns the elements of some processors."""
    wide = 'integer { size = 64; align = 64; }'
    kinds = [('my:list', [
        ('given', f'struct {{ integer {{ size = 8; align = 8; }} n; {wide} list[n]; }}',
         lambda value: value), ('after', 'u8')])]
    folder = session(tmp_path / 's', kinds, [
        (0, 10, 1, 1, 'p', bytes(12), 7)], context=False)
    import_ctf(folder, tmp_path / 'out.mcap')
    assert [event[4:] for event in TraceReader(tmp_path / 'out.mcap').events({'my:list'})] == [
        (0, (), 7)]


U8 = {'type': 'fixed-length-unsigned-integer', 'length': 8, 'byte-order': 'little-endian',
      'alignment': 8}


def test_types_of_ctf2(tmp_path):
    """Names of types, structures around, and types that CTF 1.8 does not have."""
    folder = to_ctf2(session(
        tmp_path / 's', [('a:b', [('bytes', 'u8[9]')])],
        [(0, 1, 1, 1, 'p', (1, 2, 3, 4, 5, 6, 7, 8, 9))]))

    def location(*path):
        return {'path': path}

    def choice(place):
        return {'type': 'variant', 'selector-field-location': place, 'options': [
            {'selector-field-ranges': [[7, 9]], 'field-class': {'type': 'structure'}},
            {'selector-field-ranges': [[0, 0], [1, 3]], 'field-class': 'byte'}]}

    members = [
        ('n', {**U8, 'type': 'fixed-length-boolean'}), ('size', 'byte'),
        ('blob', {'type': 'dynamic-length-blob', 'length-field-location': location('size')}),
        ('nested', {'type': 'structure', 'minimum-alignment': 8, 'member-classes': [
            {'name': 'size', 'field-class': {**U8, 'type': 'fixed-length-bit-map'}},
            {'name': 'above', 'field-class': choice(location(None, 'size'))},
            {'name': 'choice', 'field-class': choice(
                {'origin': 'event-record-payload', 'path': ['n']})},
            {'name': 'text', 'field-class': {
                'type': 'dynamic-length-string', 'length-field-location': location('size')}}]})]
    kept = [part for part in (folder / 'metadata').read_text().split('\x1e')
            if part and 'event-record-class"' not in part.partition(',')[0]]
    added = [{'type': 'field-class-alias', 'name': 'octet', 'field-class': U8},
             {'type': 'field-class-alias', 'name': 'byte', 'field-class': 'octet'},
             {'type': 'event-record-class', 'name': 'a:b', 'payload-field-class': {
                 'type': 'structure', 'member-classes': [
                     {'name': name, 'field-class': kind} for name, kind in members]}}]
    (folder / 'metadata').write_text('\x1e' + '\x1e'.join([*kept, *map(json.dumps, added)]))
    data = (folder / 'channel_0').read_bytes()
    (folder / 'channel_0').write_bytes(data[:-9] + b'\1\2xy\2\4\5ab')
    event, = (event for event in read_events(imported(folder, tmp_path))
              if event['_name'] == 'a:b')
    assert {name: value for name, value in event.items() if name[0] != '_'} == {
        'n': 1, 'size': 2, 'blob': (120, 121), 'nested_size': 2, 'nested_above': '4',
        'nested_choice': '5', 'nested_text': 'ab'}


def test_a_damaged_file_is_used_up_to_the_damage(tmp_path):
    folder = session(tmp_path / 's', [END], [(0, time, 1, 1, 'p', 3) for time in range(10)])
    stream = folder / 'channel_0'
    whole = stream.read_bytes()
    late = struct.pack('<IQ', 0, 10)
    for damaged, used, what in (
            (whole[:-5], 9, r'an event is cut \(at byte 326\), .* 1 more place: 25 bytes are not'),
            (whole[:-30], 9, r'the file ends within a packet \(at byte 326\): what followed is'),
            (whole[:206] + b'\xff' + whole[207:], 5, r'unknown number 255 \(at byte 206\): 150 '),
            (whole[:86] + late + whole[98:], 1, r'an impossible time \(at byte 86\): 270 bytes'),
            (whole + b'junk', 10, r'the head of a packet is cut \(at byte 356\): 4 bytes'),
            (whole + b'\1\2\3\4' + whole[4:], 10, r'as packets do \(at byte 356\): 356 bytes')):
        stream.write_bytes(damaged)
        result = import_ctf(folder, tmp_path / 'out.mcap', overwrite=True)
        assert (result.events, len(result.warnings)) == (used, 1), what
        assert re.match(f'{re.escape(str(stream))}: .*{what}', result.warnings[0])
        *_, last = TraceReader(tmp_path / 'out.mcap').events({END[0], 'mddag:lost'}, sorted=True)
        assert last[0] == 'mddag:lost' and last[5] - CLOCK_OFFSET <= used
    for damaged in (whole[:30], whole[:24] + b'\0\xff' + whole[26:]):
        stream.write_bytes(damaged)
        with pytest.raises(TraceError, match='s: no event can be read'):
            import_ctf(folder, tmp_path / 'out.mcap', overwrite=True)
    stream.write_bytes(b'')
    with pytest.raises(TraceError, match='no event is recorded'):
        import_ctf(folder, tmp_path / 'out.mcap', overwrite=True)
    (folder / 'metadata').write_text('trace {')
    with pytest.raises(TraceError, match=UNREADABLE):
        import_ctf(folder, tmp_path / 'out.mcap', overwrite=True)


def test_a_count_of_discarded_events_that_goes_back_is_no_gap(tmp_path):
    """LTTng writes 0 into an empty packet when it flushes a buffer."""
    folder = session(tmp_path / 's', [END], [(0, time, 1, 1, 'p', 3) for time in range(8)],
                     packets=[0, 1, 2, 3], discarded=[2, 5, 0, 7])
    result = import_ctf(folder, tmp_path / 'out.mcap')
    assert result.discarded == 7 and 'discarded 7 events: ' in result.warnings[0]
    assert [(event[1] - CLOCK_OFFSET, event[4], event[5] - CLOCK_OFFSET)
            for event in TraceReader(tmp_path / 'out.mcap').events({'mddag:lost'})] == [
        (1, 2, 0), (3, 3, 1), (7, 2, 5)]    # since the end of the packet before


def test_discarded_events_missing_packets_and_damage_are_told_apart(tmp_path):
    """Files of a rotated session may be gone, a flight recorder overwrites packets."""
    folder = session(tmp_path / 's', [END], [(0, time, 1, 1, 'p', 3) for time in range(12)],
                     packets=[2, 3, -1, 5], discarded=[0, 0, 0, 4])
    result = import_ctf(folder, tmp_path / 'out.mcap')
    assert (result.discarded, result.packets_missing) == (4, 3)
    assert re.fullmatch(r'.*: the tracer discarded 4 events: .*', result.warnings[0])
    assert re.fullmatch(r'.*: 3 packets of events not in it: .* gone \(rotated away\): .*',
                        result.warnings[1])

    def gaps():
        return [(event[1] - CLOCK_OFFSET, event[4], max(0, event[5] - CLOCK_OFFSET), event[6])
                for event in TraceReader(tmp_path / 'out.mcap').events({'mddag:lost'})]

    assert gaps() == [(0, 2, 0, MISSING), (9, 1, 5, MISSING), (11, 4, 5, DISCARDED)]
    stream = folder / 'channel_0'
    data = stream.read_bytes()
    stream.write_bytes(data[:len(data) // 3] + bytes(100))
    result = import_ctf(folder, tmp_path / 'out.mcap', overwrite=True)
    assert (result.discarded, result.packets_missing, len(result.warnings)) == (0, 2, 2)
    assert [cause for *_, cause in gaps()] == [MISSING, DAMAGED]


def test_cut_metadata_is_one_error(tmp_path):
    head = struct.pack('<I16sIII5B', 0x75D11D57, b'', 0, 1000 * 8, 4096 * 8, 0, 0, 0, 1, 8)
    for data, what in ((head + bytes(3000), 'is cut or damaged at byte 0'), (head[:20], 'is cut'),
                       (head[:24] + bytes(13), 'is cut or damaged'), (b'', 'is empty')):
        (tmp_path / 'metadata').write_bytes(data)
        with pytest.raises(TraceError, match=what):
            import_ctf(tmp_path, tmp_path / 'out.mcap')


NESTED = 'struct {' * 30 + 'uint32_t a;' + '} a;' * 30
DOUBLED = ' '.join(f'struct a{n + 1} {{ struct a{n} x; struct a{n} y; }};' for n in range(40))


@pytest.mark.parametrize(('types', 'fields', 'says'), [
    ('', NESTED, 'nested too deep'),
    (f'struct a0 {{ uint32_t a; }}; {DOUBLED}', 'struct a40 a;', 'more than 5000 members'),
    (f'struct a0 {{ }}; {DOUBLED}', 'struct a40 a;', 'more than 5000 members'),
    ('struct a0 { };', 'struct a0 a[4294967295];', 'without a size'),
    ('', 'uint32_t n; struct { } a[n];', 'without a size'),
    ('', 'integer { size = 4294967295; } a;', 'not a possible size'),
    ('', 'integer { size = 32; align = 7; } a;', 'not a possible alignment'),
    ('', 'uint32_t a' + '[2]' * 40 + ';', 'not understood'),
    ('', 'unknown_t a;', 'not understood'), ('', 'uint32_t a; uint32_t a;', 'not understood'),
    (' ' * 9_000_000, 'uint32_t a;', 'larger than 8 MiB'), ('\0', 'uint32_t a;', 'control char'),
    ('', 'integer { size = 8; base = 1#; } a;', 'it has # where'), ('"', '', 'it has " where'),
    ('', 'uint32_t a[999999999];', 'longer than its event'),
    ('', 'uint32_t a[999999999][999999999];', 'longer than its event'),
    ('', 'uint32_t n; uint8_t a[n]; uint8_t b[n];', 'longer than its event'),
    ('', 'uint8_t a[missing];', "no field 'missing'"),
    ('', 'string a;', 'a text is cut'),
    ('', 'enum : uint8_t { a = 0 } t; variant <t> { uint8_t a; } v;', 'of an unknown kind'),
    ('', 'integer { size = 8; align = 4096; } a;', 'an event is cut')])
def test_hostile_types_are_refused(types, fields, says, tmp_path):
    """Types, lengths and counts that need more than there is."""
    folder = session(
        tmp_path / 's', [('a:b', [('rest', 'u64')])], [(0, 1, 1, 1, 'p', 2**64 - 1)])
    text = (folder / 'metadata').read_text()
    text = text.replace('trace {', f'{types}\ntrace {{', 1)
    text = text.replace('fields := struct {', f'fields := struct {{ {fields} ', 1)
    (folder / 'metadata').write_text(text.replace(
        'uint64_t;\n', 'uint64_t;\ntypealias integer { size = 8; } := uint8_t;\n', 1))
    with pytest.raises(TraceError, match=re.escape(says)):
        import_ctf(folder, tmp_path / 'out.mcap')


def ctf2_of(payload, more=()):
    """Return metadata with an event whose payload has one type, after some more fragments."""
    text = fragments(METADATA.format(
        offset=0, boot='', order='le', head='struct { uint32_t id; time_t timestamp; }',
        context='', environment=''))
    event = {'type': 'event-record-class', 'name': 'a:b', 'payload-field-class': {
        'type': 'structure', 'member-classes': [{'name': 'a', 'field-class': payload}]}}
    return text + ''.join(f'\x1e{json.dumps(each)}' for each in (*more, event))


def alias(name, kind):
    return {'type': 'field-class-alias', 'name': name, 'field-class': kind}


DEEP = U8
for _ in range(30):
    DEEP = {'type': 'static-length-array', 'length': 1, 'element-field-class': DEEP}
TWICE = [alias('a0', U8), *(
    alias(f'a{n + 1}', {'type': 'structure', 'member-classes': [
        {'name': each, 'field-class': f'a{n}'} for each in 'xy']}) for n in range(40))]
WIDE = [alias('wide', {'type': 'structure', 'member-classes': [
    {'name': f'm{n}', 'field-class': U8} for n in range(4000)]}), *(
    {'type': 'event-record-class', 'id': n + 1, 'payload-field-class': 'wide'}
    for n in range(2000))]


@pytest.mark.parametrize(('payload', 'more', 'says'), [
    (DEEP, (), 'nested too deep'), ('a40', TWICE, 'nested too deep'),
    ('a20', TWICE, 'more than 5000 members'), (U8, WIDE, 'more than 131072 types'),
    ('a', [alias('a', 'b'), alias('b', 'a')], "'a' is not a type"),
    ('missing', (), "there is no type 'missing'"), (7, (), "'7' is not a type"),
    ({**U8, 'length': 65}, (), 'not a possible size'),
    ({**U8, 'length': '8'}, (), 'not an integer'),
    ({**U8, 'length': 2 ** 70}, (), 'not an integer'),
    ({**U8, 'alignment': 7}, (), 'not a possible al'),
    ({**U8, 'bit-order': 'last-to-first'}, (), 'the order of bits'),
    ({**U8, 'type': 'variable-length-unsigned-integer'}, (), 'is not read'),
    ({'type': 'null-terminated-string', 'encoding': 'utf-16le'}, (), 'not UTF-8'),
    ({'type': 'static-length-array', 'length': 2 ** 32 - 1,
      'element-field-class': {'type': 'structure'}}, (), 'without a size'),
    ({'type': 'static-length-array', 'length': 2 ** 32 - 1, 'element-field-class': U8}, (),
     'longer than its event'),
    ({'type': 'dynamic-length-blob', 'length-field-location': {'path': ['b']}}, (),
     "no field 'b'"),
    ({'type': 'dynamic-length-blob', 'length-field-location': {'path': [None, None, 'b']}}, (),
     "no field 'b'"),
    ({'type': 'dynamic-length-blob', 'length-field-location': {'path': []}}, (), 'no path'),
    ({'type': 'variant', 'selector-field-location': {'path': ['b']}, 'options': []}, (),
     '0 ranges'),
    (U8, [{'type': 'clock-class', 'id': 'slow', 'frequency': 0}], 'not a possible size'),
    (U8, [{'type': 'trace-class', 'environment': 1}], 'is not an object'),
    (U8, [{'type': 'preamble', 'version': 2}], 'only preamble'),
    (U8, [{'type': 'data-stream-class'}], 'two streams have the number 0'),
    (U8, [{'type': 'event-record-class', 'data-stream-class-id': 5}], 'is of no stream'),
    (U8, [{'type': 'story'}], "the type 'story'"), (U8, [[]], 'is not a JSON object')])
def test_hostile_ctf2_is_refused(payload, more, says, tmp_path):
    folder = session(
        tmp_path / 's', [('a:b', [('rest', 'u64')])], [(0, 1, 1, 1, 'p', 2**64 - 1)],
        context=False)
    (folder / 'metadata').write_text(ctf2_of(payload, more))
    with pytest.raises(TraceError, match=re.escape(says)):
        import_ctf(folder, tmp_path / 'out.mcap')


@pytest.mark.parametrize(('text', 'says'), [
    ('\x1e{"type": "preamble", "version": 3}', 'it is of version 3 of CTF'),
    ('\x1e{"type": "preamble", "version": 2, "extensions": {"a": {}}}', 'extensions'),
    ('\x1e{"type": "preamble", "version": 2, "uuid": 99999999999}', 'no UUID'),
    ('\x1e{"type": "preamble", "version": 2', 'its fragment 1 is cut, or not JSON'),
    ('\x1e{"type": ' + '[' * 200_000, 'nested too deep'),
    ('\x1e{"type": "trace-class"}', 'only preamble'), ('\x1e', 'is cut, or not JSON')])
def test_ctf2_that_is_cut_is_one_error(text, says, tmp_path):
    (tmp_path / 'metadata').write_text(text)
    with pytest.raises(TraceError, match=f'{UNREADABLE}.*{re.escape(says)}'):
        import_ctf(tmp_path, tmp_path / 'out.mcap')


def test_heads_of_events_that_overlap_are_one_error(tmp_path):
    folder = session(tmp_path / 's', [END], [(0, 1, 1, 1, 'p', 3)], head='compact')
    text = (folder / 'metadata').read_text()
    (folder / 'metadata').write_text(text.replace('extended = 31', 'extended = 3'))
    with pytest.raises(TraceError, match='/s: its metadata cannot be read .* not those of LTTng'):
        import_ctf(folder, tmp_path / 'out.mcap')


_LINE = re.compile(r'\[(\d+)\.(\d{9})\] \(\S+\) (?:\S+ )?([^ ]+): \{.*?vpid = (\d+), '
                   r'vtid = (\d+), procname = "(.*?)" \}, \{(.*)\}')


@pytest.mark.needs('babeltrace2')
@pytest.mark.parametrize(('head', 'order', 'ids'), HEADS)
def test_babeltrace_reads_the_same(head, order, ids, tmp_path):
    """Also how many events were discarded, and that a packet was."""
    pace = 2 ** 25 if head == 'compact' else 2 ** 30
    folder = session(tmp_path / 's', [START, END, BIND], [
        (k % 3, time, 10 + k % 2, 20 + k % 4, 'p', *((k, k % 2), (k,), (k, k))[k % 3])
        for k, time in enumerate(seconds(40, pace))],
        head=head, order=order, ids=ids, packets=[0, 1, -1, 3], discarded=5)
    done = subprocess.run(
        ['babeltrace2', '--clock-seconds', folder], capture_output=True, text=True, check=True)
    expected = [(match[3], int(match[1]) * 10 ** 9 + int(match[2]), int(match[4]), int(match[5]),
                 *(int(value, 0) for value in re.findall(r'= (\w+)', match[7])))
                for match in map(_LINE.match, done.stdout.splitlines())]
    result = import_ctf(folder, tmp_path / 'out.mcap')
    found = list(TraceReader(tmp_path / 'out.mcap').events({START[0], END[0], BIND[0]}))
    assert len(found) == 30 and found == expected
    gaps = re.findall(r'Tracer discarded (\d+) (event|packet)', done.stderr)
    assert [int(count) for count, kind in gaps if kind == 'event'] == [5]
    assert [kind for _, kind in gaps].count('packet') == 1
    assert 'discarded 5 events:' in result.warnings[0]
    assert ': 1 packet of events not in it: ' in result.warnings[1]


class Plain(pickle.Unpickler):
    """Reads pickles of plain values only."""

    def find_class(self, module, name):
        raise pickle.UnpicklingError(f'{module}.{name}')


@pytest.mark.skipif(not CARET.is_dir(), reason='the sample recording is not here')
def test_events_of_a_real_recording_equal_what_caret_made_of_them(tmp_path):
    path = imported(CARET / 'end_to_end_sample', tmp_path)
    with open(CARET / 'end_to_end_sample' / 'caret_converted', 'rb') as file:
        expected = Plain(file).load()
    assert len(expected) == 2880
    assert list(read_events(path)) == expected
