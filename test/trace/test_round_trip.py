# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What is written is what this reader, the mcap package and rosbags read."""

from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader, NonSeekingReader
from mddag_executor.trace import (
    cdr,
    EVENTS,
    EventType,
    read_events,
    TraceError,
    TraceFile,
    TraceReader,
)
from mddag_executor.trace.cdr import decode, FieldType
from mddag_executor.trace.groups import events_of, EXECUTION, PUBLICATION
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

from ..conftest import examples
from .helpers import (
    entries,
    mixture,
    read,
    read_back,
    values,
    VPID,
    write_chunks,
)

ANY_EVENTS = st.lists(st.sampled_from(list(EVENTS.values())).flatmap(entries), max_size=30)


@examples(150)
@given(recorded=ANY_EVENTS)
def test_every_value_comes_back(tmp_path, recorded):
    path = tmp_path / 'a.mcap'
    half = len(recorded) // 2
    write_chunks(path, [recorded[:half], recorded[half:]])
    assert read(path) == (read_back(recorded), [])
    # in the order of time only what can be so near to one another
    recorded = [(name, time % 1_000_000_000, *rest) for name, time, *rest in recorded]
    half = len(recorded) // 2
    write_chunks(path, [recorded[:half], recorded[half:]])
    by_time = sorted(read_back(recorded), key=lambda event: event[1])
    assert read(path, in_time_order=True) == (by_time, [])


def test_mcap_reads_it_and_agrees_with_the_summary(tmp_path):
    path = tmp_path / 'a.mcap'
    recorded = mixture(300)
    recorded[0], recorded[99] = recorded[99], recorded[0]       # out of order within a chunk
    write_chunks(path, [recorded[:100], recorded[100:]])
    data = path.read_bytes()
    found = []
    with open(path, 'rb') as stream:
        for schema, channel, message in NonSeekingReader(
                stream, validate_crcs=True).iter_messages(log_time_order=False):
            _, provider, name = channel.topic[1:].split('/')
            event = EVENTS[f'{provider}:{name}']
            assert (channel.message_encoding, schema.encoding) == ('cdr', 'ros2msg')
            assert schema.data.decode() == event.text
            assert schema.name == 'mddag_trace/msg/' + name.title().replace('_', '')
            assert message.data[:4] == b'\0\1\0\0'
            values = decode(event.types, message.data[4:])
            assert message.log_time == message.publish_time == values[0]
            found.append((event.key, *values))
    assert found == read_back(recorded)
    with open(path, 'rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        header = reader.get_header()
        summary = reader.get_summary()
        assert sum(1 for _ in reader.iter_messages()) == 300
    assert (header.profile, header.library) == ('ros2', 'mddag_executor')
    statistics = summary.statistics
    times = [event[1] for event in recorded]
    assert (statistics.message_count, statistics.chunk_count) == (300, 2)
    assert statistics.channel_count == statistics.schema_count == len(EVENTS)
    assert (statistics.message_start_time, statistics.message_end_time) == (min(times), max(times))
    assert sum(statistics.channel_message_counts.values()) == 300
    for index, part in zip(summary.chunk_indexes, (times[:100], times[100:]), strict=True):
        assert (index.message_start_time, index.message_end_time) == (min(part), max(part))
        assert min(index.message_index_offsets.values()) == (
            index.chunk_start_offset + index.chunk_length)
        for channel, offset in index.message_index_offsets.items():
            assert data[offset] == 7 and data[offset + 9:offset + 11] == channel.to_bytes(
                2, 'little')


def test_events_beyond_the_table_and_rosbags_reads_them(tmp_path):
    path = tmp_path / 'a.mcap'
    extra = [
        # as CARET records a tracepoint of ros2 again, with one field more
        EventType('ros2_caret', 'rcl_node_init', (('node_handle', 'uint64'),
                                                  ('init_timestamp', 'int64'))),
        EventType('ros2', 'rmw_publisher_init', (('gid', 'uint8[16]'), ('more', 'string[]'))),
        # other fields for one of the table
        EventType('ros2', 'rcl_publish', (('message', 'uint64'), ('node', 'string'))),
    ]
    with TraceFile(path) as file:
        keys = [file.define(event) for event in extra]
        file.add(keys[2], 4, VPID, 2, 7, 'n')
        file.add('rcl_node_init', 1, VPID, 2, 3, 4, 'name', '/')
        file.add(keys[0], 2, VPID, 2, 3, -4)
        file.add(keys[1], 3, VPID, 2, range(16), ['a', 'b'])
        with pytest.raises(TraceError, match='15 values for an array of 16'):
            file.add(keys[1], 3, VPID, 2, range(15), [])
    reader = TraceReader(path)
    assert list(reader.events()) == [
        ('ros2:rcl_publish', 4, VPID, 2, None, 7),      # the table's fields, None where missing
        ('ros2:rcl_node_init', 1, VPID, 2, 3, 4, 'name', '/'),
        ('ros2_caret:rcl_node_init', 2, VPID, 2, 3, -4),
        ('ros2:rmw_publisher_init', 3, VPID, 2, tuple(range(16)), ('a', 'b'))]
    assert reader.fields['ros2:rmw_publisher_init'] == ('gid', 'more')
    assert reader.fields['ros2:rcl_publish'] == ('publisher_handle', 'message')
    assert reader.warnings == []
    assert list(read_events(path))[3] == {              # by time; dicts have what the file has
        '_name': 'ros2:rcl_publish', '_timestamp': 4, '_vpid': VPID, '_vtid': 2,
        'message': 7, 'node': 'n'}
    with AnyReader([path]) as rosbags:                  # two schemas of one name would fail here
        assert {connection.msgtype.rpartition('/')[2]: (
            time, message.vpid, message.vtid, message.timestamp)
            for connection, time, data in rosbags.messages()
            for message in [rosbags.deserialize(data, connection.msgtype)]} == {
            'RclNodeInit': (1, VPID, 2, 1), 'Ros2CaretRclNodeInit': (2, VPID, 2, 2),
            'RmwPublisherInit': (3, VPID, 2, 3), 'Ros2RclPublish': (4, VPID, 2, 4)}


def test_add_refuses_what_it_cannot_write(tmp_path):
    path = tmp_path / 'a.mcap'
    with TraceFile(path) as file:
        file.add('callback_end', 1, 2, 3, 4)
        for entry in (('nonsense', 1, 2, 3), ('callback_end', 1, 2, 3),
                      ('callback_end', 1, 2, 3, 4, 5), ('callback_end', 1, 2, 3, -4),
                      ('callback_end', -1, 2, 3, 4), ('callback_end', 1, 2, 2**31, 4)):
            with pytest.raises(TraceError, match=r'a\.mcap: event .* cannot be written .*: give'):
                file.add(*entry)
        file.add('callback_end', 2, 2, 3, 4)
    with pytest.raises(TraceError, match='is closed'):
        file.add('callback_end', 3, 2, 3, 4)
    events, warnings = read(path)
    assert [event[1] for event in events] == [1, 2] and not warnings


def test_a_trace_may_be_empty_or_left_by_an_exception(tmp_path):
    with TraceFile(tmp_path / 'empty.mcap'):
        pass
    assert read(tmp_path / 'empty.mcap') == ([], [])
    assert TraceReader(tmp_path / 'empty.mcap').message_count == 0
    with pytest.raises(KeyError), TraceFile(tmp_path / 'left.mcap') as file:
        file.add('callback_end', 1, 2, 3, 4)
        file.flush()
        raise KeyError
    events, warnings = read(tmp_path / 'left.mcap')
    assert len(events) == 1
    assert len(warnings) == 1 and 'without a finish record' in warnings[0]


def test_optional_fields_of_older_files(tmp_path):
    """What versions before 1.1 wrote of a completion is read with the fields that came later."""
    path = tmp_path / 'a.mcap'
    now = EVENTS['mddag:complete']
    before = EventType(now.provider, now.name, now.fields[:7])
    cases = [
        (before, (), -1, False), (now, (), -1, False), (now, (700, True), 700, True)]
    for event, fields, cpu_time, held in cases:
        with TraceFile(path, overwrite=True) as file:
            key = file.define(event)
            for job in range(3):
                file.add(key, 1000 + job, 1, 2, 5, 0, 1, job, True, 900, 0, *fields)
        read = list(TraceReader(path).events())
        assert [event[7:] for event in read] == [
            (job, True, 900, 0, cpu_time, held) for job in range(3)]


TIME = st.integers(0, 10 ** 9)      # so near to one another that all are possible
ADDRESS = st.integers(0, 2 ** 64 - 1)
SMALL = st.integers(-1, 2 ** 31 - 1)
JOB = st.integers(-1, 2 ** 63 - 1)
EXECUTIONS = st.tuples(
    st.just(EXECUTION), TIME, SMALL, ADDRESS, SMALL, SMALL, JOB, SMALL, TIME, TIME, TIME, TIME,
    st.booleans(), SMALL, TIME, st.booleans())
PUBLICATIONS = st.tuples(st.just(PUBLICATION), TIME, SMALL, ADDRESS, ADDRESS, ADDRESS)
SINGLE = st.tuples(st.just('callback_end'), TIME, SMALL, ADDRESS)


def one_by_one(entry):
    name, time, vtid, *rest = entry
    if name == PUBLICATION:
        publisher, message, header = rest
        return [('rclcpp_publish', time, vtid, publisher, message, header),
                ('rcl_publish', time, vtid, publisher, message)]
    if name != EXECUTION:
        return [entry]
    (callback, dag, vertex, job, worker, ready, deadline, end, completed, whole, leg,
     *computed) = rest
    return [('dispatch', time, vtid, callback, dag, vertex, job, worker, ready, deadline),
            ('callback_start', time, vtid, callback, False),
            ('callback_end', end, vtid, callback),
            ('complete', completed, vtid, callback, dag, vertex, job, whole, end, leg,
             *computed)]


@given(st.lists(EXECUTIONS | PUBLICATIONS | SINGLE, max_size=30), st.integers(1, 40))
def test_a_file_is_the_same_either_way(tmp_path_factory, entries, flush_at):
    folder = tmp_path_factory.mktemp('either')
    singles = [single for entry in entries for single in one_by_one(entry)]
    for name, given_ in (('grouped', entries), ('single', singles)):
        with TraceFile(folder / name) as file:
            for number, entry in enumerate(given_):
                file.extend([entry], VPID)
                if number % flush_at == 0 and name == 'grouped':
                    file.flush()
            assert file.rejected == 0 and file.given == len(singles)
    assert read(folder / 'grouped') == read(folder / 'single')
    assert sum(map(events_of, entries)) == len(singles)


PRIMITIVES = ['bool', 'byte', 'char', 'float32', 'float64', 'int8', 'int16', 'int32', 'int64',
              'uint8', 'uint16', 'uint32', 'uint64', 'string']
TYPES = PRIMITIVES + [base + array for base in PRIMITIVES for array in ('[]', '[3]')]


@st.composite
def messages(draw):
    names = draw(st.lists(st.sampled_from(TYPES), min_size=1, max_size=8))
    return names, [draw(values(FieldType.parse(name))) for name in names]


@examples(300)
@given(messages())
def test_any_flat_message_is_as_rosbags_encodes_it(message):
    names, fields = message
    types = [FieldType.parse(name) for name in names]
    data = cdr.ENCAPSULATION + cdr.encode(types, fields)
    assert cdr.ENCAPSULATION + cdr.Encoder(types)(fields) == data
    decoded = cdr.decode(types, data[4:])
    assert decoded == tuple(fields)

    store = get_typestore(Stores.EMPTY)
    text = ''.join(f'{name} f{place}\n' for place, name in enumerate(names))
    store.register(get_types_from_msg(text, 'x/msg/X'))
    theirs = store.deserialize_cdr(data, 'x/msg/X')
    for place, value in enumerate(fields):
        field = getattr(theirs, f'f{place}')
        assert tuple(field) == value if isinstance(value, tuple) else field == value
    # Fast CDR and rosbags may end a message with padding; what is before it is the same.
    their_data = bytes(store.serialize_cdr(theirs, 'x/msg/X'))
    assert their_data[:len(data)] == data
    assert not any(their_data[len(data):])


def test_text_without_a_valid_encoding_does_not_fail():
    types = [FieldType('string')]
    assert cdr.decode(types, cdr.encode(types, ('a\udc80',))) == ('a\\udc80',)
    assert cdr.decode(types, b'\x03\0\0\0\xff\xfe\0') == ('\\xff\\xfe',)
    assert cdr.decode(types, b'\0\0\0\0') == ('',)      # some writers leave out the NUL


def test_ros2msg():
    text = ('# a comment\nint32 LEVEL=5\nstring NAME = "a # b"\n\nuint8[<=4] few   # bounded\n'
            'string<=10 name "x"\nfloat64[2] pair [0.0, 1.0]\n' + '=' * 80
            + '\nMSG: other/Type\nint32 x\n')
    assert cdr.parse_ros2msg(text) == [
        ('few', FieldType('uint8', -1)), ('name', FieldType('string')),
        ('pair', FieldType('float64', 2))]
    for bad in ('std_msgs/Header header', 'Header header', 'wstring w', 'int32', 'int32<=4 x',
                'int32 x\nint64 x', 'int128 x', 'int32 x['):
        with pytest.raises(ValueError):
            cdr.parse_ros2msg(bad)
