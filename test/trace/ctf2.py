# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Rewrites the metadata of CTF 1.8 sessions as LTTng 2.15 writes it in CTF 2."""

import json
import struct
import uuid

from mddag_executor.trace.ctf_types import (
    Array,
    Enumeration,
    Float,
    Integer,
    Struct,
    Text,
    Variant,
)
from mddag_executor.trace.tsdl import parse_tsdl

_MAGIC = 0x75D11D57
ROLES = {
    'magic': 'packet-magic-number', 'uuid': 'metadata-stream-uuid',
    'stream_id': 'data-stream-class-id', 'stream_instance_id': 'data-stream-id',
    'timestamp_begin': 'default-clock-timestamp', 'timestamp': 'default-clock-timestamp',
    'timestamp_end': 'packet-end-default-clock-timestamp',
    'content_size': 'packet-content-length', 'packet_size': 'packet-total-length',
    'packet_seq_num': 'packet-sequence-number',
    'events_discarded': 'discarded-event-record-counter-snapshot', 'id': 'event-record-class-id'}
PAYLOAD = 'event-record-payload'


def to_ctf2(folder, *, packets=False, renamed=str):
    """
    Rewrite the metadata of all traces in a folder; the packets of events stay.

    :param packets: whether the metadata is in packets itself, as LTTng writes it
    :param renamed: returns the new name of a member whose role says what it means
    """
    for path in folder.rglob('metadata'):
        text = fragments(_text_of(path.read_bytes()), renamed)
        data = text.encode()
        path.write_bytes(_packet(data[:700]) + _packet(data[700:]) if packets else data)
    return folder


def fragments(text, renamed=str):
    """Return a metadata text of CTF 1.8 as one of CTF 2."""
    found = parse_tsdl(text)
    typed = _Types(renamed)
    number = uuid.UUID(found.uuid) if found.uuid else None
    seconds, cycles = divmod(found.clock.offset, 10 ** 9)
    out = [
        {'type': 'preamble', 'version': 2,
         **({'uuid': list(number.bytes)} if number else {})},
        {'type': 'field-class-alias', 'name': 'pkt-header',
         'field-class': typed.head(found.packet_header, 'packet-header')},
        {'type': 'trace-class', 'namespace': 'lttng.org,2009', 'name': '',
         **({'uid': str(number)} if number else {}), 'environment': {
             name: int(value) if value.isdigit() else value
             for name, value in found.environment.items()},
         'packet-header-field-class': 'pkt-header'},
        {'type': 'clock-class', 'id': 'monotonic', 'name': 'monotonic',
         'description': 'Monotonic Clock', 'frequency': found.clock.frequency,
         **({'uid': found.clock.uuid} if found.clock.uuid else {}), 'origin': 'unix-epoch',
         'offset-from-origin': {
             'seconds': seconds, 'cycles': cycles * found.clock.frequency // 10 ** 9}}]
    for key, stream in found.streams.items():
        out += [
            {'type': 'field-class-alias', 'name': f'pkt-ctx-{key}',
             'field-class': typed.head(stream.packet_context, 'packet-context')},
            {'type': 'data-stream-class', 'id': key, 'default-clock-class-id': 'monotonic',
             'packet-context-field-class': f'pkt-ctx-{key}',
             'event-record-header-field-class': typed.head(
                 stream.header, 'event-record-header'),
             **typed.scope('event-record-common-context', stream.context)}]
        for event_key, event in stream.events.items():
            out.append({
                'type': 'event-record-class', 'data-stream-class-id': key, 'id': event_key,
                'name': event.name, 'attributes': {'lttng.org,2009': {'log-level': 'info'}},
                **typed.scope('event-record-specific-context', event.context,
                              'specific-context'),
                **typed.scope(PAYLOAD, event.payload, 'payload')})
    return ''.join(f'\x1e{json.dumps(each, indent=2)}\n' for each in out)


class _Types:
    """Types as JSON."""

    def __init__(self, renamed):
        self._renamed = renamed
        self._origin = ''
        self._roles = False

    def head(self, kind, origin):
        """Return a structure whose members have roles."""
        self._origin, self._roles = origin, True
        return self._of(kind, ())

    def scope(self, origin, kind, key=''):
        """Return the property with a structure, if there is one."""
        self._origin, self._roles = origin, False
        return {} if kind is None else {f'{key or origin}-field-class': self._of(kind, ())}

    def _name(self, name):
        return self._renamed(name) if self._roles and name in ROLES else name

    def _of(self, kind, above, name=''):
        """
        Return a type.

        :param above: the structures around it.
        """
        role = {'roles': [ROLES[name]]} if self._roles and name in ROLES else {}
        if isinstance(kind, Integer):
            sign = 'signed' if kind.signed else 'unsigned'
            return {'type': f'fixed-length-{sign}-integer', 'length': kind.bits,
                    **_order(kind), 'preferred-display-base': 10, **role}
        if isinstance(kind, Enumeration):
            mappings = {}
            for label, low, high in kind.labels:
                mappings.setdefault(label, []).append([low, high])
            return {**self._of(kind.container, above, name), 'mappings': mappings}
        if isinstance(kind, Float):
            return {'type': 'fixed-length-floating-point-number', 'length': kind.bits,
                    **_order(kind)}
        if isinstance(kind, Text):
            return {'type': 'null-terminated-string'}
        if isinstance(kind, Array):
            return {**self._array(kind, above), **role}
        if isinstance(kind, Struct):
            return {'type': 'structure', 'minimum-alignment': kind.align, 'member-classes': [
                {'name': self._name(each),
                 'field-class': self._of(inner, (*above, kind), each)}
                for each, inner in kind.members]}
        assert isinstance(kind, Variant)
        labels = dict(above[-1].members)[kind.tag.path[-1]].labels
        return {
            'type': 'variant', 'selector-field-location': self._location(kind.tag, above),
            'options': [
                {'name': each, 'field-class': self._of(inner, above),
                 'selector-field-ranges': [
                     [low, high] for label, low, high in labels if label == each]}
                for each, inner in kind.options]}

    def _array(self, kind, above):
        if kind.length is None:
            place, size = 'static', {'length': kind.count}
        else:
            place = 'dynamic'
            size = {'length-field-location': self._location(kind.length, above)}
        if kind.text:
            return {'type': f'{place}-length-string', **size}
        if kind.length is None and kind.element == Integer(8, 8):
            return {'type': 'static-length-blob', **size}
        return {'type': f'{place}-length-array', 'minimum-alignment': kind.element.align,
                'element-field-class': self._of(kind.element, above), **size}

    def _location(self, location, above):
        """Return a location: in payloads from their beginning, otherwise from the structure."""
        path = [self._name(each) for each in location.path]
        if self._origin == PAYLOAD and len(above) == 1:
            return {'origin': self._origin, 'path': path}
        return {'path': path}


def _order(kind):
    return {'byte-order': 'big-endian' if kind.big else 'little-endian',
            **({'alignment': kind.align} if kind.align > 1 else {})}


def _text_of(data):
    """Return a metadata text without the heads of its packets."""
    order = next((order for order in '<>' if data[:4] == struct.pack(f'{order}I', _MAGIC)), None)
    if order is None:
        return data.decode()
    text, at = b'', 0
    while at < len(data):
        content, size = struct.unpack_from(f'{order}II', data, at + 24)
        text += data[at + 37:at + content // 8]
        at += size // 8
    return text.decode()


def _packet(data):
    bits = (37 + len(data)) * 8
    return struct.pack('<I16sIII5B', _MAGIC, bytes(16), 0, bits, bits + 24, 0, 0, 0, 2, 0
                       ) + data + bytes(3)
