# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The core's own source, compiled to machine code, and runs of it.

Theory of operation
-------------------
1. The functions of the core and of the event loop are compiled unchanged: all that
   the entry points (``kernel``) call.  No rule exists twice.  The policy is an additional field of
   the tables; the key function selects by it, so one compilation is enough for all policies.
2. The machine code is stored in the user's cache folder, in a file whose name has a hash of all
   sources.  It begins with a hash of itself: a damaged file is not used.  LLVM is imported, and
   code is compiled or loaded, on first use only.
3. Named tuples are passed as structures, which have three words for each field (``compiler``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
import ctypes
from functools import cache
import hashlib
from importlib.util import find_spec
import math
import os
from pathlib import Path
import platform
import time
from typing import Any
import weakref

from mddag_executor import progress
from mddag_executor.core.state import Decision, State
from mddag_executor.core.tables import Tables
from mddag_executor.errors import UsageError
from mddag_executor.simulate.deliveries import Deliveries
from mddag_executor.simulate.engine import EngineOptions
from mddag_executor.simulate.machine import Machine
from mddag_executor.simulate.policies import ALL_POLICIES
from mddag_executor.simulate.pool import LogEntry, Pool
from mddag_executor.simulate.workload import Workload
import numpy as np
import numpy.typing as npt

_COMPILE_S = 4.0    # approximate compile time
_REPEATS = 4        # assumed repetitions of such work, as with other settings
_STORED = 8         # kept versions of the code
_WRITTEN_BY_S = 3600.0   # a file that was not renamed after this time never is

_MANY = 100_000
"""More elements are not copied."""
_C = ctypes.CDLL(None)
_C.malloc.restype, _C.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
_C.free.restype, _C.free.argtypes = None, [ctypes.c_void_p]

PLAIN = 'MDDAG_PLAIN'
"""The environment variable that forbids compiling, if it is not empty."""
ENTRY_POINTS = {'run_each': 8, 'free_run': 4}
"""The compiled functions of ``kernel`` that are called, with their numbers of arguments."""


def available() -> bool:
    """Return whether there is a compiler, and it may be used."""
    return find_spec('llvmlite') is not None and not os.environ.get(PLAIN)


@cache
def entry_points() -> dict[str, Callable[..., int]]:
    """Return the entry points of ``kernel`` by name; they are loaded, or compiled and stored."""
    from mddag_executor.compiler import machine_code
    code = _stored_code()
    if code is None:
        from mddag_executor.simulate.kernel import program
        progress.report(f'compiling the core, once (about {_COMPILE_S:.0f} s)')
        code = machine_code.make(program())
        with suppress(OSError):  # a folder that is not writable: each process compiles
            _store(code)
    loaded = machine_code.MachineCode(code)
    return {name: loaded.function(name, number) for name, number in ENTRY_POINTS.items()}


@cache
def _path() -> Path:
    """Return the file of the machine code for the present sources."""
    digest = hashlib.sha256()
    simulate = Path(__file__).parent
    for folder in (simulate.parent / 'core', simulate.parent / 'compiler', simulate):
        for path in sorted(folder.glob('*.py')):
            digest.update(path.read_bytes())
    folder = Path(os.environ.get('XDG_CACHE_HOME') or '~/.cache').expanduser()
    name = f'core-{digest.hexdigest()[:16]}-{platform.system()}-{platform.machine()}.bin'
    return folder / 'mddag_executor' / name


def _stored_code() -> bytes | None:
    """Return the stored machine code, if it is whole."""
    try:
        stored = _path().read_bytes()
    except OSError:
        return None
    digest, code = stored[:32], stored[32:]
    return code if hashlib.sha256(code).digest() == digest else None


def _store(code: bytes) -> None:
    """
    Store machine code; of older versions only the newest ones remain.

    Other processes may do the same: a file that one of them reads stays readable for it.
    """
    path = _path()
    path.parent.mkdir(parents=True, exist_ok=True)
    written = path.with_suffix(f'.{os.getpid()}.part')
    written.write_bytes(hashlib.sha256(code).digest() + code)
    written.replace(path)
    stored = sorted(path.parent.glob('core-*.bin'), key=_age_s, reverse=True)
    # a process that was killed has left its file
    abandoned = [each for each in path.parent.glob('core-*.part') if _age_s(each) > _WRITTEN_BY_S]
    for old in (*stored[:-_STORED], *abandoned):
        old.unlink(missing_ok=True)


def _age_s(path: Path) -> float:
    """Return how long ago a file was written, s; for ever, if another process has removed it."""
    try:
        return time.time() - path.stat().st_mtime
    except FileNotFoundError:
        return math.inf


def check_available() -> None:
    """Check that there is a compiler."""
    if not available():
        raise UsageError("llvmlite, which compiles the core, is not installed: install "
                         "'mddag_executor[batch]' with pip")


def pays(plain_s: float) -> bool:
    """Return whether compiled code is faster for such work in the long run."""
    return available() and (
        plain_s * _REPEATS > _COMPILE_S or entry_points.cache_info().currsize > 0
        or _stored_code() is not None)


def prepare() -> None:
    """Compile the core, or load it from disk."""
    entry_points()


def run_each(
    tables: Tables, load: Workload, policy: str, options: EngineOptions, runs: int = 1,
) -> tuple[tuple[int, Sequence[LogEntry], Sequence[Decision], list[int]], list[int]]:
    """
    Run a load like ``engine.run``, once or several times.

    :param runs: number of runs; each has the next row of execution times in ``Workload.costs``,
        which has one for each vertex.
    :return: the end, the log of every worker, the decisions, the busy time of each worker, all of
        the last run; and by run 1 if a deadline was missed, otherwise 0.
    """
    load = load._replace(cost_base=[*load.cost_base])   # is changed
    lent = [Memory(*tables, list(ALL_POLICIES).index(policy)), Memory(*load), Memory(*options)]
    missed = Memory(np.zeros(runs))
    core, workers, *_ = working = [
        Memory(*[0] * len(fields)) for fields in (
            State._fields, Pool._fields, Deliveries._fields, Machine._fields)]
    decisions, busy, log = (
        State._fields.index('decisions'), *map(Pool._fields.index, ('busy', 'log')))
    if len(load.times) > _MANY:
        jobs = np.bincount(load.dags, minlength=tables.n_dags + 1)
        ends, sinks, vertices = 1, np.diff(tables.first_sink), np.diff(tables.first_vertex)
        core.reserve(decisions, 6, int(jobs[:tables.n_dags] @ (ends + sinks[:tables.n_dags])))
        if options.keep_log:
            workers.reserve(log, 6, int(
                jobs[:tables.n_dags] @ (1 + 2 * vertices[:tables.n_dags]) + 2 * jobs[-1]))
    addresses = [each.address for each in working]
    call = entry_points()
    ended = call['run_each'](*(each.address for each in lent), *addresses, missed.address)
    try:
        return ((int(ended), Rows(workers.words(log, 6)),  # type: ignore[return-value]
                 Rows(core.words(decisions, 6)), workers.words(busy, 1)[:, 0].tolist()),
                missed.words(0, 1)[:, 0].tolist())
    finally:
        call['free_run'](*addresses)


class Memory:
    """
    A structure, or a vector, in numpy's memory.

    :param fields: integers or columns; 0 is also an empty vector, to which compiled code appends.
    """

    def __init__(self, *fields: Any) -> None:
        self._columns: list[npt.NDArray[np.int64]] = []  # keeps the memory
        words = []
        for value in fields:
            if isinstance(value, int):
                words += [value, 0, 0]
                continue
            column = np.ascontiguousarray(value, dtype=np.int64)
            self._columns.append(column)
            words += [column.ctypes.data, len(column), len(column)]
        self._words = np.array(words, dtype=np.int64)

    @property
    def address(self) -> int:
        """Return its address, valid as long as this object lives."""
        return int(self._words.ctypes.data)

    def reserve(self, field: int, width: int, length: int) -> None:
        """
        Give an empty vector room for ``length`` elements of ``width`` words.

        It takes no memory before it is used.  A vector that grows copies itself again and again.
        """
        address = _C.malloc(8 * width * max(1, length))
        if address:
            self._words[3 * field:3 * field + 3] = address, 0, length

    def words(self, field: int, width: int) -> npt.NDArray[np.int64]:
        """
        Return a field, a vector whose elements have ``width`` words.

        Large ones are not copied: their memory belongs to the array, and the field is empty then.
        """
        address, length = self._words[3 * field:3 * field + 2].tolist()
        if length == 0:
            return np.empty((0, width), dtype=np.int64)
        data = (ctypes.c_int64 * (length * width)).from_address(address)
        if length <= _MANY or self._columns:    # small, or of numpy
            return np.array(data, dtype=np.int64).reshape(length, width)
        self._words[3 * field:3 * field + 3] = 0
        weakref.finalize(data, _C.free, address).atexit = False
        return np.frombuffer(data, dtype=np.int64).reshape(length, width)


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
