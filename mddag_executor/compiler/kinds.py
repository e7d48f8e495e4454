# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The kinds of values in compiled code, by the annotations of the source.

Theory of operation
-------------------
* An *integer* has 64 bits.  A *truth value* has one bit, and is an integer in variables and calls.
* A *tuple* has a number of integers that is known.
* A *vector* is the address of three words: address of its data, length, capacity.  An element is
  an integer, or a tuple, or a vector with such elements (``nested``).
* A *structure* (a class of named tuples) is the address of three words for each field: those of a
  vector, or an integer in the first one.
* An argument that is a function is *known*: it is always the same one, and is not passed.  An
  argument that may be a function or None is *absent*: it is always None.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, get_args, get_origin, get_type_hints

WORDS = 3
"""Words of a vector, and of a field."""


@dataclass(frozen=True)
class Kind:
    """The kind of a value; ``name`` distinguishes those that have no parts."""

    name: str

    def __str__(self) -> str:
        return self.name


INTEGER, TRUTH, NOTHING, KNOWN, ABSENT = map(
    Kind, ('int', 'bool', 'None', 'function', 'function or None'))


@dataclass(frozen=True)
class Tuple(Kind):
    """A tuple of ``width`` integers."""

    width: int


@dataclass(frozen=True)
class Vector(Kind):
    """
    A vector.

    :ivar width: number of integers in an element's tuple; 0 for plain integers.
    :ivar nested: the elements are vectors with elements of that width.
    """

    width: int
    nested: bool = False

    @property
    def words(self) -> int:
        """Return the number of words of an element."""
        return WORDS if self.nested else max(1, self.width)

    @property
    def element(self) -> Kind:
        """Return the kind of an element."""
        if self.nested:
            return vector(self.width)
        return tuple_of(self.width) if self.width else INTEGER


@dataclass(frozen=True)
class Structure(Kind):
    """A structure, with the kind of each field: an integer or a vector."""

    fields: Mapping[str, Kind] = field(compare=False, hash=False)

    def place(self, name: str) -> int:
        """Return the index of the first word of a field."""
        return WORDS * list(self.fields).index(name)


def tuple_of(width: int) -> Tuple:
    """Return the kind of tuples of this many integers."""
    return Tuple('tuple', width)


def vector(width: int = 0, nested: bool = False) -> Vector:
    """Return a kind of vectors."""
    return Vector('list', width, nested)


class Kinds:
    """
    The kinds that annotations mean.

    :param more: by class of named tuples, the names of integers that follow its fields.
    """

    def __init__(self, more: Mapping[type, tuple[str, ...]]) -> None:
        self._more = more
        self._structures: dict[type, Structure] = {}

    def of(self, annotation: Any) -> Kind:
        """Return the kind of values with an annotation; raise TypeError if there is none."""
        if annotation in (int, bool):
            return INTEGER
        if annotation in (None, type(None)):
            return NOTHING
        arguments = get_args(annotation)
        if get_origin(annotation) is tuple and all(each is int for each in arguments):
            return tuple_of(len(arguments))
        if get_origin(annotation) is list:
            return self._vector(arguments[0])
        if hasattr(annotation, '_fields'):
            return self.structure(annotation)
        if get_origin(annotation) is Callable:
            return KNOWN
        if any(get_origin(each) is Callable for each in arguments):
            return ABSENT
        raise TypeError(f'there is no kind of compiled values for {annotation}')

    def _vector(self, element: Any) -> Vector:
        if get_origin(element) is list:
            return vector(self._vector(get_args(element)[0]).width, nested=True)
        return vector(len(get_args(element)))

    def structure(self, row: type) -> Structure:
        """Return the structure for a class of named tuples."""
        if row not in self._structures:
            fields = {name: self.of(kind) for name, kind in get_type_hints(row).items()}
            fields.update(dict.fromkeys(self._more.get(row, ()), INTEGER))
            self._structures[row] = Structure(row.__name__, fields)
        return self._structures[row]
