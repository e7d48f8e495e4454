# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Sessions as LTTng records them, by a small CTF 1.8 writer, and a stand-in for babeltrace2."""

import struct
import sys

from mddag_executor.trace import ctf

CLOCK_OFFSET = 1_732_000_000_000_000_000
MAGIC = 0xC1FC1FC1

_HEAD = """/* CTF 1.8 */
typealias integer {{ size = 32; align = 8; signed = false; }} := uint32_t;
typealias integer {{ size = 64; align = 8; signed = false; }} := uint64_t;
trace {{
  major = 1; minor = 8; byte_order = le;
  packet.header := struct {{ uint32_t magic; uint32_t stream_id; }};
}};
clock {{ name = monotonic; {boot}freq = 1000000000; offset = {offset}; absolute = true; }};
typealias integer {{ size = 64; align = 8; map = clock.monotonic.value; }} := time_t;
stream {{
  id = 0;
  packet.context := struct {{ time_t timestamp_begin; time_t timestamp_end; uint64_t content_size;
    uint64_t packet_size; uint64_t events_discarded; }};
  event.header := struct {{ uint32_t id; time_t timestamp; }};
  event.context := struct {{ {context} }};
}};
{environment}"""
_INT = 'integer { size = %d; align = 8; signed = %s; }'
TYPES = {
    'u64': (_INT % (64, 'false'), 'Q'), 'i64': (_INT % (64, 'true'), 'q'),
    'u32': (_INT % (32, 'false'), 'I'), 'i32': (_INT % (32, 'true'), 'i'),
    'u8': (_INT % (8, 'false'), 'B'),
    'f64': ('floating_point { exp_dig = 11; mant_dig = 53; byte_order = le; align = 8; }', 'd'),
}
CONTEXT = f'{TYPES["i32"][0]} _vpid; {TYPES["i32"][0]} _vtid; string _procname;'


_HELPER = """\
import json, os, sys
for row in {rows}:
    print(json.dumps(row))
sys.stdout.flush()
{then}
"""


def stand_in(folder, monkeypatch, rows, then=''):
    """Make a folder that looks like a session, of which the importer's helper prints rows."""
    folder.mkdir()
    (folder / 'metadata').write_text('/* CTF 1.8 */')
    (folder / 'helper.py').write_text(_HELPER.format(rows=rows, then=then))
    monkeypatch.setattr(ctf, '_HELPER', folder / 'helper.py')
    monkeypatch.setattr(ctf, 'interpreters', lambda: ['/nowhere/python', sys.executable])
    return folder


def session(folder, kinds, events, *, context=True, discarded=0, environment=None, boot=None):
    """
    Write a trace into a new folder and return it.

    :param kinds: names and fields of the events; types are those of `TYPES`, `str`, `TYPE[n]`
        and `TYPE[]`
    :param events: place in `kinds`, time since the clock's offset, pid, tid, procname, values
    :param discarded: events that the tracer says to have discarded in the second of two packets
    :param environment: what LTTng writes into the metadata, such as the hostname
    :param boot: the UUID of the clock, which is that of the host's boot
    """
    folder.mkdir(parents=True)
    lines = ''.join(f'  {name} = "{value}";\n' for name, value in (environment or {}).items())
    text = _HEAD.format(
        offset=CLOCK_OFFSET, boot=f'uuid = "{boot}"; ' if boot else '',
        context=CONTEXT if context else '',
        environment=f'env {{\n{lines}}};\n' if lines else '')
    for number, (name, fields) in enumerate(kinds):
        text += (f'event {{ name = "{name}"; id = {number}; stream_id = 0; fields := struct {{ '
                 + ' '.join(_declared(*field) for field in fields) + ' }; };\n')
    (folder / 'metadata').write_text(text)
    half = len(events) // 2 if discarded else len(events)
    data = _packet(kinds, events[:half], context, 0)
    if discarded:
        data += _packet(kinds, events[half:], context, discarded)
    (folder / 'channel_0').write_bytes(data if events else b'')
    return folder


def _declared(name, kind):
    if kind == 'str':
        return f'string _{name};'
    base, bracket, length = kind.partition('[')
    if not bracket:
        return f'{TYPES[base][0]} _{name};'
    if length == ']':
        return f'{TYPES["u32"][0]} __{name}_length; {TYPES[base][0]} _{name}[ __{name}_length ];'
    return f'{TYPES[base][0]} _{name}[{length};'


def _packed(kind, value):
    if kind == 'str':
        return value.encode() + b'\0'
    base, bracket, length = kind.partition('[')
    code = TYPES[base][1]
    if not bracket:
        return struct.pack('<' + code, value)
    head = struct.pack('<I', len(value)) if length == ']' else b''
    return head + struct.pack(f'<{len(value)}{code}', *value)


def _packet(kinds, events, context, discarded):
    body = b''
    for kind, time, pid, tid, procname, *values in events:
        body += struct.pack('<IQ', kind, time)
        if context:
            body += struct.pack('<ii', pid, tid) + procname.encode() + b'\0'
        body += b''.join(_packed(field[1], value)
                         for field, value in zip(kinds[kind][1], values))
    times = [event[1] for event in events] or [0]
    bits = (8 + 40 + len(body)) * 8
    return struct.pack('<IIQQQQQ', MAGIC, 0, times[0], times[-1], bits, bits, discarded) + body
