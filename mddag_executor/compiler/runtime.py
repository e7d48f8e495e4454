# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What compiled code has instead of functions of Python.

The functions of ``heapq`` are here with the same algorithm, for heaps of five integers.
"""

from __future__ import annotations

from heapq import heapify, heappop, heappush
from typing import Any

Entry = tuple[int, int, int, int, int]


def free_all(columns: Any) -> None:
    """Free the lists of a class of named tuples, which are empty then."""
    for column in columns:
        if isinstance(column, list):
            column.clear()


def push(heap: list[Entry], entry: Entry) -> None:
    """Do the same as ``heapq.heappush``."""
    heap.append(entry)
    _move_up(heap, 0, len(heap) - 1)


def pop(heap: list[Entry]) -> Entry:
    """Do the same as ``heapq.heappop``, on a heap that is not empty."""
    last = heap.pop()
    if len(heap) == 0:
        return last
    first = heap[0]
    heap[0] = last
    _move_down(heap, 0)
    return first


def order(heap: list[Entry]) -> None:
    """Do the same as ``heapq.heapify``."""
    for place in range(len(heap) // 2 - 1, -1, -1):
        _move_down(heap, place)


def _move_up(heap: list[Entry], top: int, place: int) -> None:
    """Move an entry towards a place above it until the one above is not larger."""
    entry = heap[place]
    while place > top:
        above = (place - 1) >> 1
        if not entry < heap[above]:
            break
        heap[place] = heap[above]
        place = above
    heap[place] = entry


def _move_down(heap: list[Entry], place: int) -> None:
    """Move the smaller entries below a place up to the bottom, then the entry up to its place."""
    top = place
    entry = heap[place]
    below = 2 * place + 1
    while below < len(heap):
        if below + 1 < len(heap) and not heap[below] < heap[below + 1]:
            below += 1
        heap[place] = heap[below]
        place = below
        below = 2 * place + 1
    heap[place] = entry
    _move_up(heap, top, place)


REPLACED: dict[Any, Any] = {heappush: push, heappop: pop, heapify: order}
"""The functions of Python, and what compiled code calls instead."""
