# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Joins of columns, sorting and grouping; rows that do not exist are ``UNKNOWN``, -1."""

from __future__ import annotations

from typing import Any

from mddag_executor.recording.columns import Ints, Mask, Places, Table
from mddag_executor.recording.tables import UNKNOWN
import numpy as np


class RowNumbers:
    """New row numbers after all rows but the kept ones were dropped."""

    def __init__(self, kept: Mask) -> None:
        self._new = np.append(np.where(kept, np.cumsum(kept) - 1, UNKNOWN), UNKNOWN)

    def new(self, rows: Any) -> Ints:
        """Return the new numbers; ``UNKNOWN`` for dropped or unknown rows."""
        found: Ints = self._new[rows]
        return found

    def has(self, rows: Any) -> Mask:
        """Return which rows are kept."""
        kept: Mask = self._new[rows] >= 0
        return kept


def later_pieces(executions: Table) -> tuple[Ints, Ints]:
    """Return the rows of later pieces of executions, and of their first ones or themselves."""
    later = np.flatnonzero(executions['piece'] > 0)
    if not len(later):
        return later, later
    names = ['callback', 'vertex', 'job', 'ready', 'began']
    several = distinct(executions['callback'][later])
    first = np.flatnonzero(
        (executions['piece'] == 0) & np.isin(executions['callback'], several))
    of = dict(zip(executions[names][first].tolist(), first.tolist()))
    return later, np.array([of.get(key, row) for key, row in zip(
        executions[names][later].tolist(), later.tolist())], dtype=np.int64)


_SHORT, _FEW = 1 << 15, 1 << 16
"""Numbers within a smaller range are sorted as 16 bits, or counted in a table of the range."""


def _above_least(column: Any, width: int) -> Ints | None:
    """Return by how much each number is above the least one; None: one by ``width`` or more."""
    if not len(column):
        return None
    least = column.min()
    if int(column.max()) - int(least) >= width:
        return None
    above: Ints = np.subtract(column, least, dtype=np.int64)
    return above


def sort_by(*columns: Any) -> Ints:
    """Return the stable order of rows by several columns of integers, the first one first."""
    column, *others = columns
    above = _above_least(column, _SHORT)
    order: Ints
    if others and above is None:
        order = np.lexsort(columns[::-1])
        return order
    if above is not None:
        column = above.astype(np.int16)     # which are sorted faster
    if not others:
        order = np.argsort(column, kind='stable')
        return order
    order = sort_by(*others)
    return order[np.argsort(column[order], kind='stable')]


def distinct(column: Any) -> Ints:
    """
    Return the different values of a column, ascending.

    ``numpy.unique`` does so as well, but it imports the masked arrays, which takes 15 ms.
    """
    above = _above_least(column, min(_FEW, 4 * len(column)))
    if above is None:
        values = np.sort(column)
        found: Ints = values[np.append(True, values[1:] != values[:-1])[:len(values)]]
        return found
    found = _present(above)[0].astype(column.dtype) + column.min()
    return found


def different(column: Any) -> tuple[Ints, Ints]:
    """
    Return the different values, ascending, and by row the index of its value.

    It is faster than numpy's own inverse, which sorts all rows, if few values differ.
    """
    above = _above_least(column, min(_FEW, 4 * len(column)))
    if above is None:
        values = distinct(column)
        return values, np.searchsorted(values, column).astype(np.int32)
    places, index_of = _present(above)
    values = places.astype(column.dtype) + column.min()
    index: Any = index_of.take(above)
    return values, index


def _present(numbers: Ints) -> tuple[Ints, Places]:
    """Return the numbers that are there, ascending, and by number its index among them."""
    is_there = np.zeros(int(numbers.max()) + 1, dtype=np.bool_)
    is_there[numbers] = True
    return np.flatnonzero(is_there), np.cumsum(is_there, dtype=np.int32) - np.int32(1)


def earliest(*columns: Ints) -> int | None:
    """Return the earliest time in columns; None if all are empty."""
    return min((int(each.min()) for each in columns if len(each)), default=None)


def last_of(which: Mask, group: Any, before: bool = False) -> Ints:
    """
    Return by row the last chosen row of its group up to it, or ``before`` it; -1: none.

    :param group: a sorted column.
    """
    last = np.maximum.accumulate(np.where(which, np.arange(len(which)), -1))
    if before:
        last = np.append(-1, last)[:len(which)]
    found: Ints = np.where((last >= 0) & (group[last] == group), last, -1)
    return found


_OFF_SHARE = 0.02    # due times are exact, times at which a busy machine noticed them are not


def whole_periods(times: Ints, period: int) -> tuple[Ints, Mask]:
    """
    Return the periods from each different time to the next one, and where they are a whole number.

    They are not where a timer was reset.
    """
    between = np.diff(distinct(times)) / period
    whole = np.rint(between)
    return whole.astype(np.int64), (np.abs(between - whole) <= _OFF_SHARE) & (whole > 0)


def rows_by(numbers: Any, n: int) -> list[Ints]:
    """Return the rows of each number from 0 to n - 1."""
    order = sort_by(numbers)
    borders = np.searchsorted(numbers, np.arange(n + 1), sorter=order)
    return np.split(order, borders)[1:-1]


def equal(numbers: Ints, wanted: Any) -> Ints:
    """Return the first positions of wanted numbers; ``UNKNOWN`` for missing ones."""
    if len(numbers) and (numbers[1:] >= numbers[:-1]).all():
        at = np.minimum(np.searchsorted(numbers, wanted), len(numbers) - 1)
        return np.where(numbers[at] == wanted, at, UNKNOWN)
    order = np.append(sort_by(numbers), UNKNOWN)
    at = order[np.searchsorted(numbers, wanted, sorter=order[:-1])]
    found: Ints = np.where(np.append(numbers, 0)[at] == wanted, at, UNKNOWN)
    return found


def as_of(times: Any, wanted: Any) -> Ints:
    """Return the last row of sorted times at or before each wanted one; -1: none."""
    found: Ints = np.searchsorted(times, wanted, 'right') - 1
    return found


def last_before(times: Any, wanted: Any) -> Ints:
    """Return the last row of sorted times before each wanted one; -1: none."""
    found: Ints = np.searchsorted(times, wanted, 'left') - 1
    return found


def equal_pairs(known: tuple[Ints, Ints], wanted: tuple[Ints, Ints]) -> tuple[Ints, Ints]:
    """Return by wanted pair the first known one, ``UNKNOWN`` without, and their number."""
    keys, wanted_keys = _pair_keys(known, wanted)
    order = sort_by(keys)
    begins, until = groups(keys[order])
    at = equal(keys[order[begins]], wanted_keys)
    return np.append(order[begins], UNKNOWN)[at], np.append(until - begins, 0)[at]


def _pair_keys(known: tuple[Ints, Ints], wanted: tuple[Ints, Ints]) -> tuple[Ints, Ints]:
    """Return one number for each pair, in the order of the pairs."""
    first, second = (np.append(*both).astype(np.int64) for both in zip(known, wanted))
    if not len(first):
        return first, first
    least, span = int(second.min()), int(second.max()) - int(second.min()) + 1
    if max(abs(int(first.min())), abs(int(first.max()))) < 2 ** 62 // span:
        second -= least
    else:
        values, second = different(second)
        span, (_, first) = len(values), different(first)
        first = first.astype(np.int64)
    keys = first * span + second
    return keys[:len(known[0])], keys[len(known[0]):]


def groups(values: Any) -> tuple[Ints, Ints]:
    """Return the begin and end of each run of equal values in a sorted column."""
    if not len(values):
        none = np.empty(0, dtype=np.int64)
        return none, none
    begins = np.append(0, np.flatnonzero(values[1:] != values[:-1]) + 1)
    return begins, np.append(begins[1:], len(values))
