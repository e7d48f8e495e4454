# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A program: the functions that are compiled, as declarations in a module of LLVM.

This module needs llvmlite.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any, get_type_hints, NamedTuple

from llvmlite import ir
from mddag_executor.compiler.kinds import (
    ABSENT,
    Kind,
    Kinds,
    KNOWN,
    NOTHING,
    Structure,
    Tuple,
    Vector,
)

BIT, INT64 = ir.IntType(1), ir.IntType(64)
ADDRESS = INT64.as_pointer()
_BYTES = 8


class NotCompiledError(Exception):
    """The source contains what the compiler does not know."""


class Source(NamedTuple):
    """A function as a syntax tree, with the names of its module."""

    name: str
    definition: ast.FunctionDef
    names: Mapping[str, Any]
    file: str


@cache
def _parsed(file: str) -> ast.Module:
    return ast.parse(Path(file).read_text(encoding='utf-8'), file)


def source_of(function: FunctionType) -> Source:
    """Return the source of a function."""
    code = function.__code__
    for node in _parsed(code.co_filename).body:
        if isinstance(node, ast.FunctionDef) and node.name == code.co_name:
            return Source(code.co_name, node, function.__globals__, code.co_filename)
    raise NotCompiledError(f'{code.co_filename}: there is no function {code.co_name} in it')


class Callee(NamedTuple):
    """A function of the module, with the kinds of its arguments and of its result."""

    function: Any
    arguments: dict[str, Kind]
    result: Kind
    source: Source


class Program:
    """
    A module of LLVM, and the functions in it.

    :param kinds: the kinds of all annotations.
    :param replaced: functions that others stand for, such as those of ``heapq``.
    :param known: the function that every argument which is a function is, with its source.
    :ivar external: the functions of C that are called.
    :ivar marks: say to LLVM that a word is in the header, or in an element, of a vector.
    """

    def __init__(
        self, kinds: Kinds, replaced: Mapping[Any, Any],
        known: tuple[FunctionType, Source],
    ) -> None:
        self.module = ir.Module('mddag_executor')
        self._kinds = kinds
        self._replaced = replaced
        self._callees: dict[Any, Callee] = {}
        self._untranslated: list[Callee] = []
        root = self.module.add_metadata(['mddag_executor'])
        self.marks = {
            name: self.module.add_metadata([kind, kind, INT64(0)])
            for name in ('header', 'element')
            for kind in (self.module.add_metadata([name, root, INT64(0)]),)}
        self.external = {
            name: ir.Function(self.module, ir.FunctionType(result, arguments), name)
            for name, result, arguments in (
                ('realloc', ADDRESS, (ADDRESS, INT64)), ('free', ir.VoidType(), (ADDRESS,)),
                ('perror', ir.VoidType(), (ADDRESS,)),
                ('exit', ir.VoidType(), (ir.IntType(32),)))}
        self.grow = self._write_grow()
        self.known = known[0]
        self._declare(self.known, *known)

    def export(self, function: FunctionType) -> None:
        """Declare a function, which can be called from outside by its own name."""
        callee = self._declare(function, function, source_of(function), function.__name__)
        callee.function.linkage = ''

    def take_untranslated(self) -> Iterator[Callee]:
        """Yield the functions that are declared and not translated yet, until there is none."""
        while self._untranslated:
            yield self._untranslated.pop()

    def callee(self, function: Any) -> Callee | None:
        """Return a function of the module, which is translated later; None: it has no source."""
        if function not in self._callees:
            source = self._replaced.get(function, function)
            if isinstance(source, FunctionType):
                self._declare(function, source, source_of(source))
        return self._callees.get(function)

    def _declare(
        self, known_as: Any, annotated: FunctionType, source: Source, name: str = ''
    ) -> Callee:
        hints = get_type_hints(annotated)
        result = self._kinds.of(hints.pop('return'))
        arguments = {name: self._kinds.of(hint) for name, hint in hints.items()}
        words = [each for kind in arguments.values() for each in types_of(kind)]
        made = ir.Function(
            self.module, ir.FunctionType(result_type(result), words),
            name or f'{annotated.__module__}.{source.name}')
        made.linkage = 'internal'
        made.attributes.add('nounwind')
        self._callees[known_as] = callee = Callee(made, arguments, result, source)
        self._untranslated.append(callee)
        return callee

    def _write_grow(self) -> Any:
        """Write the function that doubles the capacity of a vector."""
        grow = ir.Function(
            self.module, ir.FunctionType(ir.VoidType(), (ADDRESS, INT64)), 'grow')
        grow.linkage = 'internal'
        grow.attributes.add('nounwind')
        grow.attributes.add('noinline')
        header, words = grow.args
        builder = ir.IRBuilder(grow.append_basic_block())
        capacity_at = builder.gep(header, [INT64(2)])
        data_at = builder.bitcast(header, ADDRESS.as_pointer())
        doubled = builder.shl(builder.load(capacity_at), INT64(1))
        capacity = builder.select(
            builder.icmp_signed('<', doubled, INT64(8)), INT64(8), doubled)
        size = builder.mul(builder.mul(capacity, words), INT64(_BYTES))
        data = builder.call(self.external['realloc'], [builder.load(data_at), size])
        with builder.if_then(builder.icmp_unsigned('==', data, ADDRESS(None)), likely=False):
            builder.call(self.external['perror'], [ADDRESS(None)])
            builder.call(self.external['exit'], [ir.IntType(32)(1)])
        builder.store(data, data_at)
        builder.store(capacity, capacity_at)
        builder.ret_void()
        return grow


def types_of(kind: Kind) -> list[Any]:
    """Return the types of the words of a value."""
    if kind in (KNOWN, ABSENT):
        return []
    if isinstance(kind, Tuple):
        return [INT64] * kind.width
    return [ADDRESS if isinstance(kind, (Vector, Structure)) else INT64]


def result_type(kind: Kind) -> Any:
    """Return the type of a result."""
    if kind is NOTHING:
        return ir.VoidType()
    types = types_of(kind)
    return ir.LiteralStructType(types) if len(types) > 1 else types[0]
