# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Where the fields of CTF events are: two ways to read them.

1. *Runs.*  The fields of an event are runs of fields of known sizes, and texts and sequences
   between them.  A run has a layout: the place of each field.  Many events become columns at
   once, when it is known where each run begins.  Alignment is relative to the packet, so there is
   a layout for each place of a run within 8 bytes.  Nearly every event at run time is one run.
2. *Readers.*  Anything else (variants, arrays of structures) is read event by event.  Whatever a
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
Unpacker = tuple[int, Callable[[bytes, int], tuple[Any, ...]]]
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
    Where fields of a known size are, which follow each other.

    :ivar size: their size in bits.
    :ivar paths: their names.
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
        """Return the fields at some places as rows."""
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

    def unpacker(self, path: Path) -> Unpacker | None:
        """Return where an integer is, and what reads it; None: it is not of whole bytes."""
        place = self._places[path]
        if place.mask or place.kind[1:] not in _NUMPY:
            return None
        return place.offset, struct.Struct(place.kind[0] + _NUMPY[place.kind[1:]]).unpack_from


class _NoLayout(Exception):
    """A structure has fields whose places cannot be found without reading them."""


class _Leaf(NamedTuple):
    """A field that has no fields, and the alignment of what begins with it."""

    path: Path
    kind: Type
    align: int


class Tail(NamedTuple):
    """
    A field of unknown size: a text, or an array whose number of elements is a field.

    :ivar code: numpy's name of an element; empty: it is a text that ends with NUL.
    :ivar size: bytes of an element.
    :ivar text: whether the elements are characters.
    """

    path: Path
    align: int
    code: str = ''
    size: int = 1
    text: bool = False


class Run:
    """
    Fields of a known size, and the field of unknown size that follows them, if any.

    :ivar paths: the names of the fields of a known size.
    :ivar tail: the field of unknown size.
    :ivar sizes: by place (bytes modulo 8) how many bytes there are before the tail, or before what
        follows the last field.
    :ivar counts: of an array by place: where the number of its elements is, and how it is read.
    """

    def __init__(self, leaves: Sequence[_Leaf], tail: Tail | None, length: Path, rest: int
                 ) -> None:
        self.paths = [leaf.path for leaf in leaves]
        self.tail = tail
        self.layouts = [_layout(leaves, place, rest) for place in range(_PLACES)]
        #: Whether the fields are in the same bytes at all places.
        self._is_even = rest <= 8 and all(leaf.align <= 8 for leaf in leaves)
        align = max(8, tail.align) if tail else 8
        self.sizes = [aligned(place * 8 + layout.size, align) // 8 - place
                      for place, layout in enumerate(self.layouts)]
        self._unpackers: dict[Path, list[Unpacker]] = {}
        self.counts = self.unpackers(length) if length else []

    @property
    def is_whole(self) -> bool:
        """Return whether what follows begins with a byte."""
        return all(layout.size % 8 == 0 for layout in self.layouts)

    def unpackers(self, path: Path) -> list[Unpacker]:
        """Return by place where an integer is, and what reads it; empty: it is of some bits."""
        if path not in self._unpackers:
            found = [layout.unpacker(path) for layout in self.layouts]
            self._unpackers[path] = [each for each in found if each] if all(found) else []
        return self._unpackers[path]

    def ends(self, begins: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return where the tail begins, or what follows the last field, by begin of the fields."""
        found: npt.NDArray[np.int64] = begins + np.array(self.sizes, dtype=np.int64)[begins & 7]
        return found

    def columns(self, data: Bytes, begins: npt.NDArray[np.int64], paths: Sequence[Path]
                ) -> list[npt.NDArray[Any]]:
        """Return fields as columns; ``begins`` are the places of the first ones."""
        if self._is_even or not len(begins):
            return self._columns(data, begins, paths, 0)
        places = begins & 7
        found: list[npt.NDArray[Any]] = []
        for place in np.flatnonzero(np.bincount(places)).tolist():
            mine = np.flatnonzero(places == place)
            if len(mine) == len(begins):
                return self._columns(data, begins, paths, place)
            parts = self._columns(data, begins[mine], paths, place)
            found = found or [np.empty((len(begins), *part.shape[1:]), part.dtype)
                              for part in parts]
            for column, part in zip(found, parts):
                column[mine] = part
        return found

    def _columns(self, data: Bytes, begins: npt.NDArray[np.int64], paths: Sequence[Path],
                 place: int) -> list[npt.NDArray[Any]]:
        layout = self.layouts[place]
        rows = layout.rows(data, begins)
        return [layout.column(rows, path) for path in paths]


_PLACES = 8
_NUMPY = {f'{sign}{size}': code.upper() if sign == 'u' else code
          for sign in 'iu' for size, code in ((1, 'b'), (2, 'h'), (4, 'i'), (8, 'q'))}


@lru_cache(65536)
def runs_of(kind: Struct) -> tuple[Run, ...] | None:
    """
    Return the runs that a structure consists of; all but the last have tails.

    :returns: None if fields have to be read one by one: variants, or arrays of structures.
    """
    leaves: list[_Leaf] = []
    rest = _flatten(kind, (), 1, leaves)
    if max([rest, *(leaf.align for leaf in leaves)]) > 8 * _PLACES:
        return None     # places depend on more than the place modulo 8
    runs, fields = [], list[_Leaf]()
    try:
        for leaf in leaves:
            tail, length = _tail(leaf, fields)
            if tail is None:
                fields.append(leaf)
            else:
                runs.append(Run(fields, tail, length, 1))
                fields = []
        runs.append(Run(fields, None, (), rest))
    except _NoLayout:
        return None
    return tuple(runs)


def _flatten(kind: Type, path: Path, align: int, leaves: list[_Leaf]) -> int:
    """
    Add the fields of a type that have no fields.

    :param align: of what begins at the same place.
    :returns: the alignment of what follows, before its own.
    """
    align = max(align, kind.align)
    if isinstance(kind, Struct):
        for name, inner in kind.members:
            align = _flatten(inner, (*path, name), align, leaves)
        return align
    leaves.append(_Leaf(path, kind, align))
    return 1


def _tail(leaf: _Leaf, before: Sequence[_Leaf]) -> tuple[Tail | None, Path]:
    """
    Return the field as a tail, and the field that has the number of its elements.

    :param before: the fields of known sizes just before it.
    :returns: None if it has a known size itself.
    """
    kind = leaf.kind
    if isinstance(kind, Text):
        return Tail(leaf.path, leaf.align), ()
    if not isinstance(kind, Array) or kind.length is None:
        return None, ()
    names, origin, above = kind.length
    length = (*leaf.path[:-1], names[0])
    number = next((each.kind for each in before if each.path == length), None)
    element = kind.element
    code = _code(element) if isinstance(element, Integer) else None
    if (len(names) > 1 or origin or above > 0 or not isinstance(number, Integer)
            or _code(number) is None or code is None or element.align > smallest(element)):
        raise _NoLayout
    return Tail(leaf.path, leaf.align, code, smallest(element) // 8, kind.text), length


def _layout(leaves: Sequence[_Leaf], start: int, rest: int) -> Layout:
    """Return the layout of fields, the first of which begins at a place (bytes modulo 8)."""
    places: list[_Place] = []
    at = start * 8
    for path, kind, align in leaves:
        at = aligned(at, align)
        places.append(_place(kind, at, path, at // 8 - start))
        at += smallest(kind)
    return Layout(places, aligned(at, rest) - start * 8)


def _place(kind: Type, at: int, path: Path, offset: int) -> _Place:
    """Return the place of a field; ``at`` is its bit, and ``offset`` its byte from the begin."""
    if isinstance(kind, Enumeration):
        kind = kind.container
    if isinstance(kind, Integer):
        size = kind.bits
        code = _code(kind)
        if code and at % 8 == 0:
            return _Place(path, offset, code)
        width = -(-(at % 8 + size) // 8)
        width = next((bytes_ for bytes_ in (1, 2, 4, 8) if bytes_ >= width), 0)
        if not width or kind.signed and size == 64:
            raise _NoLayout
        shift = width * 8 - at % 8 - size if kind.big else at % 8
        return _Place(path, offset, f'{">" if kind.big else "<"}u{width}', shift,
                      (1 << size) - 1, 1 << size - 1 if kind.signed else 0)
    if isinstance(kind, Float) and at % 8 == 0:
        return _Place(path, offset, f'{">" if kind.big else "<"}f{kind.bits // 8}')
    if isinstance(kind, Array) and 0 < kind.count < 2 ** 20 and at % 8 == 0:
        element = kind.element
        code = _code(element) if isinstance(element, Integer) else None
        if code is not None and element.align <= smallest(element):
            return _Place(path, offset,
                          f'S{kind.count}' if kind.text else f'({kind.count},){code}')
    raise _NoLayout


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
