# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Growing arrays and structures for compiled code, used like lists and named tuples.

Theory of operation
-------------------
The core's functions work on named tuples of lists.  numba can compile that with its own typed
lists, but then each call passes some thirty reference-counted lists: a run of the Autoware
workload took 44 to 55 ms instead of 0.8 ms on the same (busy) machine, and compiling 133 s.  The
types here have the same source interface and the cost of C:

* a *vector* is the address of three words: address of its data, length, capacity.  An element is a
  64-bit integer, or a tuple of them, or a vector.  ``append`` grows the data with ``realloc``;
* a *structure* is the address of three words for each field: those of a vector, or an integer.

There are no reference counts, no exceptions (without memory the program ends) and no checks: an
index must be from 0 to below the length.  (Tests compare with the plain core on lists, for which
Python checks.)  The code that makes a structure frees it with ``free``, or provides memory that
stays in place while the structure is used.

This module needs numba; nothing is compiled when it is imported.
"""

from __future__ import annotations

from collections.abc import Callable
import operator
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.core.imputils import lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.cpython.heapq import _siftdown, _siftup
from numba.extending import (
    intrinsic,
    lower_builtin,
    models,
    overload,
    overload_method,
    register_model,
    type_callable,
)

WORDS = 3
"""Words of a vector, and of a field."""

_I64 = ir.IntType(64)
_BYTES = 8


class VectorType(types.Type):
    """
    A vector.

    :param width: number of integers in an element's tuple; 0 for plain integers.
    :param nested: the elements are vectors with elements of that width.
    """

    def __init__(self, width: int = 0, nested: bool = False) -> None:
        self.width = width
        self.nested = nested
        super().__init__(name=f'mddag.Vector({width}, {nested})')

    @property
    def words(self) -> int:
        """Return the number of words of an element."""
        return WORDS if self.nested else max(1, self.width)

    @property
    def element(self) -> types.Type:
        """Return the type of an element."""
        if self.nested:
            return VectorType(self.width)
        return types.UniTuple(types.int64, self.width) if self.width else types.int64


class StructureType(types.Type):
    """A structure: fields by name, each ``types.int64``, or a vector; three words each."""

    def __init__(self, name: str, fields: dict[str, types.Type]) -> None:
        self.fields = fields
        self.places = {field: i for i, field in enumerate(fields)}
        super().__init__(name=f'mddag.{name}')  # short: it is part of the name of each function


class AddressModel(models.PrimitiveModel):
    """The data model of vectors and structures: an address."""

    def __init__(self, manager: Any, fe_type: types.Type) -> None:
        super().__init__(manager, fe_type, _I64)


register_model(VectorType)(AddressModel)
register_model(StructureType)(AddressModel)


# --- in terms of LLVM ----------------------------------------------------------------------------

def _pointer(builder: Any, address: Any) -> Any:
    return builder.inttoptr(address, _I64.as_pointer())


def _element(builder: Any, vector: VectorType, address: Any, index: Any) -> Any:
    data = builder.load(_pointer(builder, address))
    return builder.add(data, builder.mul(index, _I64(_BYTES * vector.words)))


def _word(builder: Any, address: Any, place: int) -> Any:
    return builder.gep(_pointer(builder, address), [_I64(place)])


@infer_getattr
class _StructureAttribute(AttributeTemplate):
    key = StructureType

    def generic_resolve(self, structure: StructureType, name: str) -> types.Type | None:
        return structure.fields.get(name)


def _get_field(context: Any, builder: Any, structure: Any, address: Any, name: str) -> Any:
    field = builder.add(address, _I64(_BYTES * WORDS * structure.places[name]))
    if not isinstance(structure.fields[name], types.Integer):
        return field
    return builder.load(_pointer(builder, field))


lower_getattr_generic(StructureType)(_get_field)


# Elements and lengths are typed and generated here, not as ``overload`` functions: each of those
# is compiled for each type of vector, and called and inlined at each use.

@type_callable(operator.getitem)
def _type_get_item(context: Any) -> Any:
    def typer(vector: Any, index: Any) -> Any:
        fits = isinstance(vector, VectorType) and isinstance(index, types.Integer)
        return vector.element if fits else None

    return typer


@lower_builtin(operator.getitem, VectorType, types.Integer)
def _get_item(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    vector, index = signature.args
    place = context.cast(builder, args[1], index, types.int64)
    element = _element(builder, vector, args[0], place)
    if vector.nested:
        return element
    if not vector.width:
        return builder.load(_pointer(builder, element))
    words = [builder.load(_word(builder, element, i)) for i in range(vector.width)]
    return context.make_tuple(builder, vector.element, words)


@type_callable(operator.setitem)
def _type_set_item(context: Any) -> Any:
    def typer(vector: Any, index: Any, value: Any) -> Any:
        fits = isinstance(vector, VectorType) and isinstance(index, types.Integer)
        return types.void if fits else None

    return typer


@lower_builtin(operator.setitem, VectorType, types.Integer, types.Any)
def _set_item(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    vector, index, kind = signature.args
    place = context.cast(builder, args[1], index, types.int64)
    value = context.cast(builder, args[2], kind, vector.element)
    element = _element(builder, vector, args[0], place)
    if not vector.width:
        builder.store(value, _pointer(builder, element))
    for i in range(vector.width):
        builder.store(builder.extract_value(value, i), _word(builder, element, i))
    return context.get_dummy_value()


@type_callable(len)
def _type_length(context: Any) -> Any:
    def typer(vector: Any) -> Any:
        return types.int64 if isinstance(vector, VectorType) else None

    return typer


@lower_builtin(len, VectorType)
def _length(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    return builder.load(_word(builder, args[0], 1))


@intrinsic
def _get_word(typing: Any, vector: Any, place: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(builder.gep(_pointer(builder, args[0]), [args[1]]))

    return types.int64(vector, types.int64), generate


@intrinsic
def _set_word(typing: Any, vector: Any, place: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[2], builder.gep(_pointer(builder, args[0]), [args[1]]))
        return context.get_dummy_value()

    return types.void(vector, types.int64, types.int64), generate


_realloc = types.ExternalFunction('realloc', types.int64(types.int64, types.int64))
_free = types.ExternalFunction('free', types.void(types.int64))
_perror = types.ExternalFunction('perror', types.void(types.int64))
_exit = types.ExternalFunction('exit', types.void(types.int64))


def at(kind: types.Type) -> Callable[..., Any]:
    """Return a function for compiled code that turns an address into a vector or structure."""
    @intrinsic
    def convert(typing: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return args[0]

        return kind(types.int64), generate

    function: Callable[..., Any] = convert
    return function


# --- methods of lists ----------------------------------------------------------------------------

@njit
def _grow(vector, words):
    capacity = max(8, 2 * _get_word(vector, 2))
    data = _realloc(_get_word(vector, 0), capacity * words * 8)
    if data == 0:
        _perror(0)
        _exit(1)
    _set_word(vector, 0, data)
    _set_word(vector, 2, capacity)


def _for_vectors(operation: Any, *kinds: Any) -> Callable[[Any], Any]:
    """Return a decorator of an operation on vectors, with arguments of these kinds."""
    def register(function: Any) -> Any:
        @overload(operation, strict=False)
        def choose(vector: Any, *arguments: Any) -> Any:
            fits = isinstance(vector, VectorType) and all(map(isinstance, arguments, kinds))
            return function if fits else None

        return function

    return register


@_for_vectors(operator.delitem, types.SliceType)
def _truncate(vector, index):
    _set_word(vector, 1, index.start)   # del vector[start:]


@_for_vectors(bool)
def _is_not_empty(vector):
    return _get_word(vector, 1) != 0


@_for_vectors(operator.contains)
def _contains(vector, value):
    for place in range(len(vector)):
        if vector[place] == value:
            return True
    return False


@overload_method(VectorType, 'append', strict=False)
def _overload_append(vector: Any, value: Any) -> Any:
    words = vector.words

    def append(vector, value):
        length = _get_word(vector, 1)
        if length == _get_word(vector, 2):
            _grow(vector, words)
        _set_word(vector, 1, length + 1)
        vector[length] = value

    return append


@overload_method(VectorType, 'pop', strict=False)
def _overload_pop(vector: Any) -> Any:
    def pop(vector):
        length = _get_word(vector, 1) - 1
        _set_word(vector, 1, length)
        return vector[length]

    return pop


@overload_method(VectorType, 'clear', strict=False)
def _overload_clear(vector: Any) -> Any:
    return lambda vector: _set_word(vector, 1, 0)


@njit
def add_heap(vector):
    """Append an empty vector to a vector of vectors, like ``core.state.add_heap``."""
    length = _get_word(vector, 1)
    if length == _get_word(vector, 2):
        _grow(vector, 3)
    _set_word(vector, 1, length + 1)
    for place in range(3):
        _set_word(vector[length], place, 0)


@njit
def free(vector):
    """Free the data of a vector, which must not contain vectors."""
    _free(_get_word(vector, 0))
    for place in range(3):
        _set_word(vector, place, 0)


# --- heapq, with numba's port of the same algorithm ----------------------------------------------

@njit
def heappush(heap, entry):
    """Do the same as ``heapq.heappush``."""
    heap.append(entry)
    _siftdown(heap, 0, len(heap) - 1)


@njit
def heappop(heap):
    """Do the same as ``heapq.heappop``, on a heap that is not empty."""
    top = heap[0]
    last = heap.pop()
    if len(heap) > 0:
        heap[0] = last
        _siftup(heap, 0)
    return top


@njit
def heapify(heap):
    """Do the same as ``heapq.heapify``."""
    for place in range(len(heap) // 2 - 1, -1, -1):
        _siftup(heap, place)
