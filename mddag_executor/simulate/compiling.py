# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Compiles the core's own source to machine code.

Theory of operation
-------------------
The functions of the core and of the event loop are used unchanged: each is bound to a common
namespace, in which the names of the others refer to their compiled versions, and the names of
``heapq`` to those of ``vectors``.  So a name, also of a constant, must mean the same in all
modules.  No rule exists twice.  Only ``add_queue`` is replaced, because an empty list has no type.
The policy is an additional field of the tables; the key function selects by it, so one compilation
is enough for all policies.

numba stores the machine code of the entry points (``kernel``) on disk (``cache=True``).  It only
checks the file of the entry point itself, so a hash of all sources is part of the stored name.
numba is imported, and code is compiled, on first use only.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
import hashlib
from importlib.util import find_spec
import os
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from mddag_executor.core import jobs, overload, policies, queues, rules, state, tables
from mddag_executor.simulate import deliveries, engine, load, machine

_MODULES = (
    tables, state, queues, jobs, overload, policies, rules, load, machine, deliveries, engine)
_NOT_COMPILED = frozenset({
    # for plain lists
    'empty', 'as_object', 'new_state', 'add_queue', 'rad_offsets', 'reached_sinks', 'mean_time',
    'policy', 'new_machine', 'as_arrays', 'as_lists', 'edges_of', 'edge_numbers'})
ENTRY_POINTS = ('run_once', 'free_run')
_REPLACED = ('add_queue', 'heapify', 'heappop', 'heappush')


def available() -> bool:
    """Return whether numba is installed and may compile."""
    return find_spec('numba') is not None and os.environ.get('NUMBA_DISABLE_JIT', '0') == '0'


@cache
def entry_points() -> dict[str, Callable[..., Any]]:
    """Return the compiled entry points of ``kernel`` by name; they are compiled when called."""
    from mddag_executor.simulate import kernel, structures, vectors
    from numba import njit
    space = dict(vars(kernel))  # with its name: code loaded from disk looks its module up
    for module in (*_MODULES, kernel):
        for name, value in vars(module).items():
            if not name.startswith('__'):
                assert space.setdefault(name, value) is value, f'there are two of {name}'
    space.update((name, getattr(vectors, name)) for name in _REPLACED)
    for module in (*_MODULES, kernel):
        inner = ModuleType(module.__name__)  # for names such as `rules.complete`
        for name, function in _functions(module):
            space[name] = njit(error_model='numpy')(_bound(function, space))
            setattr(inner, name, space[name])
        if module in (jobs, overload, rules):
            space[module.__name__.rsplit('.', 1)[1]] = inner
    structures.bind_policies(space)
    sources = _hash_of(*_MODULES, kernel, structures, vectors)
    return {name: _cached(_bound(getattr(kernel, name), space), sources)
            for name in ENTRY_POINTS}


def _cached(function: FunctionType, sources: str) -> Any:
    from numba import njit
    # part of the names of numba's files
    function.__qualname__ = f'{function.__name__}_{sources}'
    try:
        return njit(error_model='numpy', nogil=True, cache=True)(function)
    except RuntimeError:    # no writable folder
        return njit(error_model='numpy', nogil=True)(function)


def _functions(module: ModuleType) -> list[tuple[str, FunctionType]]:
    """Return the functions of a module that are to be compiled."""
    return [
        (name, value) for name, value in vars(module).items()
        if isinstance(value, FunctionType) and value.__module__ == module.__name__
        and name not in _NOT_COMPILED]


def _bound(function: FunctionType, space: dict[str, Any]) -> FunctionType:
    """Return a function with the same code and another global namespace."""
    return FunctionType(function.__code__, space, function.__name__, function.__defaults__)


def _hash_of(*modules: ModuleType) -> str:
    digest = hashlib.sha256()
    for module in modules:
        digest.update(Path(str(module.__file__)).read_bytes())
    return digest.hexdigest()[:16]
