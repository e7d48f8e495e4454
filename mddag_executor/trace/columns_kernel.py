# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Walking over the records of a chunk in compiled code; see ``columns``.

This module needs numba; nothing is compiled when it is imported.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from mddag_executor.trace import column_layout as cl
from numba import types
from numba.extending import intrinsic


def _peek(width: int) -> Any:
    """Return what reads a number at any address."""
    kind = ir.IntType(8 * width)
    word = ir.IntType(64)

    @intrinsic
    def peek(typing: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            value = builder.load(builder.inttoptr(args[0], kind.as_pointer()))
            value.align = 1
            return value if width == 8 else builder.zext(value, word)

        return types.int64(types.int64), generate

    return peek


peek1, peek2, peek4, peek8 = (_peek(width) for width in (1, 2, 4, 8))


def read_number(address: int, size: int, signed: int) -> int:
    """Return the number of that size at an address; one of 8 bytes without a sign may wrap."""
    if size == 8:
        return peek8(address)
    if size == 4:
        value = peek4(address)
        return value - ((value >> 31) << 32) if signed else value
    if size == 2:
        value = peek2(address)
        return value - ((value >> 15) << 16) if signed else value
    value = peek1(address)
    if signed == 2:
        return 1 if value != 0 else 0
    return value - ((value >> 7) << 8) if signed else value


def scan_records(
    data: int, end: int, classes: Any, layouts: Any, rows: Any, others: Any, result: Any,
) -> None:
    """
    Walk on to the end, to a definition or a record that is cut, or until there is no room.

    :param data: address of the records; a few bytes after their end can be read.
    :param rows: what was found, one row for each event.
    :param others: where the messages begin and end that are not decoded here.
    :param result: where to begin; then, how far it has come, and why no further.
    """
    position = result[cl.POSITION]
    count = result[cl.ROWS]
    messages = result[cl.MESSAGES]
    n_others = result[cl.OTHERS]
    status = cl.DONE
    while position < end:
        at = data + position
        opcode = peek1(at)
        length = peek8(at + 1)
        if length < 0 or length > end - position - 9:
            status = cl.CUT
            break
        after = position + 9 + length
        if opcode == 5:
            messages += 1
            what = classes[peek2(at + 9)]
            if what != cl.PASSED_OVER:
                if count == len(rows):
                    messages -= 1
                    status = cl.FULL
                    break
                layout = what - cl.FIRST_LAYOUT
                rows[count, cl.TIME] = 0
                if (layout >= 0 and peek2(at + 31) == 0x0100
                        and position + 35 + layouts[layout, cl.L_SIZE] <= after):
                    fields = at + 35
                    rows[count, cl.KIND] = layouts[layout, cl.L_KIND]
                    place = cl.L_FIRST
                    for i in range(layouts[layout, cl.L_FIELDS]):
                        value = read_number(
                            fields + layouts[layout, place],
                            layouts[layout, place + 1], layouts[layout, place + 2])
                        # time, process, thread: as they stand in the message
                        column = i
                        if i == 1:
                            column = cl.PROCESS
                        elif i == 2:
                            column = cl.THREAD
                        elif i > 2:
                            column = i + 1
                        rows[count, column] = value
                        place += 3
                else:
                    rows[count, cl.KIND] = cl.OTHER
                    rows[count, cl.THREAD] = n_others
                    others[n_others, 0] = position
                    others[n_others, 1] = after
                    n_others += 1
                count += 1
        elif opcode == 3 or opcode == 4:
            status = cl.DEFINITION
            break
        position = after
    result[cl.POSITION] = position
    result[cl.ROWS] = count
    result[cl.MESSAGES] = messages
    result[cl.OTHERS] = n_others
    result[cl.STATUS] = status
