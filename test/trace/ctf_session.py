# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Sessions as LTTng records them, by a small CTF 1.8 writer."""

import struct

CLOCK_OFFSET = 1_732_000_000_000_000_000
MAGIC = 0xC1FC1FC1

METADATA = """/* CTF 1.8 */
typealias integer {{ size = 32; align = 8; signed = false; }} := uint32_t;
typealias integer {{ size = 64; align = 8; signed = false; }} := uint64_t;
typealias integer {{ size = 64; align = 8; signed = false; }} := unsigned long;
trace {{
  major = 1; minor = 8; byte_order = {order};
  packet.header := struct {{ uint32_t magic; uint32_t stream_id; }};
}};
clock {{ name = monotonic; {boot}freq = 1000000000; offset = {offset}; absolute = true; }};
typealias integer {{ size = 64; align = 8; map = clock.monotonic.value; }} := time_t;
typealias integer {{ size = 27; align = 1; map = clock.monotonic.value; }} := uint27_time_t;
typealias integer {{ size = 32; align = 8; map = clock.monotonic.value; }} := uint32_time_t;
typealias integer {{ size = 16; align = 8; signed = false; }} := uint16_t;
typealias integer {{ size = 5; align = 1; signed = false; }} := uint5_t;
stream {{
  id = 0;
  packet.context := struct {{ time_t timestamp_begin; time_t timestamp_end; uint64_t content_size;
    uint64_t packet_size; uint64_t packet_seq_num; unsigned long events_discarded; }};
  event.header := {head};
  event.context := struct {{ {context} }};
}};
{environment}"""
_INT = 'integer { size = %d; align = 8; signed = %s; }'
TYPES = {
    'u64': (_INT % (64, 'false'), 'Q'), 'i64': (_INT % (64, 'true'), 'q'),
    'u32': (_INT % (32, 'false'), 'I'), 'i32': (_INT % (32, 'true'), 'i'),
    'u8': (_INT % (8, 'false'), 'B'),
    'text': ('integer { size = 8; align = 8; signed = 1; encoding = UTF8; }', ''),
    'f64': ('floating_point { exp_dig = 11; mant_dig = 53; align = 8; }', 'd'),
}
CONTEXT = f'{TYPES["i32"][0]} _vpid; {TYPES["i32"][0]} _vtid; string _procname;'


# How LTTng writes number and time of an event: few bits of both, or all of both.
_HEADS = {
    'plain': 'struct { uint32_t id; time_t timestamp; }',
    'compact': """struct {
      enum : uint5_t { compact = 0 ... 30, extended = 31 } id;
      variant <id> { struct { uint27_time_t timestamp; } compact;
        struct { uint32_t id; time_t timestamp; } extended; } v; } align(8)""",
    'large': """struct {
      enum : uint16_t { compact = 0 ... 65534, extended = 65535 } id;
      variant <id> { struct { uint32_time_t timestamp; } compact;
        struct { uint32_t id; time_t timestamp; } extended; } v; } align(8)"""}
_BITS = {'compact': (5, 27), 'large': (16, 32)}     # of the number, of the time


def session(folder, kinds, events, *, context=True, discarded=0, environment=None, boot=None,
            head='plain', order='<', ids=1, packets=None):
    """
    Write a trace into a new folder and return it.

    :param kinds: names and fields of the events; types are those of `TYPES`, `str`, `TYPE[n]`
        and `TYPE[]`, `text[n]`, or TSDL and a function that returns the bytes
    :param events: place in `kinds`, time since the clock's offset, pid, tid, procname, values
    :param discarded: events that the tracer says to have discarded in the second of two packets,
        or what each packet says
    :param environment: what LTTng writes into the metadata, such as the hostname
    :param boot: the UUID of the clock, which is that of the host's boot
    :param head: of events, of `_HEADS`; ``order``: of bytes, as in `struct`
    :param ids: what a place in ``kinds`` is multiplied by, which gives the number of the event
    :param packets: numbers of the packets, between which the events are divided; -1: not written
    """
    folder.mkdir(parents=True)
    lines = ''.join(f'  {name} = "{value}";\n' for name, value in (environment or {}).items())
    text = METADATA.format(
        offset=CLOCK_OFFSET, boot=f'uuid = "{boot}"; ' if boot else '',
        order='le' if order == '<' else 'be', head=_HEADS[head],
        context=CONTEXT if context else '',
        environment=f'env {{\n{lines}}};\n' if lines else '')
    for number, (name, fields) in enumerate(kinds):
        text += (f'event {{ name = "{name}"; id = {number * ids}; stream_id = 0; '
                 'fields := struct { ' + ' '.join(_declared(*field) for field in fields)
                 + ' }; };\n')
    (folder / 'metadata').write_text(text)
    packets = packets or ([0, 1] if discarded else [0])
    part, data = -(-len(events) // len(packets)), b''
    for place, number in enumerate(packets):
        data += b'' if number < 0 else _packet(
            kinds, events[place * part:(place + 1) * part], context,
            discarded[place] if isinstance(discarded, list) else discarded * (place > 0),
            number, head, order, ids)
    (folder / 'channel_0').write_bytes(data if events else b'')
    return folder


def _declared(name, kind, *_):
    if kind == 'str':
        return f'string _{name};'
    if '{' in kind:
        return f'{kind} _{name};'
    base, bracket, length = kind.partition('[')
    if not bracket:
        return f'{TYPES[base][0]} _{name};'
    if length == ']':
        return f'{TYPES["u32"][0]} __{name}_length; {TYPES[base][0]} _{name}[ __{name}_length ];'
    return f'{TYPES[base][0]} _{name}[{length};'


def _packed(order, value, _, kind, *pack):
    if pack:
        return pack[0](value)
    if kind == 'str':
        return value.encode() + b'\0'
    base, bracket, length = kind.partition('[')
    if base == 'text':
        return value.encode().ljust(int(length[:-1]), b'\0')
    code = TYPES[base][1]
    if not bracket:
        return struct.pack(order + code, value)
    head = struct.pack(f'{order}I', len(value)) if length == ']' else b''
    return head + struct.pack(f'{order}{len(value)}{code}', *value)


def _headed(head, order, number, time, last):
    """Return the head of an event; LTTng writes all of the time where its low bits may repeat."""
    if head == 'plain':
        return struct.pack(f'{order}IQ', number, time)
    wide, bits = _BITS[head]
    low = time & (1 << bits) - 1
    if number >= (1 << wide) - 1 or time - last >= 1 << bits:
        tag = ((1 << wide) - 1) << (8 - wide if wide < 8 and order == '>' else 0)
        return struct.pack(f'{order}{"B" if wide < 8 else "H"}IQ', tag, number, time)
    if wide == 16:
        return struct.pack(f'{order}HI', number, low)
    return struct.pack(f'{order}I', number << bits | low if order == '>' else low << wide | number)


def _packet(kinds, events, context, discarded, number, head, order, ids):
    times = [event[1] for event in events] or [0]
    body, last = b'', times[0]
    for kind, time, pid, tid, procname, *values in events:
        body += _headed(head, order, kind * ids, time, last)
        last = time
        if context:
            body += struct.pack(f'{order}ii', pid, tid) + procname.encode() + b'\0'
        body += b''.join(_packed(order, value, *field)
                         for field, value in zip(kinds[kind][1], values))
    bits = (8 + 48 + len(body)) * 8
    return struct.pack(f'{order}IIQQQQQQ', MAGIC, 0, times[0], times[-1], bits, bits, number,
                       discarded) + body
