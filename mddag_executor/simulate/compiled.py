# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Runs of the compiled core: calls the entry points of ``kernel`` with memory for their data.

A structure has three words for each field: the words of a vector (address, length, capacity; see
``vectors``), or an integer in the first word.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
import ctypes
from pathlib import Path
from typing import Any, NamedTuple, TYPE_CHECKING

from mddag_executor import progress
from mddag_executor.core.policies import POLICIES
from mddag_executor.core.policies import policy as find_policy
from mddag_executor.core.state import Decision, State
from mddag_executor.core.tables import Tables
from mddag_executor.simulate.compiling import available, entry_points
from mddag_executor.simulate.deliveries import Deliveries
from mddag_executor.simulate.engine import LogEntry, Orders
from mddag_executor.simulate.errors import SimulationError
from mddag_executor.simulate.load import Load
from mddag_executor.simulate.machine import Machine
import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from mddag_executor.simulate.schedule import Settings

ACCEPT_RUNS, RUN_ONCE = 'accept_runs', 'run_once'
"""The entry points: of ``evaluate``, and of all other runs."""
_WORD = 8
_COMPILE_S = {ACCEPT_RUNS: 15.0, RUN_ONCE: 40.0}    # approximate compile times


def check_available() -> None:
    """Check that there is a compiler."""
    if not available():
        raise SimulationError("numba, which compiles the core, is not installed: install "
                              "'mddag_executor[batch]' with pip")


def pays(name: str, plain_s: float) -> bool:
    """Return whether compiled code is faster for work that takes plain Python this long."""
    return available() and (plain_s > _COMPILE_S[name] or _is_compiled(name))


def _is_compiled(name: str) -> bool:
    entry: Any = entry_points()[name]
    folder = entry.stats.cache_path
    return bool(entry.signatures) or (folder is not None and any(
        Path(folder).glob(f'*{entry.py_func.__qualname__}*.nbi')))


def prepare(name: str) -> None:
    """Compile an entry point, or load it from disk, with a call that runs nothing."""
    if not _is_compiled(name):
        progress.report(f'compiling the core, once: about {_COMPILE_S[name]:.0f} s')
    if name == RUN_ONCE:
        run_once(Tables.build(None), Load([], [], [], [], [], []), 'rad',
                 Orders(*[0] * len(Orders._fields)))
        return
    nothing = EmptyMemory(max(len(Tables._fields) + 1, len(State._fields)))
    entry_points()[ACCEPT_RUNS](
        nothing.address, nothing.address, nothing.address, 0, 0, 1, 0, 0, 0, 0, 0, 1, False,
        np.zeros(0, dtype=np.bool_))


class AcceptRuns:
    """
    Simulates runs up to their first miss, in compiled code; several threads may call it.

    :param load: the load of all runs, except for its costs.
    """

    def __init__(self, tables: Tables, load: Load) -> None:
        prepare(ACCEPT_RUNS)
        self._tables = [LentTuple(tables, number) for number in range(len(POLICIES))]
        self._load = LentTuple(load)
        self._row = tables.n_vertices * _WORD

    def __call__(
        self, settings: Settings, times: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.bool_]:
        """Return which runs, with the execution times of their rows, have no miss."""
        load = self._load.copy()  # its costs are replaced for each run
        working = EmptyMemory(len(State._fields))
        times = np.ascontiguousarray(times, dtype=np.int64)
        accepted = np.zeros(len(times), dtype=np.bool_)
        entry_points()[ACCEPT_RUNS](
            self._tables[list(POLICIES).index(settings.policy)].address, load.address,
            working.address, times.ctypes.data, self._row, settings.workers,
            int(settings.preempts), int(find_policy(settings.policy).polling),
            find_policy(settings.policy).urgency, settings.dispatch_overhead_ns,
            settings.switch_overhead_ns, settings.duration_ns, settings.judge == 'horizon',
            accepted)
        return accepted


def run_once(
    tables: Tables, load: Load, policy: str, orders: Orders
) -> tuple[int, Sequence[LogEntry], Sequence[Decision], list[int]]:
    """
    Run a load like ``engine.run_load``.

    :return: the end, the log of every worker, the decisions, the busy time of each worker.
    """
    lent = [LentTuple(tables, list(POLICIES).index(policy)), LentTuple(load), LentTuple(orders)]
    state, _, _, busy, log = working = [
        EmptyMemory(len(fields)) for fields in (
            State._fields, Deliveries._fields, Machine._fields, ('busy',), ('log',))]
    addresses = [each.address for each in working]
    ended = entry_points()[RUN_ONCE](*(each.address for each in lent), *addresses)
    try:
        place = State._fields.index('decisions')
        return (int(ended), log.rows(0, 6), state.rows(place, 6),  # type: ignore[return-value]
                busy.words(0, 1)[:, 0].tolist())
    finally:
        entry_points()['free_run'](*addresses)


class LentTuple:
    """A named tuple of integers and lists as a structure in numpy's memory."""

    def __init__(self, row: NamedTuple, *more: int) -> None:
        self._columns: list[npt.NDArray[np.int64]] = []  # keeps the memory
        words = []
        for value in (*row, *more):
            if isinstance(value, int):
                words += [value, 0, 0]
                continue
            column = np.ascontiguousarray(value, dtype=np.int64)
            self._columns.append(column)
            words += [column.ctypes.data, len(column), len(column)]
        self._words = np.array(words, dtype=np.int64)

    @property
    def address(self) -> int:
        """Return the address of the structure, valid as long as this object lives."""
        return int(self._words.ctypes.data)

    def copy(self) -> LentTuple:
        """Return another structure with the same columns."""
        copied = copy(self)
        copied._words = self._words.copy()
        return copied


class EmptyMemory:
    """Memory for an empty structure or vector."""

    def __init__(self, fields: int = 1) -> None:
        self._words = np.zeros(3 * fields, dtype=np.int64)

    @property
    def address(self) -> int:
        """Return its address, valid as long as this object lives."""
        return int(self._words.ctypes.data)

    def words(self, field: int, width: int) -> npt.NDArray[np.int64]:
        """Return a copy of a field, a vector whose elements have ``width`` words."""
        address, length = self._words[3 * field:3 * field + 2].tolist()
        if length == 0:
            return np.empty((0, width), dtype=np.int64)
        data = (ctypes.c_int64 * (length * width)).from_address(address)
        return np.ctypeslib.as_array(data).reshape(length, width).copy()

    def rows(self, field: int, width: int) -> Rows:
        """Return a field as tuples."""
        return Rows(self.words(field, width))


class Rows(Sequence[tuple[int, ...]]):
    """Rows of integers as tuples, made on access: the array needs a sixth of their memory."""

    _SOME = 8192

    def __init__(self, words: npt.NDArray[np.int64]) -> None:
        self._words = words

    def __len__(self) -> int:
        return len(self._words)

    def __getitem__(self, place: Any) -> Any:
        found = self._words[place].tolist()
        return list(map(tuple, found)) if isinstance(place, slice) else tuple(found)

    def __iter__(self) -> Iterator[tuple[int, ...]]:
        for first in range(0, len(self), self._SOME):
            yield from self[first:first + self._SOME]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[np.int64]:
        return self._words

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and list(self) == list(other)
