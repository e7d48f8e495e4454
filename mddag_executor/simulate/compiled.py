# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The core's own source, compiled to machine code, and runs of it.

Theory of operation
-------------------
1. The functions of the core and of the event loop are used unchanged: each is bound to a common
   namespace, in which the names of the others refer to their compiled versions, and the names of
   ``heapq`` to those of ``vectors``.  So a name, even of a constant, must mean the same in all
   modules.  No rule exists twice.  Only ``add_heap`` is replaced, because an empty list has no
   type.  The policy is an additional field of the tables; the key function selects by it, so one
   compilation is enough for all policies.
2. numba links each function into its callers, and optimises it there again.  So the large and the
   rarely called functions (``PARTS``) are compiled once, as functions that others call as they
   call those of C: they are known to the linker by a symbol.  The others are linked into these.
3. numba stores the machine code of the parts and of the entry points (``kernel``) on disk
   (``cache=True``).  It only checks the file of a function itself, so a hash of all sources is
   part of the stored name.  numba is imported, and code is compiled, on first use only.
4. Named tuples are passed as structures, which have three words for each field: the words of a
   vector (address, length, capacity; see ``vectors``), or an integer in the first word.
"""

from __future__ import annotations

import _thread
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
import ctypes
from functools import cache, partial
import hashlib
from importlib.util import find_spec
import os
from pathlib import Path
import signal
import threading
from types import FrameType, FunctionType
from typing import Any

from mddag_executor import progress
from mddag_executor.core import jobs, overload, policies, queues, rules, state, tables
from mddag_executor.core.state import Decision, State
from mddag_executor.core.tables import Tables
from mddag_executor.errors import UsageError
from mddag_executor.simulate import deliveries, dispatch, engine, machine, polling, pool, workload
from mddag_executor.simulate.deliveries import Deliveries
from mddag_executor.simulate.engine import EngineOptions
from mddag_executor.simulate.machine import Machine
from mddag_executor.simulate.policies import ALL_POLICIES
from mddag_executor.simulate.pool import LogEntry, Pool
from mddag_executor.simulate.workload import Workload
import numpy as np
import numpy.typing as npt

_COMPILE_S = 20.0   # approximate compile time
_REPEATS = 4        # assumed repetitions of such work, as with other settings

_MODULES = (
    tables, state, queues, jobs, overload, policies, rules, workload, pool, polling, dispatch,
    machine, deliveries, engine)
_NOT_COMPILED = frozenset({
    # for plain lists
    'empty', 'as_object', 'add_heap', 'rad_offsets', 'reached_sinks', 'mean_time',
    'policy', 'find', 'as_arrays', 'as_lists', 'edges_of', 'edge_numbers', 'periodic_workload'})
ENTRY_POINTS = ('free_run', 'run_each')
PARTS = (
    # called for each execution
    'complete', 'make_ready', 'take',
    # called for each job, or for some executions
    '_preempt', 'close_job', 'judge', 'release_job', 'release_load', 'unlink',
    # called in an overload
    '_keep_newest', '_keep_timely', 'admit', 'demote', 'drop', 'expire_idle', 'give_up',
    'judge_incomplete', 'note_late',
    # called once, or with several processes, messages that take time, GIL and CPUs
    '_fill', '_take_of_several', 'add_slot', 'arrive_due', 'call_next', 'decide', 'ends_sending',
    'fail', 'fill_state', 'finish', 'leave_outer', 'ready_undeclared', 'sends_at_start', 'settle',
    'share', 'starts', 'take_polled', 'withhold')
"""The functions that are compiled separately, and called as functions of C."""
_REPLACED = ('add_heap', 'heapify', 'heappop', 'heappush')


def available() -> bool:
    """Return whether numba is installed and may compile."""
    return find_spec('numba') is not None and os.environ.get('NUMBA_DISABLE_JIT', '0') == '0'


@cache
def entry_points() -> dict[str, Callable[..., Any]]:
    """Return the compiled entry points of ``kernel`` by name; they are compiled when called."""
    from mddag_executor.simulate import kernel, parts, vectors
    from numba import njit
    space = dict(vars(kernel))  # with its name: code loaded from disk looks its module up
    for module in _MODULES:
        for name, value in vars(module).items():
            if not name.startswith('__'):
                assert space.setdefault(name, value) is value, f'there are two of {name}'
    space.update((name, getattr(vectors, name)) for name in _REPLACED)
    sources = _hash_of_sources()
    for name, function in _functions().items():
        bound = _bound(function, space)
        if name in PARTS:
            _parts[name] = parts.Part(bound, sources, str(kernel.__file__))
            space[name] = _parts[name].callee
        else:
            space[name] = parts.linked(bound)
    kernel.bind_policies(space)
    for name in ENTRY_POINTS:
        space[name] = _stored(njit, _bound(getattr(kernel, name), space))
    return {name: space[name] for name in ENTRY_POINTS}


_parts: dict[str, Any] = {}


@cache
def _compile_parts() -> None:
    """Compile the parts, or load them from disk; the entry points need them."""
    from mddag_executor.simulate.parts import called_first
    from numba import cfunc
    is_new = not _is_compiled()
    entry_points()
    for number, name in enumerate(called_first(PARTS, _functions())):
        if is_new:
            progress.report(
                f'compiling the core, once: part {number + 1} of {len(PARTS) + 1} '
                f'(about {_COMPILE_S:.0f} s in all)')
        _parts[name].compile(partial(_stored, cfunc))


def _stored(compiler: Any, function: FunctionType, *signature: Any) -> Any:
    """Compile a function with a compiler of numba, and store the code on disk if possible."""
    # part of the names of numba's files
    function.__qualname__ = f'{function.__name__}_{_hash_of_sources()}'
    try:
        return compiler(*signature, error_model='numpy', nogil=True, cache=True)(function)
    except RuntimeError:    # no writable folder
        return compiler(*signature, error_model='numpy', nogil=True)(function)


def _functions() -> dict[str, FunctionType]:
    """Return all functions of the source by name."""
    return {
        name: value for module in _MODULES for name, value in vars(module).items()
        if isinstance(value, FunctionType) and value.__module__ == module.__name__
        and name not in _NOT_COMPILED}


def _bound(function: FunctionType, space: dict[str, Any]) -> FunctionType:
    """Return a function with the same code and another global namespace."""
    bound = FunctionType(function.__code__, space, function.__name__, function.__defaults__)
    bound.__annotations__ = function.__annotations__
    return bound


@cache
def _hash_of_sources() -> str:
    folder = Path(__file__).parent
    paths = [Path(str(module.__file__)) for module in _MODULES]
    digest = hashlib.sha256()
    for path in (*paths, *(folder / f'{name}.py' for name in ('kernel', 'parts', 'vectors'))):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def check_available() -> None:
    """Check that there is a compiler."""
    if not available():
        raise UsageError("numba, which compiles the core, is not installed: install "
                         "'mddag_executor[batch]' with pip")


def pays(plain_s: float) -> bool:
    """Return whether compiled code is faster for such work in the long run."""
    return available() and (plain_s * _REPEATS > _COMPILE_S or _is_compiled())


def _is_compiled() -> bool:
    """Return whether the code is in memory or stored; importing numba takes half a second."""
    entry: Any = entry_points()['run_each'] if entry_points.cache_info().currsize else None
    if entry is not None and entry.signatures:
        return True
    name = f'kernel.run_each_{_hash_of_sources()}*.nbi'
    cache = Path(os.environ.get('XDG_CACHE_HOME') or '~/.cache', 'numba')
    return any(
        any(folder.expanduser().rglob(name)) for folder in (
            Path(os.environ.get('NUMBA_CACHE_DIR') or cache), Path(__file__).parent, cache))


def prepare() -> None:
    """Compile the core, or load it from disk, with a call that runs nothing."""
    with _interruptible():
        run_each(Tables.build(None), Workload([], [], [], [], [], []), 'rad',
                 EngineOptions(*[0] * len(EngineOptions._fields)))


@contextmanager
def _interruptible() -> Iterator[None]:
    """Repeat a Ctrl-C that comes where LLVM calls Python, which would lose the exception."""
    before = signal.getsignal(signal.SIGINT)
    if not callable(before) or threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, frame: FrameType | None) -> None:
        at = frame
        while at is not None and not at.f_code.co_name.startswith('_raw_object_cache_'):
            at = at.f_back
        if at is None:
            before(number, frame)
        else:
            threading.Timer(0.01, _thread.interrupt_main).start()

    signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


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
    addresses = [each.address for each in working]
    _compile_parts()
    ended = entry_points()['run_each'](
        *(each.address for each in lent), *addresses, missed.address)
    try:
        decisions, busy, log = (
            State._fields.index('decisions'), *map(Pool._fields.index, ('busy', 'log')))
        return ((int(ended), Rows(workers.words(log, 6)),  # type: ignore[return-value]
                 Rows(core.words(decisions, 6)), workers.words(busy, 1)[:, 0].tolist()),
                missed.words(0, 1)[:, 0].tolist())
    finally:
        entry_points()['free_run'](*addresses)


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

    def words(self, field: int, width: int) -> npt.NDArray[np.int64]:
        """Return a copy of a field, a vector whose elements have ``width`` words."""
        address, length = self._words[3 * field:3 * field + 2].tolist()
        if length == 0:
            return np.empty((0, width), dtype=np.int64)
        data = (ctypes.c_int64 * (length * width)).from_address(address)
        return np.array(data, dtype=np.int64).reshape(length, width)


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
