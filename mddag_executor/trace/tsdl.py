# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Reads the metadata of a CTF 1.8 trace: the types of its packets and events, in TSDL.

Source: the Common Trace Format 1.8.3 (https://diamon.org/ctf/v1.8.3).  Read is what LTTng writes:
type aliases, named and nested structures, variants, enumerations, arrays and sequences.  Names
lose a leading underscore, which LTTng puts there.
"""

from __future__ import annotations

from collections import ChainMap
import re
from typing import TypeVar

from mddag_executor.trace.ctf_types import (
    alignment_of,
    Array,
    array,
    Clock,
    DEEPEST,
    Enumeration,
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
    Variant,
    variant,
)

_TOKEN = re.compile(
    r'/\*.*?\*/|//[^\n]*|\s+|("(?:[^"\\\n]|\\.)*"|:=|\.\.\.|->|[A-Za-z_][A-Za-z0-9_]*'
    r'|[0-9][0-9A-Za-z]*|\S)', re.DOTALL)
_ODD = frozenset('!"#$%&\'*+/?@\\^`|~')     # outside of texts and comments
_CONTROL = re.compile(r'[\0-\x08\x0e-\x1f\x7f]')
_WORD = re.compile(r'[A-Za-z_][A-Za-z0-9_]*')
_NUMBER = re.compile(r'-?(0[xX][0-9a-fA-F]{1,16}|0[bB][01]{1,64}|[0-9]{1,20})[uUlL]{0,3}')
_ESCAPE = re.compile(r'\\(.)', re.DOTALL)
_SCOPES = frozenset({'trace', 'stream', 'event', 'packet', 'env'})

# What a block of this kind says, and which names of integers are its own.
_Attributes = dict[str, str]
_Names = ChainMap[str, Type]
_T = TypeVar('_T', Struct, Variant, Enumeration)


def parse_tsdl(text: str) -> Metadata:
    """
    Return what a metadata text says.

    :raises MetadataError: if it is not understood
    """
    if _CONTROL.search(text):
        raise MetadataError('it has control characters')
    tokens = [token for token in _TOKEN.findall(text) if token]
    odd = _ODD.intersection(tokens)
    if odd:
        raise MetadataError(f'it has {min(odd)} where it cannot be')
    return _Parser(tokens).parse()


def _plain(name: str) -> str:
    """Return a member's name without LTTng's underscore."""
    return name[1:] if name[:1] == '_' and len(name) > 1 else name


def _unquoted(text: str) -> str:
    return _ESCAPE.sub(r'\1', text[1:-1]) if text[:1] == '"' else text


def _number(text: str) -> int:
    match = _NUMBER.fullmatch(text)
    if match is None:
        raise MetadataError(f'{text[:40]!r} is not a number')
    digits = match[1]
    value = int(digits, 8) if re.fullmatch(r'0[0-7]+', digits) else int(digits, 0) if (
        digits[1:2].isalpha()) else int(digits)
    return -value if text.startswith('-') else value


def _size(text: str, most: int) -> int:
    return size_of(_number(text), most)


def _alignment(text: str) -> int:
    return alignment_of(_number(text))


class _Parser:
    """Parses tokens by recursive descent."""

    def __init__(self, tokens: list[str]) -> None:
        self._tokens = [*tokens, '']
        self._at = 0
        self._depth = 0
        self._big = self._byte_order()
        self._names: _Names = ChainMap()

    def _byte_order(self) -> bool:
        """Return whether the trace is big-endian: types before its block need to know."""
        tokens = self._tokens
        for at, token in enumerate(tokens):
            if token == 'byte_order' and tokens[at + 1] == '=':
                before, depth = at, 1
                while before and depth:
                    before -= 1
                    depth += (tokens[before] == '}') - (tokens[before] == '{')
                if tokens[before - 1] == 'trace':
                    return self._is_big(tokens[at + 2])
        raise MetadataError('the byte order is missing')

    def _is_big(self, text: str) -> bool:
        if text not in ('le', 'be', 'network', 'native'):
            raise MetadataError(f'{text[:40]!r} is not a byte order')
        return self._big if text == 'native' else text != 'le'

    # --- tokens ----------------------------------------------------------------------------------

    def _error(self, at: int | None = None) -> MetadataError:
        at = self._at if at is None else at
        near = ' '.join(self._tokens[max(0, at - 3):at + 3])
        return MetadataError(f'it is not understood near {near[:80]!r}')

    def _next(self) -> str:
        token = self._tokens[self._at]
        if not token:
            raise MetadataError('it ends early')
        self._at += 1
        return token

    def _peek(self) -> str:
        return self._tokens[self._at]

    def _accept(self, token: str) -> bool:
        if self._tokens[self._at] == token:
            self._at += 1
            return True
        return False

    def _expect(self, token: str) -> None:
        if not self._accept(token):
            raise self._error()

    def _word(self) -> str:
        token = self._next()
        if not _WORD.fullmatch(token):
            raise self._error(self._at - 1)
        return token

    # --- blocks ----------------------------------------------------------------------------------

    def parse(self) -> Metadata:
        """Return what all of the text says."""
        found = Metadata()
        events: list[tuple[int, int, EventClass]] = []
        while self._peek():
            token = self._peek()
            if token in ('trace', 'env', 'clock', 'stream', 'event', 'callsite'):
                self._at += 1
                values, types = self._block()
                self._take(token, values, types, found, events)
                self._accept(';')
            else:
                self._definition()
        for stream, number, event in events:
            if stream not in found.streams:
                raise MetadataError(f'event {event.name!r} is of no stream')
            if number in found.streams[stream].events:
                raise MetadataError(f'two events of a stream have the number {number}')
            found.streams[stream].events[number] = event
        return found

    def _take(self, kind: str, values: _Attributes, types: dict[str, Struct], found: Metadata,
              events: list[tuple[int, int, EventClass]]) -> None:
        if kind == 'trace':
            found.uuid = values.get('uuid', '')
            found.packet_header = types.get('packet.header')
        elif kind == 'env':
            found.environment.update(values)
        elif kind == 'clock':
            frequency = _size(values.get('freq', '1000000000'), 2 ** 33)
            found.clock = Clock(
                frequency, _number(values.get('offset_s', '0')) * NS
                + _number(values.get('offset', '0')) * NS // frequency, values.get('uuid', ''))
        elif kind == 'stream':
            number = _number(values.get('id', '0'))
            if number in found.streams:
                raise MetadataError(f'two streams have the number {number}')
            found.streams[number] = StreamClass(
                types.get('packet.context'), types.get('event.header'),
                types.get('event.context'))
        elif kind == 'event':
            events.append((
                _number(values.get('stream_id', '0')), _number(values.get('id', '0')),
                EventClass(values.get('name', ''), types.get('context'), types.get('fields'))))

    def _block(self) -> tuple[_Attributes, dict[str, Struct]]:
        """Return the values and the structures of a block, by name."""
        values: _Attributes = {}
        types: dict[str, Struct] = {}
        self._expect('{')
        self._names = self._names.new_child()
        while not self._accept('}'):
            at = self._at
            if self._peek() in ('typealias', 'struct', 'variant', 'enum', 'typedef'):
                self._definition()
                continue
            name = self._next()
            while self._accept('.'):
                name += '.' + self._word()
            if self._accept('='):
                values[_unquoted(name)] = self._value()
            elif self._accept(':='):
                kind = self._type()
                if not isinstance(kind, Struct):
                    raise self._error(at)
                types[name] = kind
            else:
                raise self._error(at)
            self._expect(';')
        self._names = self._names.parents
        return values, types

    def _value(self) -> str:
        parts = [_unquoted(self._next())]
        while self._peek() not in (';', ''):
            parts.append(self._next())
        return ''.join(parts)

    # --- types -----------------------------------------------------------------------------------

    def _definition(self) -> None:
        """Take a named type."""
        at = self._at
        if self._accept('typealias'):
            kind = self._type()
            self._expect(':=')
            name = self._word()
            while self._peek() != ';':
                name += ' ' + self._word()
            self._names[name] = kind
        elif self._peek() in ('struct', 'variant', 'enum'):
            self._type()
        else:
            raise self._error(at)
        self._expect(';')

    def _type(self) -> Type:
        """Return the type that comes next."""
        self._depth += 1
        if self._depth > DEEPEST:
            raise MetadataError('its types are nested too deep')
        found = self._any_type()
        self._depth -= 1
        return found

    def _any_type(self) -> Type:
        at, word = self._at, self._word()
        if word == 'integer':
            return self._integer(self._attributes())
        if word == 'floating_point':
            return self._float(self._attributes())
        if word == 'string':
            if self._peek() == '{':
                self._attributes()
            return Text()
        if word == 'struct':
            return self._struct()
        if word == 'variant':
            return self._variant()
        if word == 'enum':
            return self._enumeration()
        # a name of several words: as many of them as make a name
        while f'{word} {self._peek()}' in self._names or (
                word not in self._names and _WORD.fullmatch(self._peek() or '-')):
            word += ' ' + self._word()
        if word not in self._names:
            raise self._error(at)
        return self._names[word]

    def _attributes(self) -> _Attributes:
        values, types = self._block()
        if types:
            raise self._error()
        return values

    def _integer(self, values: _Attributes) -> Integer:
        bits = _size(values.get('size', ''), 64)
        return Integer(
            bits, _alignment(values.get('align', '8' if bits % 8 == 0 else '1')),
            values.get('signed', 'false') in ('true', 'TRUE', '1'),
            self._is_big(values.get('byte_order', 'native')),
            values.get('encoding', 'none').upper() in ('UTF8', 'UTF-8', 'ASCII'),
            values.get('map', '').startswith('clock.'))

    def _float(self, values: _Attributes) -> Float:
        bits = {(8, 24): 32, (11, 53): 64}.get((
            _size(values.get('exp_dig', ''), 64), _size(values.get('mant_dig', ''), 128)))
        if bits is None:
            raise MetadataError('it has floating-point numbers other than of 32 and 64 bits')
        return Float(bits, _alignment(values.get('align', '1')),
                     self._is_big(values.get('byte_order', 'native')))

    def _struct(self) -> Struct:
        name = self._name()
        if not self._accept('{'):
            return self._named('struct', name, Struct)
        members, align = self._members(), 1
        if self._accept('align'):
            self._expect('(')
            align = _alignment(self._next())
            self._expect(')')
        return self._define('struct', name, structure(members, align))

    def _variant(self) -> Variant:
        name, tag = self._name(), Location(())
        if self._accept('<'):
            names = [self._word()]
            while self._accept('.'):
                names.append(self._word())
            self._expect('>')
            tag = _location(names)
        if self._accept('{'):
            return self._define('variant', name, variant(tag, self._members()))
        found = self._named('variant', name, Variant)
        return Variant(tag if tag.path else found.tag, found.options, found.leaves)

    def _members(self) -> dict[str, Type]:
        """Return the members of a structure or variant, whose brace is open."""
        members: dict[str, Type] = {}
        self._names = self._names.new_child()
        while not self._accept('}'):
            if self._peek() == 'typealias':
                self._definition()
                continue
            kind = self._member_type()
            name = _plain(self._word())
            lengths = []
            while self._accept('['):
                length = self._next()
                while self._accept('.'):
                    length += '.' + self._word()
                lengths.append(length)
                self._expect(']')
            for length in reversed(lengths):
                kind = _array(kind, length)
            if len(lengths) > DEEPEST or name in members:
                raise self._error()
            self._expect(';')
            members[name] = kind
        self._names = self._names.parents
        return members

    def _member_type(self) -> Type:
        """Return a member's type; the last of several words is the member's name."""
        end = self._at
        while _WORD.fullmatch(self._tokens[end] or '-'):
            end += 1
        words = self._tokens[self._at:end]
        name = ' '.join(words[:-1])
        if len(words) > 1 and name in self._names:
            self._at = end - 1
            return self._names[name]
        return self._type()

    def _enumeration(self) -> Enumeration:
        name = self._name()
        container: Type | None = None
        if self._accept(':'):
            container = self._type()
        if not self._accept('{'):
            return self._named('enum', name, Enumeration)
        if container is None:
            container = self._names.get('int')
        if not isinstance(container, Integer):
            raise self._error()
        labels: list[tuple[str, int, int]] = []
        value = 0
        while not self._accept('}'):
            label = _plain(_unquoted(self._next()))
            if self._accept('='):
                value = last = self._signed()
                if self._accept('...'):
                    last = self._signed()
            else:
                last = value
            labels.append((label, value, last))
            value = last + 1
            if not self._accept(',') and self._peek() != '}':
                raise self._error()
        return self._define('enum', name, Enumeration(container, tuple(labels)))

    def _signed(self) -> int:
        sign = '-' if self._accept('-') else ''
        return _number(sign + self._next())

    def _name(self) -> str:
        return self._next() if _WORD.fullmatch(self._peek() or '-') else ''

    def _define(self, kind: str, name: str, found: _T) -> _T:
        if name:
            self._names[f'{kind} {name}'] = found
        return found

    def _named(self, kind: str, name: str, wanted: type[_T]) -> _T:
        found = self._names.get(f'{kind} {name}')
        if not isinstance(found, wanted):
            raise self._error()
        return found


def _array(element: Type, length: str) -> Array:
    if length[:1].isdigit():
        return array(element, _size(length, 2 ** 32) if _number(length) else 0)
    return array(element, -1, _location(length.split('.')))


def _location(names: list[str]) -> Location:
    """Return the location of a member; that in a scope (`stream.event.header.id`) by its name."""
    return Location(tuple(map(_plain, names[-1:] if names[0] in _SCOPES else names)))
