# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Where the fields of CTF events are: two ways to read them.

1. *Layouts.*  A structure whose size is known, as that of nearly every event at run time, has a
   layout: the place of each field.  Many such events become columns at once.  Alignment is
   relative to the packet, so there is a layout for each place of an event within 8 bytes.
2. *Readers.*  Anything else (texts, sequences, variants) is read event by event.  Whatever a
   reader reads is checked against the end of the packet's content first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
import json
import struct
from typing import Any, NamedTuple

from mddag_executor.trace.ctf_types import (
    Array,
    Enumeration,
    Float,
    Integer,
    Location,
    smallest,
    Struct,
    Text,
    Type,
    Variant,
)
import numpy as np
import numpy.typing as npt

Path = tuple[str, ...]
Bytes = npt.NDArray[np.uint8]

_CODES = {(8, False): 'B', (8, True): 'b', (16, False): 'H', (16, True): 'h',
          (32, False): 'I', (32, True): 'i', (64, False): 'Q', (64, True): 'q'}


class Damaged(ValueError):
    """An event that cannot be read."""


def aligned(at: int, align: int) -> int:
    """Return the first place from another on that is a multiple of an alignment."""
    return at + -at % align


# --- fields of messages --------------------------------------------------------------------------


class Field(NamedTuple):
    """
    A field of an event as a trace has it.

    :ivar kind: its type in ros2msg.
    :ivar path: the names that lead to it.
    :ivar as_text: whether it becomes JSON text, because messages have no such type.
    """

    name: str
    kind: str
    path: Path
    as_text: bool


@lru_cache(4096)
def fields_of(kind: Struct | None) -> tuple[Field, ...]:
    """
    Return the fields of a structure; nested structures are flattened.

    Types are those of ros2msg: integers by sign and size, `float32`, `float64`, `string`, arrays
    and sequences of these.  Other types (variants, arrays of structures) become text.
    """
    return tuple(_fields(kind, ())) if kind is not None else ()


def _fields(kind: Struct, above: Path) -> list[Field]:
    found = []
    for name, inner in kind.members:
        path = (*above, name)
        if isinstance(inner, Struct):
            found += _fields(inner, path)
            continue
        base = _message_type(inner)
        if base is None and isinstance(inner, Array):
            base = _message_type(inner.element)
            base = base and f'{base}[{max(0, inner.count) or ""}]'
        found.append(Field('_'.join(path), base or 'string', path, base is None))
    return found


def _message_type(kind: Type) -> str | None:
    """Return the ros2msg type of a primitive; None for anything else."""
    if isinstance(kind, Enumeration):
        kind = kind.container
    if isinstance(kind, Integer):
        bits = next(bits for bits in (8, 16, 32, 64) if bits >= kind.bits)
        return f'{"" if kind.signed else "u"}int{bits}'
    if isinstance(kind, Float):
        return f'float{kind.bits}'
    return 'string' if isinstance(kind, Text) or isinstance(kind, Array) and kind.text else None


# --- layouts -------------------------------------------------------------------------------------


class _Place(NamedTuple):
    """
    Where a field is: its bytes, and within them its bits.

    :ivar sign: the value of the highest bit of a signed field of some bits; 0: none.
    """

    path: Path
    offset: int
    kind: str
    shift: int = 0
    mask: int = 0
    sign: int = 0


class Layout:
    """
    Where the fields of structures of a known size are.

    :ivar size: their size in bits.
    :ivar paths: their fields.
    """

    def __init__(self, places: Sequence[_Place], size: int) -> None:
        self.size = size
        self.paths = [place.path for place in places]
        self._places = {place.path: place for place in places}
        #: Bytes that are looked at, which may be more than those that are used.
        self.width = max([-(-size // 8), *(
            place.offset + np.dtype(place.kind).itemsize for place in places)])
        self._type = np.dtype({
            'names': [str(number) for number in range(len(places))],
            'formats': [place.kind for place in places],
            'offsets': [place.offset for place in places], 'itemsize': max(1, self.width)})
        self._number = {path: str(number) for number, path in enumerate(self.paths)}

    def rows(self, data: Bytes, starts: npt.NDArray[np.int64]) -> npt.NDArray[Any]:
        """Return the structures at some places as rows."""
        width = self._type.itemsize
        if len(data) < width:
            return np.zeros(0, self._type)
        windows = np.lib.stride_tricks.sliding_window_view(data, width)
        return windows[starts].view(self._type).reshape(len(starts))

    def column(self, rows: npt.NDArray[Any], path: Path) -> npt.NDArray[Any]:
        """Return a field of rows, in the byte order of this machine."""
        place, values = self._places[path], rows[self._number[path]]
        values = values.astype(values.dtype.newbyteorder('='))
        if place.mask:
            values = (values >> np.uint64(place.shift)).astype(np.uint64) & np.uint64(place.mask)
            if place.sign:
                values = (values ^ np.uint64(place.sign)).astype(np.int64) - place.sign
        return values


class _NoLayout(Exception):
    """A structure has no fixed size."""


@lru_cache(65536)
def layout_of(kinds: tuple[Struct | None, ...], start: int) -> Layout | None:
    """
    Return the layout of structures, one after another; None if their size is not known.

    :param start: the place of the first, bytes modulo 8.
    """
    places: list[_Place] = []
    at = start * 8
    try:
        for kind in kinds:
            if kind is not None:
                at = _place(kind, at, (), start, places)
    except _NoLayout:
        return None
    return Layout(places, at - start * 8)


def _place(kind: Type, at: int, path: Path, start: int, places: list[_Place]) -> int:
    """Note where a field and those in it are, and return the bit after it."""
    at = aligned(at, kind.align)
    offset = at // 8 - start
    if isinstance(kind, Struct):
        for name, inner in kind.members:
            at = _place(inner, at, (*path, name), start, places)
        return at
    if isinstance(kind, Enumeration):
        kind = kind.container
    if isinstance(kind, Integer):
        size = kind.bits
        code = _code(kind)
        if code and at % 8 == 0:
            places.append(_Place(path, offset, code))
        else:
            width = -(-(at % 8 + size) // 8)
            width = next((bytes_ for bytes_ in (1, 2, 4, 8) if bytes_ >= width), 0)
            if not width or kind.signed and size == 64:
                raise _NoLayout
            shift = width * 8 - at % 8 - size if kind.big else at % 8
            places.append(_Place(
                path, offset, f'{">" if kind.big else "<"}u{width}', shift, (1 << size) - 1,
                1 << size - 1 if kind.signed else 0))
    elif isinstance(kind, Float) and at % 8 == 0:
        size = kind.bits
        places.append(_Place(path, offset, f'{">" if kind.big else "<"}f{size // 8}'))
    elif isinstance(kind, Array) and 0 < kind.count < 2 ** 20 and at % 8 == 0:
        element = kind.element
        size = kind.count * smallest(element)
        code = _code(element) if isinstance(element, Integer) else None
        if code is None or element.align > smallest(element):
            raise _NoLayout
        places.append(_Place(
            path, offset, f'S{kind.count}' if kind.text else f'({kind.count},){code}'))
    else:
        raise _NoLayout
    return at + size


def _code(kind: Integer) -> str | None:
    """Return numpy's name of an integer of whole bytes; None for one of some bits."""
    if kind.bits not in (8, 16, 32, 64) or kind.align % 8:
        return None
    return f'{">" if kind.big else "<"}{"i" if kind.signed else "u"}{kind.bits // 8}'


# --- readers -------------------------------------------------------------------------------------


class Cursor:
    """
    A place in a packet's content.

    :ivar at: the place, in bits, and ``end`` that of the end.
    :ivar scopes: the fields of the structures read so far, outer ones first.
    :ivar origins: the places in ``scopes`` of those that have a name (``Location.origin``).
    """

    __slots__ = ('at', 'data', 'end', 'origins', 'scopes')

    def __init__(self, data: bytes, at: int, end: int) -> None:
        self.data, self.at, self.end = data, at, end
        self.scopes: list[dict[str, Any]] = []
        self.origins: dict[str, int] = {}

    def read(self, origin: str, reader: Reader) -> dict[str, Any]:
        """Read the structure with a name, whose fields later ones may refer to."""
        self.origins[origin] = len(self.scopes)
        found: dict[str, Any] = reader(self)
        self.scopes.append(found)
        return found

    def take(self, align: int, size: int) -> int:
        """Return the place of something, and go behind it."""
        at = aligned(self.at, align)
        if at + size > self.end:
            raise Damaged('an event is cut')
        self.at = at + size
        return at

    def find(self, location: Location, prefix: str = '') -> Any:
        """
        Return the value of a field that an array or a variant refers to.

        :param prefix: of the last name.
        """
        path, origin, above = location
        *names, last = path
        names.append(prefix + last)
        if origin:
            scopes = self.scopes[self.origins.get(origin, len(self.scopes)):][:1]
        elif above >= 0:
            scopes = self.scopes[::-1][above:][:1]
        else:
            scopes = self.scopes[::-1]
        for found in scopes:
            if names[0] in found:
                for name in names:
                    found = found[name]
                return found
        raise Damaged(f'there is no field {".".join(path)!r}')


Reader = Callable[[Cursor], Any]
_LABEL = '<label of>'


@lru_cache(65536)
def reader_of(kind: Type) -> Reader:
    """Return the function that reads a type."""
    if isinstance(kind, Integer):
        return _integer_reader(kind)
    if isinstance(kind, Enumeration):
        return reader_of(kind.container)
    if isinstance(kind, Float):
        unpack = struct.Struct(('>' if kind.big else '<') + ('f' if kind.bits == 32 else 'd'))
        align, bits = aligned(kind.align, 8), kind.bits
        return lambda cursor: unpack.unpack_from(
            cursor.data, cursor.take(align, bits) // 8)[0]
    if isinstance(kind, Text):
        return _read_text
    if isinstance(kind, Array):
        return _array_reader(kind)
    if isinstance(kind, Struct):
        return _struct_reader(kind)
    return _variant_reader(kind)


def _integer_reader(kind: Integer) -> Reader:
    align, bits = kind.align, kind.bits
    code = _CODES.get((bits, kind.signed))
    if code and align % 8 == 0:
        unpack = struct.Struct(('>' if kind.big else '<') + code).unpack_from
        return lambda cursor: unpack(cursor.data, cursor.take(align, bits) // 8)[0]
    order = 'big' if kind.big else 'little'
    mask, sign = (1 << bits) - 1, 1 << bits - 1 if kind.signed else 0

    def read(cursor: Cursor) -> int:
        at = cursor.take(align, bits)
        last = -(-(at + bits) // 8)
        value = int.from_bytes(cursor.data[at // 8:last], order)  # type: ignore[arg-type]
        shift = last * 8 - at - bits if kind.big else at % 8
        return ((value >> shift & mask) ^ sign) - sign

    return read


def _read_text(cursor: Cursor) -> str:
    start = cursor.take(8, 0) // 8
    end = cursor.data.find(b'\0', start, cursor.end // 8)
    if end < 0:
        raise Damaged('a text is cut')
    cursor.at = (end + 1) * 8
    return cursor.data[start:end].decode('utf-8', 'backslashreplace')


def text_of(data: bytes) -> str:
    """Return the text in an array of characters."""
    return data.split(b'\0', 1)[0].decode('utf-8', 'backslashreplace')


def _array_reader(kind: Array) -> Reader:
    count, length, element, align = kind.count, kind.length, kind.element, kind.align
    least = smallest(element)
    one = reader_of(element)

    def size(cursor: Cursor) -> int:
        found = count if length is None else cursor.find(length)
        cursor.take(align, 0)
        if not isinstance(found, int) or not 0 <= found <= (cursor.end - cursor.at) // least:
            raise Damaged('an array is longer than its event')
        return found

    if kind.text:
        def read_text(cursor: Cursor) -> str:
            number = size(cursor)
            start = cursor.take(8, number * 8) // 8
            return text_of(cursor.data[start:start + number])

        return read_text
    return lambda cursor: [one(cursor) for _ in range(size(cursor))]


def _struct_reader(kind: Struct) -> Reader:
    align = kind.align
    members = [(name, reader_of(inner), inner if isinstance(inner, Enumeration) else None)
               for name, inner in kind.members]

    def read(cursor: Cursor) -> dict[str, Any]:
        cursor.take(align, 0)
        found: dict[str, Any] = {}
        cursor.scopes.append(found)
        for name, one, enumeration in members:
            value = found[name] = one(cursor)
            if enumeration is not None:
                found[_LABEL + name] = enumeration.label(value)
        cursor.scopes.pop()
        return found

    return read


def _variant_reader(kind: Variant) -> Reader:
    options: dict[Any, Reader] = {name: reader_of(inner) for name, inner in kind.options}
    tag, ranges = kind.tag, kind.ranges

    def read(cursor: Cursor) -> Any:
        if ranges:
            value = cursor.find(tag)
            name = next((name for name, low, high in ranges if low <= value <= high), None)
        else:
            name = cursor.find(tag, _LABEL)
        option = options.get(name)
        if option is None:
            raise Damaged('a variant of an unknown kind')
        return option(cursor)

    return read


def plain(value: Any) -> Any:
    """Return any value as one that JSON can hold, without names of an enumeration's values."""
    if isinstance(value, dict):
        return {name: plain(inner) for name, inner in value.items()
                if not name.startswith(_LABEL)}
    return [plain(inner) for inner in value] if isinstance(value, list) else value


def values_of(fields: Sequence[Field], found: dict[str, Any]) -> tuple[Any, ...]:
    """Return the fields of a structure that was read."""
    values = []
    for field in fields:
        value: Any = found
        for name in field.path:
            value = value[name]
        values.append(json.dumps(plain(value)) if field.as_text else value)
    return tuple(values)
