# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Tables of a recording as data frames: Arrow, Parquet, pandas.

Numbers with names become dictionary-encoded names; ``UNKNOWN`` becomes null.  Times and durations
are integer nanoseconds; the column's metadata says so (``unit``).  The schema's metadata has the
version of the tables (``mddag.tables``), which changes when the meaning of a column changes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from mddag_executor.recording.tables import Columns, REASONS, TABLES, UNKNOWN
import numpy as np

VERSION = '1'
_TIMES = {'release', 'noticed', 'ready', 'began', 'start', 'end', 'busy', 'cpu', 'time',
          'source_timestamp', 'header_stamp', 'deadline', 'completed'}
_COMPLETES = 'nothing', 'leg', 'vertex'
"""Names of the values of ``completes``."""
# Columns that are only used to build tables.
_INNER = {'order', 'due', 'inherited'}


class Words(NamedTuple):
    """The names of numbers in tables."""

    dags: Sequence[str]
    vertices: Sequence[str]
    drop_reasons: Sequence[str]
    places: Sequence[str]
    callback: Callable[[int], str]
    publisher: Callable[[int], str]


def arrow_table(columns: Columns, name: str, recording: str, words: Words) -> Any:
    """
    Return a table of a recording, one of ``TABLES`` (else KeyError), as an Arrow table.

    :param recording: the name of the recording.
    """
    if name not in TABLES:
        raise KeyError(f'there is no table {name!r}: the tables are {", ".join(TABLES)}')
    kind, rows = TABLES[name], getattr(columns, name)
    arrays = {}
    for column in kind.names or ():
        if column in _INNER:
            continue
        values = rows[column]
        array = _names(words, name, column, values)
        if array is None:
            has_unknown = values.dtype.kind == 'i' and column != 'leg'
            array = numbers(values, values != UNKNOWN if has_unknown else None)
        arrays[column] = array, 'ns' if column in _TIMES else ''
    return arrow_of(recording, arrays)


def arrow_of(recording: str, arrays: Mapping[str, tuple[Any, str]]) -> Any:
    """
    Return an Arrow table from arrays by name, each with its unit or an empty text.

    :param recording: the name of the recording.
    """
    import pyarrow
    fields = [pyarrow.field(name, array.type, metadata={'unit': unit} if unit else None)
              for name, (array, unit) in arrays.items()]
    return pyarrow.table([array for array, _ in arrays.values()], schema=pyarrow.schema(
        fields, metadata={
            'mddag.tables': VERSION,
            # the name of a file need not be UTF-8
            'mddag.recording': recording.encode('utf-8', 'backslashreplace')}))


def _names(words: Words, table: str, column: str, values: Any) -> Any:
    """Return the names of a column of numbers; None if its numbers have no names."""
    if column in ('dag', 'vertex'):
        names = list(words.dags if column == 'dag' else words.vertices)
        codes = values.astype(np.int32)
    elif column in ('callback', 'publisher'):
        addresses, codes = np.unique(values, return_inverse=True)
        name = words.callback if column == 'callback' else words.publisher
        names = [name(each) for each in addresses.tolist()]
    elif column == 'reason':
        names = list(words.drop_reasons if table == 'drops' else REASONS)
        codes = values.astype(np.int32)
    elif column == 'where':
        names, codes = list(words.places), values.astype(np.int32)
    elif column == 'completes':
        names, codes = list(_COMPLETES), values
    else:
        return None
    return named(codes, names, codes >= 0)


def numbers(values: Any, known: Any = None) -> Any:
    """
    Return numbers as an Arrow array; from its buffers, because ``pyarrow.array`` imports pandas.

    :param known: which ones have a value; None: all.
    """
    import pyarrow
    plain = np.ascontiguousarray(values)
    mask = None if known is None or known.all() else pyarrow.py_buffer(_bits(known))
    data = _bits(plain) if plain.dtype == np.bool_ else plain
    return pyarrow.Array.from_buffers(
        pyarrow.from_numpy_dtype(plain.dtype), len(plain), [mask, pyarrow.py_buffer(data)])


def _bits(flags: Any) -> Any:
    return np.packbits(flags, bitorder='little')


def named(codes: Any, names: Sequence[str], known: Any = None) -> Any:
    """Return indices of names as an Arrow array, the names as a dictionary; '' is null."""
    import pyarrow
    different = list(dict.fromkeys(name for name in names if name))
    if len(different) < len(names):     # some numbers have the same name, or none
        place = {name: i for i, name in enumerate(different)}
        codes, names = np.array([place.get(name, UNKNOWN) for name in names])[codes], different
        known = codes != UNKNOWN if known is None else known & (codes != UNKNOWN)
    texts = [name.encode('utf-8', 'backslashreplace') for name in names]
    ends = np.cumsum([0, *map(len, texts)], dtype=np.int32)
    return pyarrow.DictionaryArray.from_arrays(
        numbers(codes.astype(np.int32), known), pyarrow.StringArray.from_buffers(
            len(texts), pyarrow.py_buffer(ends), pyarrow.py_buffer(b''.join(texts))))


def frame_of(table: Any) -> Any:
    """Return an Arrow table as a pandas data frame."""
    import pandas
    import pyarrow
    # pandas' own choice, floats where a value is missing, would round times to 256 ns
    return table.to_pandas(types_mapper={pyarrow.int64(): pandas.Int64Dtype()}.get)
