# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Writes the instructions of one function: its blocks, and its use of memory.

A store to an element of a vector does not change the address or the length of any vector.  The
marks of loads and stores say so to LLVM, which may then keep these in registers.  A vector in a
vector is an element that is an address and a length, and is marked as these.

This module needs llvmlite.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from llvmlite import ir
from mddag_executor.compiler.kinds import (
    INTEGER,
    Kind,
    Structure,
    TRUTH,
    Vector,
    WORDS,
)
from mddag_executor.compiler.program import (
    ADDRESS,
    BIT,
    Callee,
    INT64,
    NotCompiledError,
    Program,
    types_of,
)


class Value(NamedTuple):
    """A value: its kind, and its words (one, except for tuples)."""

    kind: Kind
    words: tuple[Any, ...]


class Loop(NamedTuple):
    """A loop: its counter, and the blocks where ``continue`` and ``break`` go."""

    counter: Any
    again: Any
    after: Any


def integer(word: Any) -> Value:
    """Return a word as a value."""
    return Value(INTEGER, (word,))


def truth(bit: Any) -> Value:
    """Return a bit as a value."""
    return Value(TRUTH, (bit,))


class Writer:
    """
    Writes a function.

    :ivar builder: writes instructions, at the present place.
    """

    def __init__(self, program: Program, callee: Callee) -> None:
        self.program = program
        self.callee = callee
        self._function = callee.function
        self._first = ir.IRBuilder(self._function.append_basic_block('variables'))
        self.builder = ir.IRBuilder(self._function.append_basic_block('begin'))
        self._begin = self.builder.block
        self._lists: list[Any] = []

    def error(self, node: ast.AST, what: str) -> NotCompiledError:
        """Return the error that something is not compiled, with its place."""
        line = getattr(node, 'lineno', self.callee.source.definition.lineno)
        return NotCompiledError(f'{self.callee.source.file}:{line}: {what}')

    # --- blocks ----------------------------------------------------------------------------------

    def block(self, name: str) -> Any:
        """Return a new block."""
        return self._function.append_basic_block(name)

    def begin(self, block: Any) -> None:
        """Write the following into a block."""
        self.builder.position_at_end(block)

    @property
    def has_ended(self) -> bool:
        """Return whether nothing can follow in the present block."""
        return bool(self.builder.block.is_terminated)

    def go_to(self, block: Any) -> None:
        """End the present block, if it has not ended."""
        if not self.has_ended:
            self.builder.branch(block)

    @contextmanager
    def loop(self, begin: Any, step: Any, test: Callable[[Any], Any]) -> Iterator[Loop]:
        """
        Write a loop around what is written meanwhile.

        :param test: writes the condition of a turn, and returns its bit.
        """
        place = self._first.alloca(INT64)
        self.builder.store(begin, place)
        check, body, again, after = map(self.block, ('test', 'body', 'again', 'after'))
        self.go_to(check)
        self.begin(check)
        self.builder.cbranch(test(self.builder.load(place)), body, after)
        self.begin(again)
        self.builder.store(self.builder.add(self.builder.load(place), step), place)
        self.go_to(check)
        self.begin(body)
        yield Loop(self.builder.load(place), again, after)
        self.go_to(again)
        self.begin(after)

    def indices(self, header: Any) -> Any:
        """Write a loop over the indices of a vector, which may become longer meanwhile."""
        return self.loop(INT64(0), INT64(1), lambda index: self.builder.icmp_signed(
            '<', index, self.length(header)))

    def choose(self, found: Sequence[tuple[Any, Any]]) -> Any:
        """Return the word that comes from the block before: pairs of words and blocks."""
        together = self.builder.phi(found[0][0].type)
        for word, block in found:
            together.add_incoming(word, block)
        return together

    # --- variables -------------------------------------------------------------------------------

    def variable(self, kind: Kind) -> tuple[Any, ...]:
        """Return places for the words of a value."""
        return tuple(self._first.alloca(each) for each in types_of(kind))

    def new_list(self) -> Any:
        """Return the header of an empty vector, which is freed at the end."""
        header = self._first.alloca(INT64, WORDS)
        for place in range(WORDS):
            self._first.store(INT64(0), self._first.gep(header, [INT64(place)]))
        self._lists.append(header)
        return header

    def finish(self) -> None:
        """Free the lists, and go from the variables to the begin."""
        for header in self._lists:
            self.builder.call(self.program.external['free'], [self._data(header)])
        self._first.branch(self._begin)

    def as_integer(self, value: Value) -> Value:
        """Return a value as variables have it: a truth value is an integer."""
        if value.kind is TRUTH:
            return integer(self.builder.zext(value.words[0], INT64))
        return value

    def as_kind(self, kind: Kind, value: Value, node: ast.AST) -> Value:
        """Return a value as one of a kind."""
        value = self.as_integer(value)
        are_nested = (isinstance(kind, Vector) and isinstance(value.kind, Vector)
                      and kind.nested and value.kind.nested)
        if kind != value.kind and not are_nested:
            raise self.error(node, f'this is {value.kind}, not {kind}')
        return value

    # --- vectors and structures ------------------------------------------------------------------

    def _load(self, place: Any, mark: str) -> Any:
        loaded = self.builder.load(place)
        loaded.set_metadata('tbaa', self.program.marks[mark])
        return loaded

    def _store(self, word: Any, place: Any, mark: str) -> None:
        stored = self.builder.store(word, place)
        stored.set_metadata('tbaa', self.program.marks[mark])

    def _word_at(self, address: Any, place: int) -> Any:
        return self.builder.gep(address, [INT64(place)]) if place else address

    def _data(self, header: Any) -> Any:
        """Return the address of the data of a vector."""
        return self._load(self.builder.bitcast(header, ADDRESS.as_pointer()), 'header')

    def length(self, header: Any) -> Any:
        """Return the length of a vector."""
        return self._load(self._word_at(header, 1), 'header')

    def set_length(self, header: Any, length: Any) -> None:
        """Set the length of a vector, at most the present one."""
        self._store(length, self._word_at(header, 1), 'header')

    def _element_at(self, header: Any, kind: Vector, index: Any) -> Any:
        if kind.words > 1:
            index = self.builder.mul(index, INT64(kind.words))
        return self.builder.gep(self._data(header), [index])

    def element(self, header: Any, kind: Vector, index: Any) -> Value:
        """Return an element of a vector."""
        place = self._element_at(header, kind, index)
        if kind.nested:
            return Value(kind.element, (place,))
        return Value(kind.element, tuple(
            self._load(self._word_at(place, i), 'element') for i in range(kind.words)))

    def set_element(self, header: Any, kind: Vector, index: Any, value: Value) -> None:
        """Set an element of a vector, which is not a vector."""
        place = self._element_at(header, kind, index)
        for i, word in enumerate(value.words):
            self._store(word, self._word_at(place, i), 'element')

    def lengthen(self, header: Any, kind: Vector) -> Any:
        """Make room for another element at the end of a vector, and return its index."""
        length = self.length(header)
        is_full = self.builder.icmp_signed(
            '==', length, self._load(self._word_at(header, 2), 'header'))
        with self.builder.if_then(is_full, likely=False):
            self.builder.call(self.program.grow, [header, INT64(kind.words)])
        self.set_length(header, self.builder.add(length, INT64(1)))
        return length

    def append_empty(self, header: Any, kind: Vector) -> None:
        """Append an empty vector to a vector of vectors."""
        self._clear(self._element_at(header, kind, self.lengthen(header, kind)))

    def field(self, address: Any, kind: Structure, name: str) -> Value:
        """Return a field of a structure."""
        place = self._word_at(address, kind.place(name))
        if isinstance(kind.fields[name], Vector):
            return Value(kind.fields[name], (place,))
        return integer(self._load(place, 'header'))

    def free_all(self, address: Any, kind: Structure) -> None:
        """Free the vectors of a structure, which are empty then."""
        for name, each in kind.fields.items():
            if isinstance(each, Vector):
                header = self._word_at(address, kind.place(name))
                if each.nested:
                    with self.indices(header) as loop:
                        self._free(self._element_at(header, each, loop.counter))
                self._free(header)

    def _free(self, header: Any) -> None:
        self.builder.call(self.program.external['free'], [self._data(header)])
        self._clear(header)

    def _clear(self, header: Any) -> None:
        for word in range(WORDS):
            self._store(INT64(0), self._word_at(header, word), 'header')

    # --- comparisons -----------------------------------------------------------------------------

    def compare(self, sign: str, left: Sequence[Any], right: Sequence[Any]) -> Any:
        """Return the bit of a comparison; the first words that are different decide."""
        if len(left) == 1:
            return self.builder.icmp_signed(sign, left[0], right[0])
        after = self.block('compared')
        found = []
        for one, other in zip(left[:-1], right[:-1]):
            found.append((self.builder.icmp_signed(sign, one, other), self.builder.block))
            following = self.block('equal')
            self.builder.cbranch(
                self.builder.icmp_signed('==', one, other), following, after)
            self.begin(following)
        found.append((self.builder.icmp_signed(sign, left[-1], right[-1]), self.builder.block))
        self.go_to(after)
        self.begin(after)
        return self.choose(found)

    def contains(self, header: Any, kind: Vector, wanted: Value) -> Any:
        """Return the bit of whether a vector contains a value."""
        place = self._first.alloca(BIT)
        self.builder.store(BIT(0), place)
        with self.indices(header) as loop:
            element = self.element(header, kind, loop.counter)
            is_equal = self.compare('==', element.words, wanted.words)
            self.builder.store(is_equal, place)
            self.builder.cbranch(is_equal, loop.after, loop.again)
        return self.builder.load(place)
