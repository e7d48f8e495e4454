# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Reads the metadata of a CTF 2 trace: the types of its packets and events, in JSON.

Source: the Common Trace Format 2.0 (https://diamon.org/ctf).

1. The metadata is a sequence of JSON objects, the *fragments*, each after a byte 0x1E.  A fragment
   describes the trace, its clock, a stream, a kind of event, or names a type for later ones.
2. The types of the specification are read, except those that neither LTTng nor Babeltrace writes:
   optional fields, integers of a variable length, and texts that are not UTF-8.  A trace that has
   one of them is refused, with its name.
3. A member of the head of a packet or event has a *role*, which says what it means.  It gets the
   name that LTTng gives to such a member (`ctf_types`); a member that has such a name without the
   role gets another one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import json
from typing import Any, NoReturn

from mddag_executor.trace.ctf_types import (
    alignment_of,
    array,
    Clock,
    DEEPEST,
    EventClass,
    Float,
    Integer,
    Location,
    Metadata,
    MetadataError,
    NS,
    size_of,
    StreamClass,
    Struct,
    structure,
    Text,
    Type,
    variant,
)

_SEPARATOR = '\x1e'
_CLOCK = 'default-clock-timestamp'
_NAMES = {
    'packet-magic-number': 'magic', 'metadata-stream-uuid': 'uuid',
    'data-stream-class-id': 'stream_id', 'data-stream-id': 'stream_instance_id',
    'packet-total-length': 'packet_size', 'packet-content-length': 'content_size',
    'packet-end-default-clock-timestamp': 'timestamp_end',
    'packet-sequence-number': 'packet_seq_num',
    'discarded-event-record-counter-snapshot': 'events_discarded',
    'event-record-class-id': 'id'}
"""The names of members by their roles; `_CLOCK` has one for packets and one for events."""
_HEADS = {'packet-header': '', 'packet-context': 'timestamp_begin',
          'event-record-header': 'timestamp'}
"""The structures whose members have roles, and the name of the role `_CLOCK` in them."""
_ORIGINS = (*_HEADS, 'event-record-common-context', 'event-record-specific-context',
            'event-record-payload')
_FLOATS = (32, 64)
_MOST_RANGES = 5000
_MOST_TYPES = 2 ** 17           # as LTTng writes them, the largest text has fewer
_Object = Mapping[str, Any]


def is_ctf2(text: str) -> bool:
    """Return whether a metadata text is that of CTF 2."""
    return text.startswith(_SEPARATOR)


def parse_ctf2(text: str) -> Metadata:
    """
    Return what a metadata text says.

    :raises MetadataError: if it is not understood
    """
    try:
        return _Parser().parse(text)
    except RecursionError:
        raise MetadataError('its types are nested too deep') from None


def _fragments(text: str) -> Iterator[_Object]:
    """Yield the fragments of a metadata text."""
    for number, part in enumerate(text.split(_SEPARATOR)[1:], 1):
        try:
            found = json.loads(part)
        except ValueError:
            raise MetadataError(f'its fragment {number} is cut, or not JSON') from None
        if not isinstance(found, dict):
            raise MetadataError(f'its fragment {number} is not a JSON object')
        yield found


def _wrong(what: str, found: _Object) -> NoReturn:
    name = str(found.get('name', found.get('type', '')))[:40]
    raise MetadataError(f'it is not understood: {what} in {name!r}')


def _value(found: _Object, key: str, default: Any = None) -> Any:
    """Return a value that has to be there, if there is no default."""
    if key not in found and default is None:
        _wrong(f'{key!r} is missing', found)
    return found.get(key, default)


def _is_integer(value: Any) -> bool:
    return type(value) is int and -2 ** 63 <= value < 2 ** 64


def _number(found: _Object, key: str, default: int | None = None) -> int:
    value: int = _value(found, key, default)
    if not _is_integer(value):
        _wrong(f'{key!r} is not an integer of 64 bits', found)
    return value


def _text(found: _Object, key: str, default: str | None = None) -> str:
    value = _value(found, key, default)
    if not isinstance(value, str):
        _wrong(f'{key!r} is not text', found)
    return value


def _objects(found: _Object, key: str) -> Sequence[_Object]:
    value = _value(found, key, [])
    if not isinstance(value, list) or not all(isinstance(each, dict) for each in value):
        _wrong(f'{key!r} is not an array of objects', found)
    return value


def _object(found: _Object, key: str) -> _Object:
    value = _value(found, key, {})
    if not isinstance(value, dict):
        _wrong(f'{key!r} is not an object', found)
    return value


class _Parser:
    """Makes types of fragments, one after another."""

    def __init__(self) -> None:
        self._found = Metadata()
        self._aliases: dict[str, Any] = {}
        self._clocks: dict[str, Clock] = {}
        self._depth = self._count = 0           # of types
        self._origin = ''                       # the structure that is read
        self._renamed: dict[str, dict[str, str]] = {}   # by origin the members with a new name

    def parse(self, text: str) -> Metadata:
        """Return what all fragments say."""
        kinds = {
            'preamble': self._preamble, 'field-class-alias': self._alias,
            'trace-class': self._trace, 'clock-class': self._clock,
            'data-stream-class': self._stream, 'event-record-class': self._event}
        for number, fragment in enumerate(_fragments(text)):
            kind = _text(fragment, 'type')
            if (kind == 'preamble') != (number == 0):
                raise MetadataError('it does not begin with its only preamble')
            if kind not in kinds:
                _wrong(f'the type {kind!r}', fragment)
            kinds[kind](fragment)
        return self._found

    # --- fragments -------------------------------------------------------------------------------

    def _preamble(self, fragment: _Object) -> None:
        version = _number(fragment, 'version')
        if version != 2:
            raise MetadataError(f'it is of version {version} of CTF')
        if fragment.get('extensions'):
            _wrong('extensions are not read', fragment)
        uuid = fragment.get('uuid', [])
        if not isinstance(uuid, list) or not all(
                _is_integer(each) and 0 <= each < 256 for each in uuid):
            _wrong('no UUID', fragment)
        self._found.uuid = bytes(uuid).hex()

    def _alias(self, fragment: _Object) -> None:
        name = _text(fragment, 'name')
        if name in self._aliases:
            _wrong('two types have one name', fragment)
        self._aliases[name] = _value(fragment, 'field-class')

    def _trace(self, fragment: _Object) -> None:
        self._found.environment.update({
            name: str(value) for name, value in _object(fragment, 'environment').items()})
        self._found.packet_header = self._scope(fragment, 'packet-header')

    def _clock(self, fragment: _Object) -> None:
        frequency = size_of(_number(fragment, 'frequency'), 2 ** 33)
        offset = _object(fragment, 'offset-from-origin')
        self._clocks[_text(fragment, 'id')] = Clock(
            frequency, _number(offset, 'seconds', 0) * NS
            + _number(offset, 'cycles', 0) * NS // frequency, _text(fragment, 'uid', ''))

    def _stream(self, fragment: _Object) -> None:
        number = _number(fragment, 'id', 0)
        if number in self._found.streams:
            raise MetadataError(f'two streams have the number {number}')
        if 'default-clock-class-id' in fragment:
            clock = self._clocks.get(_text(fragment, 'default-clock-class-id'))
            if clock is None:
                _wrong('its clock is unknown', fragment)
            if self._found.streams and clock != self._found.clock:
                raise MetadataError('its streams have several clocks')
            self._found.clock = clock
        self._found.streams[number] = StreamClass(
            self._scope(fragment, 'packet-context'), self._scope(fragment, 'event-record-header'),
            self._scope(fragment, 'event-record-common-context'))

    def _event(self, fragment: _Object) -> None:
        stream = self._found.streams.get(_number(fragment, 'data-stream-class-id', 0))
        number = _number(fragment, 'id', 0)
        if stream is None:
            raise MetadataError(f'event {fragment.get("name", "")!r} is of no stream')
        if number in stream.events:
            raise MetadataError(f'two events of a stream have the number {number}')
        stream.events[number] = EventClass(
            _text(fragment, 'name', ''),
            self._scope(fragment, 'event-record-specific-context', 'specific-context'),
            self._scope(fragment, 'event-record-payload', 'payload'))

    def _scope(self, fragment: _Object, origin: str, key: str = '') -> Struct | None:
        """Return the structure with a name that a fragment has; None: it has none."""
        given = fragment.get(f'{key or origin}-field-class')
        if given is None:
            return None
        self._origin, self._renamed[origin] = origin, {}
        found = self._type(given)
        if not isinstance(found, Struct):
            _wrong(f'{origin!r} is not a structure', fragment)
        return found

    # --- types -----------------------------------------------------------------------------------

    def _type(self, given: Any) -> Type:
        """Return a type, which may be given by its name."""
        found = self._class_of(given)
        self._depth += 1
        self._count += 1
        if self._depth > DEEPEST:
            raise MetadataError('its types are nested too deep')
        if self._count > _MOST_TYPES:
            raise MetadataError(f'it has more than {_MOST_TYPES} types')
        made = self._made(_text(found, 'type'), found)
        self._depth -= 1
        return made

    def _class_of(self, given: Any) -> _Object:
        for _ in range(DEEPEST):
            if isinstance(given, str):
                if given not in self._aliases:
                    raise MetadataError(f'there is no type {given[:40]!r}')
                given = self._aliases[given]
            else:
                break
        if not isinstance(given, dict):
            raise MetadataError(f'{str(given)[:40]!r} is not a type')
        return given

    def _made(self, kind: str, found: _Object) -> Type:
        if kind in ('fixed-length-unsigned-integer', 'fixed-length-signed-integer',
                    'fixed-length-bit-array', 'fixed-length-bit-map', 'fixed-length-boolean'):
            return self._integer(found, kind == 'fixed-length-signed-integer')
        if kind == 'fixed-length-floating-point-number':
            bits = _number(found, 'length')
            if bits not in _FLOATS:
                raise MetadataError(
                    'it has floating-point numbers other than of 32 and 64 bits')
            return Float(bits, self._alignment(found), self._is_big(found))
        if _text(found, 'encoding', 'utf-8') != 'utf-8':
            _wrong('a text that is not UTF-8', found)
        if kind == 'null-terminated-string':
            return Text()
        if kind in ('static-length-string', 'dynamic-length-string'):
            return self._array(found, Integer(8, 8, text=True))
        if kind in ('static-length-blob', 'dynamic-length-blob'):
            return self._array(found, Integer(8, 8))
        if kind in ('static-length-array', 'dynamic-length-array'):
            return self._array(found, self._type(_value(found, 'element-field-class')))
        if kind == 'structure':
            return self._structure(found)
        if kind == 'variant':
            return self._variant(found)
        _wrong(f'the type {kind!r} is not read', found)

    def _integer(self, found: _Object, signed: bool) -> Integer:
        return Integer(
            size_of(_number(found, 'length'), 64), self._alignment(found), signed,
            self._is_big(found), clock=_CLOCK in self._roles(found))

    def _alignment(self, found: _Object, key: str = 'alignment') -> int:
        return alignment_of(_number(found, key, 1))

    def _is_big(self, found: _Object) -> bool:
        order = _text(found, 'byte-order')
        if order not in ('little-endian', 'big-endian'):
            _wrong('no byte order', found)
        big = order == 'big-endian'
        if found.get('bit-order', bits := ('first-to-last', 'last-to-first')[big]) != bits:
            _wrong('the order of bits is not that of bytes', found)
        return big

    def _roles(self, found: _Object) -> Sequence[str]:
        roles = found.get('roles', [])
        if not isinstance(roles, list) or not all(isinstance(each, str) for each in roles):
            _wrong("'roles' is not an array of texts", found)
        return roles

    def _array(self, found: _Object, element: Type) -> Type:
        least = self._alignment(found, 'minimum-alignment')
        if 'length-field-location' in found:
            return array(element, -1, self._location(_object(found, 'length-field-location')),
                         least)
        count = _number(found, 'length')
        return array(element, size_of(count, 2 ** 32) if count else 0, None, least)

    def _structure(self, found: _Object) -> Struct:
        members: dict[str, Type] = {}
        for member in _objects(found, 'member-classes'):
            given = _value(member, 'field-class')
            name = self._name(_text(member, 'name'), given)
            if name in members:
                _wrong('two members have one name', found)
            members[name] = self._type(given)
        return structure(members, self._alignment(found, 'minimum-alignment'))

    def _name(self, name: str, given: Any) -> str:
        """Return the name of a member, which its role gives if it has one."""
        clock = _HEADS.get(self._origin)
        if clock is None:
            return name
        meant = {**_NAMES, **({_CLOCK: clock} if clock else {})}
        names = [meant[role] for role in self._roles(self._class_of(given)) if role in meant]
        new = names[0] if names else f'{name}_' if name in meant.values() else name
        self._renamed[self._origin][name] = new
        return new

    def _variant(self, found: _Object) -> Type:
        ranges: list[tuple[str, int, int]] = []
        options: dict[str, Type] = {}
        for number, option in enumerate(_objects(found, 'options')):
            name = _text(option, 'name', f'option {number}')
            if name in options:
                _wrong('two options have one name', found)
            options[name] = self._type(_value(option, 'field-class'))
            given = _value(option, 'selector-field-ranges')
            for bounds in given if isinstance(given, list) else [given]:
                if not isinstance(bounds, list) or len(bounds) != 2 or not all(
                        map(_is_integer, bounds)):
                    _wrong('no range of integers', option)
                ranges.append((name, *bounds))
        if not 0 < len(ranges) <= _MOST_RANGES:
            _wrong(f'{len(ranges)} ranges', found)
        return variant(
            self._location(_object(found, 'selector-field-location')), options, tuple(ranges))

    def _location(self, found: _Object) -> Location:
        path, origin = _value(found, 'path'), _text(found, 'origin', '')
        if origin and origin not in _ORIGINS:
            _wrong('an unknown origin', found)
        above = 0
        while isinstance(path, list) and path[:1] == [None]:
            path, above = path[1:], above + 1
        if not isinstance(path, list) or not path or not all(
                isinstance(each, str) for each in path):
            _wrong('no path', found)
        renamed = self._renamed.get(origin or self._origin, {})
        names = [str(each) for each in path]
        return Location(tuple(renamed.get(each, each) for each in names), origin, above)
