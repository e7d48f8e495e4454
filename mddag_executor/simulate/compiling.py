# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The core's own source compiled to machine code, for any driver; and kept on disk.

Theory of operation
-------------------
The functions of ``core.state``, ``core.jobs``, ``core.rules``, ``core.policies`` and ``engine``
are taken as they are and bound to a namespace of their own, in which each other's names stand for
the compiled functions, and ``heapq``'s for those of ``vectors``.  There is no second copy of a
rule.  Only ``add_queue`` is replaced, as an empty list has no type.  The policy is a field that
is added to the tables, and the key function one that looks at it, so that all policies need one
compilation.

A driver is a module of functions that are compiled beside those of the core, some of them *entry
points*: ``kernel``.

What numba makes of an entry point (with everything that it calls inside) is kept on disk, in
``$XDG_CACHE_HOME/mddag_executor`` (``~/.cache``), under a hash of all sources and versions that it
was made from; numba itself adds the processor.  Where that folder cannot be written, each process
compiles anew.  Nothing is compiled, and numba is not imported, before the first use.

Compiling leaves some 130 MB behind: LLVM keeps a module for each of about 90 functions, with a
copy of all that the function calls.  Loading needs none of it.  So a process of its own compiles,
and ends.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
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
from typing import Any

from mddag_executor import progress
from mddag_executor.core import jobs, policies, queues, rules, state, tables
from mddag_executor.core.policies import POLICIES
from mddag_executor.resources import import_environment
from mddag_executor.simulate import deliveries, engine, load, machine
import numpy as np

_MODULES = (
    tables, state, queues, jobs, policies, rules, load, machine, deliveries, engine)
_NOT_COMPILED = frozenset({
    # for plain lists
    'empty', 'as_object', 'new_state', 'add_queue', 'rad_offsets', 'latest_starts', 'policy',
    'new_machine', 'as_arrays', 'as_lists', 'edges_of', 'edge_numbers'})
_OWN = ('compiled', 'compiling', 'kernel', 'structures', 'vectors')
_REPLACED = ('add_queue', 'heapify', 'heappop', 'heappush')
_KEEP_S = 90 * 86400


def available() -> bool:
    """Return whether numba is there and allowed to compile."""
    return find_spec('numba') is not None and os.environ.get('NUMBA_DISABLE_JIT', '0') == '0'


def entries_of(kernel: ModuleType, names: tuple[str, ...]) -> dict[str, Callable[..., Any]]:
    """
    Return entry points of a driver of the core, which compile, or load what was, when called.

    :param kernel: the driver, all of whose functions are compiled beside those of the core.
    :param names: of the entry points.
    """
    return _compiled_entries(kernel, names, _stamp())


def keeps_entries() -> bool:
    """Return whether there is a folder to keep what is compiled (see ``entries_of``)."""
    return _stamp() is not None


def cached_entries(name: str) -> bool:
    """Return whether an entry point (see ``entries_of``) has been compiled before."""
    folder = _folder()
    return folder is not None and any(folder.glob(f'**/*{name}*.nbc'))


@cache
def _fingerprint() -> str:
    """Return a hash of all that the compiled code depends on."""
    import llvmlite
    import numba
    digest = hashlib.sha256()
    for version in (numba.__version__, llvmlite.__version__, np.__version__,
                    platform.python_version(), platform.machine()):
        digest.update(version.encode() + b'\0')
    names = {module.__name__ for module in _MODULES}
    names |= {row.key.__module__ for row in POLICIES.values()}
    names |= {f'{__package__}.{name}' for name in _OWN}
    files = set()
    for name in sorted(names):
        spec = find_spec(name)
        if spec is not None and spec.origin is not None:
            files.add(spec.origin)
    for file in sorted(files):
        digest.update(Path(file).read_bytes() + b'\0')
    digest.update(','.join(POLICIES).encode())
    return digest.hexdigest()[:24]


def _folder() -> Path | None:
    """Return the folder for the compiled code, whether it is there or not; None without a home."""
    base = os.environ.get('XDG_CACHE_HOME') or os.path.expanduser('~/.cache')
    if not os.path.isabs(base):
        return None
    return Path(base, 'mddag_executor', _fingerprint())


def _stamp() -> Path | None:
    """
    Return a file beside which numba may keep what it compiles; None where there can be none.

    numba keeps the code with the source file of a function, and compiles anew when that file is
    changed.  This file is never changed: its folder's name identifies the sources.
    """
    folder = _folder()
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


def _compiled_entries(
    kernel: ModuleType, names: tuple[str, ...], stamp: Path | None
) -> dict[str, Callable[..., Any]]:
    from mddag_executor.simulate import structures, vectors
    from numba import njit
    space = dict(vars(kernel))  # with its name: what is loaded from disk looks its module up
    for module in (*_MODULES, kernel):
        space.update((k, v) for k, v in vars(module).items() if not k.startswith('__'))
    space.update((name, getattr(vectors, name)) for name in _REPLACED)
    for module in (*_MODULES, kernel):
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
            _bound(getattr(kernel, name), space, None if stamp is None else str(stamp)))
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


def compile_elsewhere(call: str) -> None:
    """
    Have a process compile what this one needs; if it fails, this one does when it needs it.

    :param call: of a function of a module, ``MODULE.FUNCTION(ARGUMENTS)``, that compiles.
    """
    program = f'import {call.split("(")[0].rpartition(".")[0]}; {call}'
    try:
        process = subprocess.Popen(
            [sys.executable, '-c', program], env=import_environment(),
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    except OSError:
        return
    try:
        while process.poll() is None:
            progress.report('the core is being compiled, once')
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(0.2)
    finally:  # after Ctrl-C, too
        process.kill()
        process.wait()
    if process.returncode == -signal.SIGINT:  # Ctrl-C went to both
        raise KeyboardInterrupt
