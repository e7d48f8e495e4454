# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
The core compiled to machine code: the same source, with structures of vectors for named tuples.

Theory of operation
-------------------
The functions of ``core.state``, ``core.jobs``, ``core.rules``, ``core.policies`` and ``engine``
are taken as they are and bound to a namespace of their own, in which each other's names stand for
the compiled functions, and ``heapq``'s for those of ``vectors``.  There is no second copy of a
rule.  Only ``add_queue`` is replaced, as an empty list has no type.  The policy is a field that
is added to the tables, and the key function one that looks at it, so that all policies need one
compilation.

What numba makes of an entry point (with everything that it calls inside) is kept on disk, in
``$XDG_CACHE_HOME/mddag_executor`` (``~/.cache``), under a hash of all sources and versions that it
was made from; numba itself adds the processor.  Where that folder can not be written, each process
compiles anew.  Nothing is compiled, and numba is not imported, before the first use.

Compiling leaves some 130 MB behind: LLVM keeps a module for each of about 90 functions, with a
copy of all that the function calls.  Loading needs none of it.  So a process of its own compiles,
and ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
import ctypes
from functools import cache
import hashlib
from importlib.util import find_spec
import os
from pathlib import Path
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from types import FunctionType, ModuleType
from typing import Any, NamedTuple

from mddag_executor.core import jobs, policies, queues, rules, state, tables
from mddag_executor.core.policies import POLICIES
from mddag_executor.core.policies import policy as find_policy
from mddag_executor.core.state import Decision, State
from mddag_executor.core.tables import Tables
from mddag_executor.simulate import engine
from mddag_executor.simulate.draws import Times
from mddag_executor.simulate.engine import Load, LogEntry
from mddag_executor.simulate.run import periodic_load, Settings
from msg_graph import TaskSet
import numpy as np
import numpy.typing as npt

_MODULES = (tables, state, queues, jobs, policies, rules, engine)
_NOT_COMPILED = frozenset({
    'new_state', 'add_queue', 'rad_offsets', 'latest_starts', 'policy'})  # for plain lists
_OWN = ('compiled', 'kernel', 'structures', 'vectors')
_REPLACED = ('add_queue', 'heapify', 'heappop', 'heappush')
_ENTRIES = ('accept_runs', 'run_once', 'free_run')
_KEEP_S = 90 * 86400
_WORD = 8


def available() -> bool:
    """Tell whether numba is there and allowed to compile."""
    return find_spec('numba') is not None and os.environ.get('NUMBA_DISABLE_JIT', '0') == '0'


def cached() -> bool:
    """Tell whether what ``evaluate`` needs has been compiled before (for any processor)."""
    folder = _folder()
    return folder is not None and any(folder.glob('**/*accept_runs*.nbc'))


@cache
def _fingerprint(more: tuple[str, ...] = ()) -> str:
    """
    Return a hash of all that the compiled code depends on.

    :param more: names of further modules that are compiled.
    """
    import llvmlite
    import numba
    digest = hashlib.sha256()
    for version in (numba.__version__, llvmlite.__version__, np.__version__,
                    platform.python_version(), platform.machine()):
        digest.update(version.encode() + b'\0')
    names = {module.__name__ for module in _MODULES}
    names |= {row.key.__module__ for row in POLICIES.values()}
    names |= {f'{__package__}.{name}' for name in _OWN}
    names |= set(more)
    files = set()
    for name in sorted(names):
        spec = find_spec(name)
        if spec is not None and spec.origin is not None:
            files.add(spec.origin)
    for file in sorted(files):
        digest.update(Path(file).read_bytes() + b'\0')
    digest.update(','.join(POLICIES).encode())
    return digest.hexdigest()[:24]


def _folder(more: tuple[str, ...] = ()) -> Path | None:
    """Return the folder for the compiled code, whether it is there or not; None without a home."""
    base = os.environ.get('XDG_CACHE_HOME') or os.path.expanduser('~/.cache')
    if not os.path.isabs(base):
        return None
    return Path(base, 'mddag_executor', _fingerprint(more))


def _stamp(more: tuple[str, ...] = ()) -> Path | None:
    """
    Return a file beside which numba may keep what it compiles; None where there can be none.

    numba keeps the code with the source file of a function, and compiles anew when that file is
    changed.  This file is never changed: its folder's name tells the sources.
    """
    folder = _folder(more)
    if folder is None:
        return None
    file = folder / 'kernel.py'
    try:
        if not file.exists():
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            _forget_old(folder.parent)
            with tempfile.NamedTemporaryFile('w', dir=folder, delete=False) as part:
                part.write('# Compiled code of mddag_executor; this folder can be deleted.\n')
            os.replace(part.name, file)
    except OSError:
        return None
    return file


def _forget_old(folder: Path) -> None:
    """Remove what was compiled from sources of long ago."""
    for old in folder.iterdir():
        stamp = old / 'kernel.py'
        if stamp.is_file() and stamp.stat().st_mtime < time.time() - _KEEP_S:
            shutil.rmtree(old, ignore_errors=True)


@cache
def _entries() -> dict[str, Callable[..., Any]]:
    """Return the compiled entry points, which compile, or load what was compiled, when called."""
    from mddag_executor.simulate import kernel
    return _compiled_entries((kernel,), _ENTRIES, _stamp())


def entries_of(
    kernels: tuple[ModuleType, ...], names: tuple[str, ...], sources: tuple[str, ...]
) -> dict[str, Callable[..., Any]]:
    """
    Return entry points of another driver of the compiled core, as those of ``kernel`` are.

    :param kernels: modules all of whose functions are compiled beside those of the core, under
        names that are not in use there; their entry points are in the last one.
    :param names: of the entry points.
    :param sources: names of all modules that what is compiled depends on, the core's left out.
    """
    return _compiled_entries(kernels, names, _stamp(sources))


def keeps_entries(sources: tuple[str, ...]) -> bool:
    """Tell whether there is a folder to keep what is compiled (see ``entries_of``)."""
    return _stamp(sources) is not None


def cached_entries(sources: tuple[str, ...], name: str) -> bool:
    """Tell whether an entry point of a driver (see ``entries_of``) has been compiled before."""
    folder = _folder(sources)
    return folder is not None and any(folder.glob(f'**/*{name}*.nbc'))


def _compiled_entries(
    kernels: tuple[ModuleType, ...], names: tuple[str, ...], stamp: Path | None
) -> dict[str, Callable[..., Any]]:
    from mddag_executor.simulate import structures, vectors
    from numba import njit
    space = dict(vars(kernels[-1]))  # with its name: what is loaded from disk looks its module up
    for module in (*_MODULES, *kernels):
        space.update((k, v) for k, v in vars(module).items() if not k.startswith('__'))
    space.update((name, getattr(vectors, name)) for name in _REPLACED)
    for module in (*_MODULES, *kernels):
        inner = ModuleType(module.__name__)  # for names such as `rules.complete`
        for name, function in _functions(module):
            assert space[name] is function or name in _REPLACED, f'there are two of {name}'
            space[name] = njit(error_model='numpy')(_bound(function, space))
            setattr(inner, name, space[name])
        if module in (jobs, rules):
            space[module.__name__.rsplit('.', 1)[1]] = inner
    structures.bind_policies(space)
    return {
        name: njit(error_model='numpy', nogil=True, cache=stamp is not None)(
            _bound(getattr(kernels[-1], name), space, None if stamp is None else str(stamp)))
        for name in names}


def _functions(module: ModuleType) -> list[tuple[str, FunctionType]]:
    """Return the functions that a module itself defines and that are to be compiled."""
    return [
        (name, value) for name, value in vars(module).items()
        if isinstance(value, FunctionType) and value.__module__ == module.__name__
        and name not in _NOT_COMPILED]


def _bound(function: Any, space: dict[str, Any], file: str | None = None) -> FunctionType:
    """Return a function with the same code whose globals are those of a namespace."""
    code = function.__code__ if file is None else function.__code__.replace(co_filename=file)
    return FunctionType(code, space, function.__name__, function.__defaults__)


def compile_elsewhere(module: str = __name__) -> None:
    """Have a process compile what a module needs; if it fails, this one does when it needs it."""
    program = f'from {module} import compile_here; compile_here()'
    path = os.pathsep.join(each or os.getcwd() for each in sys.path)
    try:
        done = subprocess.run(
            [sys.executable, '-c', program], env={**os.environ, 'PYTHONPATH': path},
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    except OSError:
        return
    if done.returncode == -signal.SIGINT:  # Ctrl-C went to both
        raise KeyboardInterrupt


def compile_here() -> None:
    """Compile what ``evaluate`` needs, by evaluating no run of nothing."""
    nothing = Empty(max(len(Tables._fields) + 1, len(State._fields)))
    _entries()['accept_runs'](
        nothing.address, nothing.address, nothing.address, 0, 0, 1, 0, 0, 0, 0, 1, False,
        np.zeros(0, dtype=np.bool_))


# --- handing over --------------------------------------------------------------------------------

class Lent:
    """A named tuple of integers and lists, as a structure in numpy's memory."""

    def __init__(self, row: NamedTuple, *more: int) -> None:
        self._columns: list[npt.NDArray[np.int64]] = []  # keeps the memory
        words = []
        for value in (*row, *more):
            if isinstance(value, int):
                words += [value, 0, 0]
                continue
            column = np.array(value, dtype=np.int64)
            self._columns.append(column)
            words += [column.ctypes.data, len(column), len(column)]
        self._words = np.array(words, dtype=np.int64)

    @property
    def address(self) -> int:
        """Return where the structure is, as long as this object lives."""
        return int(self._words.ctypes.data)

    def copy(self) -> Lent:
        """Return a structure of its own over the same columns."""
        copied = copy(self)
        copied._words = self._words.copy()
        return copied


class Empty:
    """Memory for a structure or a vector that is all empty."""

    def __init__(self, fields: int = 1) -> None:
        self._words = np.zeros(3 * fields, dtype=np.int64)

    @property
    def address(self) -> int:
        """Return where it is, as long as this object lives."""
        return int(self._words.ctypes.data)

    def length(self, field: int) -> int:
        """Return how many elements a field has, which is a vector."""
        return int(self._words[3 * field + 1])

    def write(self, field: int, values: Sequence[int]) -> None:
        """Write a field, which is a vector of so many numbers."""
        address, length = self._words[3 * field:3 * field + 2].tolist()
        assert length == len(values)
        data = (ctypes.c_int64 * length).from_address(address)
        data[:] = list(values)

    def rows(self, field: int, width: int) -> list[tuple[int, ...]]:
        """Return a copy of a field, which is a vector of tuples."""
        address, length = self._words[3 * field:3 * field + 2].tolist()
        if length == 0:
            return []
        data = (ctypes.c_int64 * (length * width)).from_address(address)
        rows = np.ctypeslib.as_array(data).reshape(length, width).tolist()
        return [tuple(row) for row in rows]


class CompiledJudge:
    """
    Simulates runs in compiled code (see ``evaluate.Judge``); several threads may call it.

    :param duration_ns: of each run.
    """

    def __init__(self, task_set: TaskSet, duration_ns: int) -> None:
        built = Tables.build(task_set)
        load = periodic_load(
            task_set, [[0] * len(dag.vertices) for dag in task_set.dags], duration_ns)
        self._columns = built.n_vertices
        self._duration_ns = duration_ns
        self._tables = [Lent(built, number) for number in range(len(POLICIES))]
        self._load = Lent(load._replace(
            cost_base=[built.first_vertex[dag.index] for dag in task_set.dags]))

    def warm_up(self) -> None:
        """Compile, or load what was compiled before."""
        if _stamp() is not None and not cached():
            compile_elsewhere()
        none = np.ones((0, self._columns), dtype=np.int64)
        self(Settings(preemptive=False, judge='completions'), none)

    def __call__(self, settings: Settings, times: Times) -> npt.NDArray[np.bool_]:
        """Tell which of the runs met every deadline."""
        row = find_policy(settings.policy)
        preemptive = row.mode(settings.preemptive)
        load = self._load.copy()  # whose costs become each run's
        working = Empty(len(State._fields))
        times = np.ascontiguousarray(times, dtype=np.int64)
        accepted = np.zeros(len(times), dtype=np.bool_)
        _entries()['accept_runs'](
            self._tables[list(POLICIES).index(settings.policy)].address, load.address,
            working.address, times.ctypes.data, self._columns * _WORD, settings.workers,
            int(preemptive), int(row.polling), settings.dispatch_overhead_ns,
            settings.switch_overhead_ns, self._duration_ns, settings.judge == 'horizon', accepted)
        return accepted


def run_compiled(
    built: Tables, load: Load, settings: Settings
) -> tuple[int, list[LogEntry], list[Decision]]:
    """
    Run the compiled core over a load, as ``engine.run`` does with the plain one.

    :return: when the run ended (ns), the log of every worker, and the core's decisions.
    """
    row = find_policy(settings.policy)
    lent = Lent(built, list(POLICIES).index(settings.policy))
    lent_load = Lent(load)
    working = Empty(len(State._fields))
    log = Empty()
    entries = _entries()
    ended = entries['run_once'](
        lent.address, lent_load.address, working.address, settings.workers,
        int(row.mode(settings.preemptive)), int(row.polling), settings.dispatch_overhead_ns,
        settings.switch_overhead_ns, settings.duration_ns, settings.stop_at_first_miss,
        settings.judge == 'horizon', log.address)
    try:
        place = State._fields.index('decisions')
        return int(ended), log.rows(0, 6), working.rows(place, 6)  # type: ignore[return-value]
    finally:
        entries['free_run'](working.address, log.address)
