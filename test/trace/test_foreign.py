# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Files by other writers, and the order of time."""

import struct

from mcap.writer import CompressionType, IndexType, Writer
from mddag_executor.trace import EVENTS, read_events, TraceReader, TraceWarning
from mddag_executor.trace.cdr import ENCAPSULATION, encode
import pytest

from .helpers import mixture, read, read_back, VPID, write_chunks


def message(entry):
    name, timestamp, *rest = entry
    return ENCAPSULATION + encode(EVENTS[name].types, (timestamp, VPID, *rest))


def write_with_mcap(path, recorded, **options):
    """Write with the mcap package: other schema ids, other names, channels in another order."""
    with open(path, 'wb') as stream:
        writer = Writer(stream, **options)
        writer.start(profile='ros2')
        writer.register_schema('std_msgs/msg/String', 'ros2msg', b'string data')
        other = writer.register_channel('/chatter', 'cdr', 1)
        channels = {}
        for name, *_ in reversed(recorded):
            if name not in channels:
                event = EVENTS[name]
                schema = writer.register_schema(f'x/msg/{event.name}', 'ros2msg',
                                                event.text.encode())
                channels[name] = writer.register_channel(event.topic, 'cdr', schema)
        for number, entry in enumerate(recorded):
            writer.add_message(channels[entry[0]], entry[1], message(entry), entry[1])
            if number % 3 == 0:
                writer.add_message(other, entry[1], b'\0\1\0\0\1\0\0\0\0', entry[1])
            if number == 20:
                writer.add_attachment(0, entry[1], 'a', 'text/plain', b'abc')
                writer.add_metadata('m', {'a': 'b'})
        writer.finish()


@pytest.mark.parametrize('options', [
    {'chunk_size': 2000, 'compression': CompressionType.LZ4},
    {'chunk_size': 2000, 'compression': CompressionType.NONE},
    {'chunk_size': 2000, 'enable_crcs': False, 'use_statistics': False},
    {'chunk_size': 2000, 'index_types': IndexType.NONE, 'repeat_channels': False},
    {'use_chunking': False},
    {'use_chunking': False, 'repeat_channels': False, 'repeat_schemas': False,
     'use_statistics': False, 'use_summary_offsets': False, 'index_types': IndexType.NONE},
], ids=str)
def test_files_by_the_mcap_package(tmp_path, options):
    path = tmp_path / 'a.mcap'
    recorded = mixture(300)
    write_with_mcap(path, recorded, **options)
    for in_time_order in (False, True):
        assert read(path, in_time_order) == (read_back(recorded), [])


@pytest.mark.parametrize('options', [{}, {'repeat_channels': False}], ids=str)
def test_a_summary_without_channels_does_not_say_what_events_there_are(tmp_path, options):
    path = tmp_path / 'a.mcap'
    write_with_mcap(path, mixture(300), **options)
    reader = TraceReader(path)
    assert reader.message_count and reader.has_events()
    assert reader.may_have('ros2:callback_end')
    assert reader.may_have('other:event') == bool(options)


def write_one(path, schema, data, topic='/trace/ros2/callback_end',
              schema_encoding='ros2msg', encoding='cdr', repeat=1):
    with open(path, 'wb') as stream:
        writer = Writer(stream)
        writer.start(profile='ros2')
        number = writer.register_schema('x/msg/X', schema_encoding, schema.encode())
        channel = writer.register_channel(topic, encoding, number)
        for _ in range(repeat):
            writer.add_message(channel, 1, data, 1)
        writer.finish()


PREAMBLE = 'int64 timestamp\nint32 vpid\nint32 vtid\n'
HEAD = ENCAPSULATION + struct.pack('<qii', 1, 2, 3)


@pytest.mark.parametrize('schema, data, expected', [
    # the table's event with its fields elsewhere, more of them, and the preamble in the midst
    ('string more\nuint64 callback\nint32 vtid\nint32 vpid\nint64 timestamp\n',
     ENCAPSULATION + b'\2\0\0\0x\0' + bytes(2) + struct.pack('<QiiQ', 9, 3, 2, 1),
     ('ros2:callback_end', 1, 2, 3, 9)),
    # another size of the same kind
    (PREAMBLE + 'int32 callback\n', HEAD + struct.pack('<i', 9),
     ('ros2:callback_end', 1, 2, 3, 9)),
    # a field is missing
    (PREAMBLE, HEAD, ('ros2:callback_end', 1, 2, 3, None)),
    # padding at the end
    (PREAMBLE + 'uint64 callback', HEAD + struct.pack('<Q4x', 9),
     ('ros2:callback_end', 1, 2, 3, 9)),
])
def test_other_fields_than_the_table(tmp_path, schema, data, expected):
    path = tmp_path / 'a.mcap'
    write_one(path, schema, data)
    assert read(path) == ([expected], [])


def test_an_event_that_is_not_in_the_table(tmp_path):
    path = tmp_path / 'a.mcap'
    write_one(path, PREAMBLE + 'uint8[] gid\nstring[2] names\nfloat32 f\n',
              HEAD + b'\2\0\0\0\x07\x08\0\0' + b'\2\0\0\0a\0\0\0' + b'\2\0\0\0b\0\0\0'
              + struct.pack('<f', 0.5), topic='/trace/other/thing')
    assert list(read_events(path)) == [
        {'_name': 'other:thing', '_timestamp': 1, '_vpid': 2, '_vtid': 3, 'gid': (7, 8),
         'names': ('a', 'b'), 'f': 0.5}]
    reader = TraceReader(path)
    assert list(reader.events({'other:thing'})) == [
        ('other:thing', 1, 2, 3, (7, 8), ('a', 'b'), 0.5)]
    assert reader.fields == {'other:thing': ('gid', 'names', 'f')}
    assert list(reader.events({'ros2:callback_end'})) == []


@pytest.mark.parametrize('options, reason', [
    ({'schema': PREAMBLE + 'std_msgs/Header callback'},
     "type 'std_msgs/Header' is not a primitive"),
    ({'schema': PREAMBLE + 'string callback'}, 'field callback is string instead of uint64'),
    ({'schema': 'int64 timestamp\nuint64 callback'}, 'there is no field vpid'),
    ({'schema': 'string timestamp\nint32 vpid\nint32 vtid\n'}, 'timestamp is string'),
    ({'schema': '\0\1\2'}, 'is not a field'),
    ({'schema': PREAMBLE, 'schema_encoding': 'protobuf'}, "'protobuf' instead of ros2msg"),
    ({'schema': PREAMBLE, 'encoding': 'json'}, "'json' instead of cdr"),
    ({'schema': PREAMBLE, 'data': b'\0\0' + HEAD[2:]}, 'not plain little endian CDR'),
    ({'schema': PREAMBLE, 'data': b''}, 'not plain little endian CDR'),
    ({'schema': PREAMBLE, 'data': HEAD[:-1]}, 'shorter than its fields'),
    ({'schema': PREAMBLE + 'string more', 'data': HEAD}, 'unpack_from requires'),
    ({'schema': PREAMBLE + 'string more', 'data': HEAD + b'\xff\xff\xff\xff'}, 'longer than'),
])
def test_events_that_cannot_be_decoded_are_counted(tmp_path, options, reason):
    path = tmp_path / 'a.mcap'
    write_one(path, **{'data': HEAD + bytes(8), 'repeat': 5, **options})
    events, (warning,) = read(path)
    assert not events and reason in warning
    assert ('left out 5 messages that cannot be decoded, most of them (5) of '
            '/trace/ros2/callback_end: ') in warning
    assert read(path, in_time_order=True) == ([], [warning])
    with pytest.warns(TraceWarning, match='left out 5 messages that cannot'):
        assert list(read_events(path)) == []


def test_names_select(tmp_path):
    path = tmp_path / 'a.mcap'
    recorded = mixture(300)
    write_chunks(path, [recorded[:100], recorded[100:]])
    names = {'ros2:callback_end', 'mddag:task_set', 'no:such'}
    wanted = [event for event in read_back(recorded) if event[0] in names]
    reader = TraceReader(path)
    assert reader.message_count == 300
    for in_time_order in (False, True):
        assert list(reader.events(names, sorted=in_time_order)) == wanted
    assert list(reader.events(set())) == []
    assert reader.warnings == []
