# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Functions of the core that are compiled separately.

Theory of operation
-------------------
numba links each compiled function into its callers, and optimises it there again, through all
levels of calls.  A *part* is compiled once, as a function of C with a symbol, by which others call
it.  Its arguments are integers and addresses.  The key function, of which there is only one, is
not passed, and a truth value is an integer: then short functions around the part are generated,
one for the part itself and one for its callers.

A part must be compiled, or loaded, before its callers are: the linker looks for its symbol.

This module needs numba; nothing is compiled when it is imported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
import dis
from types import FunctionType
from typing import Any

from llvmlite import binding
from mddag_executor.simulate.kernel import key_of_policy, KINDS
from numba import njit, types

KEY = 'KeyFunction'


def linked(function: Any) -> Any:
    """Return a function that is compiled into its callers: no wrappers for Python or C."""
    return njit(error_model='numpy', no_cpython_wrapper=True, no_cfunc_wrapper=True)(function)


class Part:
    """
    A function that is compiled separately.

    :param function: bound to the common namespace.
    :param sources: a hash of all sources, as a part of the symbol.
    :param file: the one whose date decides whether stored code is of the present source.
    :ivar callee: what others call.
    """

    def __init__(self, function: FunctionType, sources: str, file: str) -> None:
        code, self._kinds = function.__code__, function.__annotations__
        arguments = code.co_varnames[:code.co_argcount]
        passed = [name for name in arguments if self._kinds[name] != KEY]
        returns = self._kinds['return']
        self.name = function.__name__
        self._symbol = f'mddag_{self.name}_{sources}'
        self._signature = (types.void if returns == 'None' else types.int64)(
            *(KINDS[self._kinds[name]] for name in passed))
        self.callee: Any = types.ExternalFunction(self._symbol, self._signature)
        self._function = function
        if len(passed) < len(arguments) or returns == 'bool':
            given = ', '.join('key' if name not in passed else name for name in arguments)
            inner, outer = f'part({given})', f'part({", ".join(passed)})'
            if returns == 'bool':
                inner, outer = f'return int({inner})', f'return {outer} != 0'
            elif returns == 'int':
                inner, outer = f'return {inner}', f'return {outer}'
            self._function = _written(
                self.name, passed, inner, file, part=linked(function), key=key_of_policy)
            self.callee = linked(_written(
                self.name, arguments, outer, file, part=self.callee))
        self._compiled: Any = None

    def compile(self, store: Callable[..., Any]) -> None:
        """Compile it, or load it; ``store`` receives the function and its signature."""
        self._compiled = store(self._function, self._signature)
        binding.add_symbol(self._symbol, self._compiled.address)


def _written(
    name: str, arguments: Iterable[str], body: str, file: str, **names: Any
) -> FunctionType:
    """Return a function of one line."""
    space = {'__name__': __name__, **names}
    exec(compile(f'def {name}({", ".join(arguments)}):\n    {body}', file, 'exec'), space)
    written: FunctionType = space[name]
    return written


def called_first(names: Iterable[str], functions: dict[str, FunctionType]) -> Iterator[str]:
    """
    Yield names of functions so that each comes after those that it calls.

    :param functions: all functions of the namespace by name.
    """
    seen = set()
    wanted = set(names)

    def visit(name: str) -> Iterator[str]:
        if name in seen or name not in functions:
            return
        seen.add(name)
        for step in dis.get_instructions(functions[name]):
            if step.opname == 'LOAD_GLOBAL':
                yield from visit(step.argval)
        if name in wanted:
            yield name

    for name in sorted(wanted):
        yield from visit(name)
