# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""CDR against rosbags' implementation, and its layouts by hand."""

from __future__ import annotations

import struct
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from mddag_executor.trace import cdr
from mddag_executor.trace.cdr import FieldType
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

from .helpers import values

PRIMITIVES = ['bool', 'byte', 'char', 'float32', 'float64', 'int8', 'int16', 'int32', 'int64',
              'uint8', 'uint16', 'uint32', 'uint64', 'string']
TYPES = PRIMITIVES + [base + array for base in PRIMITIVES for array in ('[]', '[3]')]


@st.composite
def messages(draw: Any) -> tuple[list[str], list[Any]]:
    names = draw(st.lists(st.sampled_from(TYPES), min_size=1, max_size=8))
    return names, [draw(values(FieldType.parse(name))) for name in names]


@settings(max_examples=300, deadline=None)
@given(messages())
def test_any_flat_message_is_as_rosbags_encodes_it(message: tuple[list[str], list[Any]]) -> None:
    names, fields = message
    types = [FieldType.parse(name) for name in names]
    data = cdr.ENCAPSULATION + cdr.encode(types, fields)
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


def test_alignment_by_hand() -> None:
    types = [FieldType.parse(name) for name in ('uint8', 'uint64', 'string', 'int16', 'float64[]')]
    assert cdr.encode(types, (1, 2, 'ä', -1, ())) == (
        b'\x01' + bytes(7) + b'\x02' + bytes(7)             # padding before the uint64
        + b'\x03\0\0\0' + 'ä'.encode() + b'\0' + b'\0'      # string with NUL, padding
        + b'\xff\xff' + bytes(2) + bytes(4))                # an empty sequence aligns its length
    assert cdr.fixed_layout([FieldType.parse('bool'), FieldType.parse('int64')]) == '?xxxxxxxq'
    assert cdr.fixed_layout(types) is None


def test_text_without_a_valid_encoding_does_not_fail() -> None:
    types = [FieldType('string')]
    assert cdr.decode(types, cdr.encode(types, ('a\udc80',))) == ('a\\udc80',)
    assert cdr.decode(types, b'\x03\0\0\0\xff\xfe\0') == ('\\xff\\xfe',)
    assert cdr.decode(types, b'\0\0\0\0') == ('',)      # some writers leave out the NUL


@pytest.mark.parametrize('kind, data', [
    ('string', b'\x05\0\0\0ab\0'),              # longer than the message
    ('string', b'\x02\0\0\0ab'),                # no NUL
    ('string', b'\xff\xff\xff\xff'),
    ('uint64[]', b'\xff\xff\xff\xff' + bytes(60)),
    ('string[]', b'\xff\xff\xff\xff' + bytes(60)),
    ('float64[100000000000]', bytes(64)),
])
def test_lengths_beyond_the_data_are_refused(kind: str, data: bytes) -> None:
    with pytest.raises((ValueError, struct.error)):
        cdr.decode([FieldType.parse(kind)], data)


def test_ros2msg() -> None:
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


def test_values_that_do_not_fit_are_refused() -> None:
    for kind, value in (('uint64', -1), ('int32', 2**31), ('int64', 'x'), ('string', 5),
                        ('uint8[2]', (1,)), ('int32', None)):
        with pytest.raises((ValueError, TypeError, AttributeError, struct.error)):
            cdr.encode([FieldType.parse(kind)], (value,))
    assert np.uint64(7) in cdr.decode([FieldType('uint64')],
                                      cdr.encode([FieldType('uint64')], (np.uint64(7),)))
