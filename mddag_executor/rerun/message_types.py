# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Message types: their definitions for a bag, and serialised messages without random bytes.

Theory of operation
-------------------
The middleware does not initialise the bytes between two fields that align the second one, nor
those after the last field. So equal messages have unequal bytes. ``canonical`` walks through a
message (CDR, little endian) and sets these bytes to zero. The walk of a type is made once, from
the fields of its Python class.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
import re
import struct
from typing import Any

from rosidl_parser.definition import (
    AbstractNestedType,
    AbstractWString,
    Array,
    BasicType,
    NamespacedType,
)

HEAD = 4
"""Bytes before the content: how it is encoded."""
_WIDTHS = {
    'boolean': 1, 'octet': 1, 'char': 1, 'int8': 1, 'uint8': 1, 'int16': 2, 'uint16': 2,
    'int32': 4, 'uint32': 4, 'float': 4, 'wchar': 4, 'int64': 8, 'uint64': 8, 'double': 8}
_NAMES = {'boolean': 'bool', 'octet': 'byte', 'float': 'float32', 'double': 'float64'}
_VALUES = re.compile(r'sequence<(.+?)(?:, (\d+))?>|(.+)\[(\d+)\]')
_LENGTH = struct.Struct('<I')

Walk = Callable[[bytearray, int], int]
"""Sets what is between fields to zero from a place on; returns where the field ends."""


def type_name(kind: Any) -> str:
    """Return the name of a message class, as ``std_msgs/msg/Header``."""
    package, folder = kind.__module__.split('.')[:2]
    return f'{package}/{folder}/{kind.__name__}'


def canonical(data: bytes, kind: Any) -> bytes:
    """Return a serialised message with nothing in it that is not of its fields."""
    filled = bytearray(data)
    end = _walk_of(kind)(filled, HEAD)
    return bytes(filled[:end])


@cache
def _walk_of(kind: Any) -> Walk:
    walks = [_walk(slot) for slot in kind.SLOT_TYPES] or [_values(1, None, 1)]

    def walk(data: bytearray, at: int) -> int:
        for each in walks:
            at = each(data, at)
        return at

    return walk


def _align(data: bytearray, at: int, width: int) -> int:
    gap = (HEAD - at) % width
    if gap:
        data[at:at + gap] = bytes(gap)
    return at + gap


def _walk(slot: Any, count: int | None = 1) -> Walk:
    """Return the walk over this many values of a type; None: their number comes first."""
    if isinstance(slot, AbstractNestedType):
        return _walk(slot.value_type, slot.size if isinstance(slot, Array) else None)
    if isinstance(slot, BasicType):
        return _values(_WIDTHS[slot.typename], None, count)
    one = _walk_of(_class_of(slot)) if isinstance(slot, NamespacedType) else _values(
        4 if isinstance(slot, AbstractWString) else 1, None, None)
    return one if count == 1 else _values(0, one, count)


def _class_of(slot: Any) -> Any:
    return getattr(import_module('.'.join(slot.namespaces)), slot.name)


def _values(width: int, walk_one: Walk | None, count: int | None) -> Walk:
    """Return the walk over numbers of a width, or over other values."""
    def walk(data: bytearray, at: int) -> int:
        n = count
        if n is None:
            at = _align(data, at, 4)
            n = int(_LENGTH.unpack_from(data, at)[0])
            at += 4
        if walk_one is None:
            return _align(data, at, width) + width * n if n else at
        for _ in range(n):
            at = walk_one(data, at)
        return at

    return walk


# --- definitions ---------------------------------------------------------------------------------

@cache
def definition(kind: Any) -> str:
    """Return the definition of a message type with all that it consists of, as bags have it."""
    parts = [_own_definition(kind)]
    known = {kind}
    waiting = _inner(kind)
    while waiting:
        inner = waiting.pop(0)
        if inner not in known:
            known.add(inner)
            name = type_name(inner).replace('/msg/', '/')
            parts.append(f'{"=" * 80}\nMSG: {name}\n{_own_definition(inner)}')
            waiting += _inner(inner)
    return ''.join(parts)


def _own_definition(kind: Any) -> str:
    fields = kind.get_fields_and_field_types()
    return ''.join(f'{_text(described)} {name}\n' for name, described in fields.items())


def _inner(kind: Any) -> list[Any]:
    slots = (getattr(slot, 'value_type', slot) for slot in kind.SLOT_TYPES)
    return [_class_of(slot) for slot in slots if isinstance(slot, NamespacedType)]


def _text(described: str) -> str:
    """Return a field's type as a definition has it: ``double[<=3]`` of ``sequence<double, 3>``."""
    values = _VALUES.fullmatch(described)
    if values is None:
        return _NAMES.get(described, described.replace('string<', 'string<=').rstrip('>'))
    sequence, bound, array, size = values.groups()
    return f'{_text(sequence or array)}[{size or (f"<={bound}" if bound else "")}]'
