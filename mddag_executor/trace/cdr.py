# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
CDR encoding of flat ROS messages, and their definition as ros2msg text.

Theory of operation: a flat message is a sequence of fields, each a primitive, a string, or an
array or sequence of these. Plain CDR (XCDR1, little endian, used by ROS 2 on the wire and in bags)
begins with a 4-byte encapsulation header; offsets count from its end. Every primitive is aligned
to its own size. A string is its length in bytes with the closing NUL as uint32, the UTF-8 bytes,
the NUL. A sequence is its number of elements as uint32, then the elements; an array has no number.
An empty sequence has no padding for elements (as in Fast CDR and rosbags).

A message of single primitives has a fixed layout, so one `struct.Struct` with padding encodes it;
other messages are encoded field by field.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import re
import struct
from typing import Any

ENCAPSULATION = b'\x00\x01\x00\x00'     # plain CDR, little endian, no options

_CODES = {
    'bool': '?', 'byte': 'B', 'char': 'B', 'float32': 'f', 'float64': 'd',
    'int8': 'b', 'int16': 'h', 'int32': 'i', 'int64': 'q',
    'uint8': 'B', 'uint16': 'H', 'uint32': 'I', 'uint64': 'Q',
}
_SIZES = {base: struct.calcsize('<' + code) for base, code in _CODES.items()}
_UINT32 = struct.Struct('<I')

_TYPE = re.compile(r'([a-z]+[0-9]*)(<=[0-9]+)?(\[(?:<=[0-9]+|([0-9]+))?\])?')
_FIELD = re.compile(r'(\S+)\s+([A-Za-z][A-Za-z0-9_]*)(?:\s+[^=\s].*)?')
_CONSTANT = re.compile(r'\S+\s+[A-Za-z][A-Za-z0-9_]*\s*=.*')


@dataclass(frozen=True)
class FieldType:
    """
    The type of one field: base type and count.

    `count` is None for a single value, -1 for a sequence, otherwise the length of an array.
    """

    base: str
    count: int | None = None

    @classmethod
    def parse(cls, text: str) -> FieldType:
        """
        Return the type of a ros2msg type name.

        Bounds (`string<=10`, `uint8[<=4]`) do not change the encoding and are ignored.

        :raises ValueError: for a nested message, a wstring or any other type that is not flat
        """
        match = _TYPE.fullmatch(text)
        if match is None:
            raise ValueError(f'type {text!r} is not a primitive')
        base, bound, array, length = match.groups()
        if base != 'string' and (base not in _CODES or bound):
            raise ValueError(f'type {text!r} is not a primitive')
        if array is None:
            return cls(base)
        return cls(base, int(length) if length else -1)

    @property
    def kind(self) -> str:
        """Return the Python type of values: int, float, bool, str or tuple."""
        if self.count is not None:
            return 'tuple'
        return {'string': 'str', 'bool': 'bool', 'float32': 'float',
                'float64': 'float'}.get(self.base, 'int')

    def write(self, out: bytearray, value: Any) -> None:
        """Append a value, with the padding before it."""
        if self.count is None:
            self._write_values(out, (value,))
            return
        if self.count < 0:
            _align(out, 4)
            out += _UINT32.pack(len(value))
        elif len(value) != self.count:
            raise ValueError(f'{len(value)} values for an array of {self.count}')
        self._write_values(out, value)

    def _write_values(self, out: bytearray, values: Sequence[Any]) -> None:
        if self.base == 'string':
            for value in values:
                # Text that is not valid Unicode (a path, for example) must not lose the event.
                text = value.encode('utf-8', 'backslashreplace')
                _align(out, 4)
                out += _UINT32.pack(len(text) + 1) + text + b'\0'
        elif values:
            _align(out, _SIZES[self.base])
            out += struct.pack(f'<{len(values)}{_CODES[self.base]}', *values)

    def read(self, data: bytes, position: int) -> tuple[Any, int]:
        """
        Return the value at a position and the position after it.

        :raises ValueError, struct.error: if the data is too short
        """
        if self.count is None:
            values, position = self._read_values(data, position, 1)
            return values[0], position
        count = self.count
        if count < 0:
            position += -position % 4
            count, = _UINT32.unpack_from(data, position)
            position += 4
        return self._read_values(data, position, count)

    def _read_values(self, data: bytes, position: int, count: int) -> tuple[tuple[Any, ...], int]:
        if count == 0:
            return (), position
        if self.base == 'string':
            texts = []
            # ends early for a wrong count: each element needs 4 bytes or raises
            for _ in range(count):
                text, position = _read_string(data, position)
                texts.append(text)
            return tuple(texts), position
        size = _SIZES[self.base]
        position += -position % size
        end = position + count * size
        if end > len(data):             # checked before struct allocates memory for the length
            raise ValueError('the message is shorter than its fields')
        return struct.unpack_from(f'<{count}{_CODES[self.base]}', data, position), end


def _align(out: bytearray, size: int) -> None:
    out += bytes(-len(out) % size)


def _read_string(data: bytes, position: int) -> tuple[str, int]:
    position += -position % 4
    length, = _UINT32.unpack_from(data, position)
    position += 4
    end = position + length
    if end > len(data):
        raise ValueError('a string is longer than its message')
    if length and data[end - 1]:
        raise ValueError('a string does not end with NUL')
    return data[position:max(position, end - 1)].decode('utf-8', 'backslashreplace'), end


def fixed_layout(types: Sequence[FieldType]) -> str | None:
    """Return the struct format of a message of single primitives, None for any other message."""
    layout = []
    position = 0
    for kind in types:
        if kind.count is not None or kind.base == 'string':
            return None
        padding = -position % _SIZES[kind.base]
        position += padding + _SIZES[kind.base]
        layout.append('x' * padding + _CODES[kind.base])
    return ''.join(layout)


def fixed_places(types: Sequence[FieldType]) -> tuple[list[tuple[str, int]], int] | None:
    """
    Return numpy's name and the offset of each field, and the size, of a message of known size.

    :returns: None if a field is a string or a sequence, whose size is not known.
    """
    places, position = list[tuple[str, int]](), 0
    for kind in types:
        count = 1 if kind.count is None else kind.count
        if kind.base == 'string' or count < 1:
            return None
        size = _SIZES[kind.base]
        position += -position % size
        code = f'<{_CODES[kind.base]}'
        places.append((code if kind.count is None else f'({count},){code}', position))
        position += size * count
    return places, position


def encode(types: Sequence[FieldType], values: Sequence[Any]) -> bytes:
    """
    Return the message without its encapsulation header.

    :raises ValueError, struct.error, TypeError, AttributeError: if a value does not fit
    """
    if len(values) != len(types):
        raise ValueError(f'{len(values)} values for {len(types)} fields')
    out = bytearray()
    for kind, value in zip(types, values):
        kind.write(out, value)
    return bytes(out)


class Encoder:
    """
    Encodes messages of some types; those of equal lengths are packed at once.

    Calling it is `encode`, which takes five times as long.
    """

    _MOST = 1000        # lengths whose layout is kept

    def __init__(self, types: Sequence[FieldType]) -> None:
        self._types = types
        self._pack: dict[tuple[int, ...], Callable[..., bytes]] = {}
        self._texts = [kind.base == 'string' for kind in types]
        self._simple = not any(kind.base == 'string' and kind.count is not None for kind in types)

    def __call__(self, values: Sequence[Any]) -> bytes:
        """Return the message without its encapsulation header."""
        types = self._types
        if not self._simple or len(values) != len(types):
            return encode(types, values)
        sizes: list[int] = []
        flat: list[Any] = []
        for kind, is_text, value in zip(types, self._texts, values):
            if is_text:
                text = value.encode('utf-8', 'backslashreplace')
                sizes.append(len(text))
                flat += (len(text) + 1, text)
            elif kind.count is None:
                flat.append(value)
            else:
                sizes.append(len(value))
                if kind.count < 0:
                    flat.append(len(value))
                elif len(value) != kind.count:
                    raise ValueError(f'{len(value)} values for an array of {kind.count}')
                flat += value
        key = tuple(sizes)
        pack = self._pack.get(key)
        if pack is None:
            if len(self._pack) >= self._MOST:
                self._pack.clear()
            pack = self._pack[key] = struct.Struct(self._layout(sizes)).pack
        return pack(*flat)

    def _layout(self, sizes: Sequence[int]) -> str:
        """Return the struct format of a message with strings and sequences of some lengths."""
        layout, position, lengths = ['<'], 0, iter(sizes)

        def add(size: int, code: str, count: int = 1) -> None:
            nonlocal position
            padding = -position % size
            layout.append('x' * padding + f'{count}{code}')
            position += padding + size * count

        for kind in self._types:
            if kind.base == 'string':
                count = next(lengths) + 1
                add(4, 'I')
                layout.append(f'{count}s')      # a NUL fills it
                position += count
                continue
            count = 1 if kind.count is None else next(lengths)
            if kind.count is not None and kind.count < 0:
                add(4, 'I')
            if count:
                add(_SIZES[kind.base], _CODES[kind.base], count)
        return ''.join(layout)


def decode(types: Sequence[FieldType], data: bytes) -> tuple[Any, ...]:
    """
    Return the values of a message without encapsulation header.

    :raises ValueError, struct.error: if the data is too short for the types
    """
    values = []
    position = 0
    for kind in types:
        value, position = kind.read(data, position)
        values.append(value)
    return tuple(values)


def parse_ros2msg(text: str) -> list[tuple[str, FieldType]]:
    """
    Return the fields of a flat message definition.

    Comments, constants, default values, and further message definitions after a line of `=` are
    ignored.

    :raises ValueError: if a field is not flat or a line is not a field
    """
    fields = []
    for line in text.splitlines():
        line = line.partition('#')[0].strip()
        if line.startswith('====='):
            break
        if not line or _CONSTANT.fullmatch(line):
            continue
        match = _FIELD.fullmatch(line)
        if match is None:
            raise ValueError(f'line {line[:40]!r} is not a field')
        fields.append((match[2], FieldType.parse(match[1])))
    if len({name for name, _ in fields}) != len(fields):
        raise ValueError('a field is there twice')
    return fields
