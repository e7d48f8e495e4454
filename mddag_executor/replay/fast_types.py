# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Matrices of numbers for compiled code, beside the vectors of ``simulate.vectors``.

A *matrix* is the address of three words: address of its data, how many rows, how many columns.
The arrays that a replay works on are a structure of vectors and matrices, whose memory is numpy's.
As with vectors nothing is counted or checked.  (numba's own arrays are: a tuple of some sixty of
them takes longer to hand from function to function than all that the functions do.)

This module needs numba; nothing is compiled when it is imported.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from mddag_executor.replay.fast_work import Work
from mddag_executor.simulate.vectors import AddressModel, at, StructureType, VectorType
from numba import types
from numba.extending import intrinsic, overload, register_model

_I64 = ir.IntType(64)


class MatrixType(types.Type):
    """A matrix."""

    def __init__(self) -> None:
        super().__init__(name='mddag.Matrix')


register_model(MatrixType)(AddressModel)


def _element(builder: Any, address: Any, row: Any, column: Any) -> Any:
    words = builder.inttoptr(address, _I64.as_pointer())
    width = builder.load(builder.gep(words, [_I64(2)]))
    data = builder.inttoptr(builder.load(words), _I64.as_pointer())
    return builder.gep(data, [builder.add(builder.mul(row, width), column)])


@intrinsic
def _load(typing: Any, matrix: Any, row: Any, column: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(_element(builder, *args))

    return types.int64(matrix, types.int64, types.int64), generate


@intrinsic
def _store(typing: Any, matrix: Any, row: Any, column: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[3], _element(builder, *args[:3]))
        return context.get_dummy_value()

    return types.void(matrix, types.int64, types.int64, types.int64), generate


@intrinsic
def _word(typing: Any, matrix: Any, place: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        words = builder.inttoptr(args[0], _I64.as_pointer())
        return builder.load(builder.gep(words, [args[1]]))

    return types.int64(matrix, types.int64), generate


@overload(operator.getitem, strict=False)
def _overload_getitem(matrix: Any, index: Any) -> Any:
    if isinstance(matrix, MatrixType) and isinstance(index, types.BaseTuple):
        return lambda matrix, index: _load(matrix, index[0], index[1])
    return None


@overload(operator.setitem, strict=False)
def _overload_setitem(matrix: Any, index: Any, value: Any) -> Any:
    if isinstance(matrix, MatrixType) and isinstance(index, types.BaseTuple):
        return lambda matrix, index, value: _store(matrix, index[0], index[1], value)
    return None


@overload(len, strict=False)
def _overload_len(matrix: Any) -> Any:
    if isinstance(matrix, MatrixType):
        return lambda matrix: _word(matrix, 1)
    return None


def columns_of(matrix: Any) -> int:
    """Return how many columns a matrix has; compiled code only."""
    raise NotImplementedError


@overload(columns_of, strict=False)
def _overload_columns_of(matrix: Any) -> Any:
    if isinstance(matrix, MatrixType):
        return lambda matrix: _word(matrix, 2)
    return None


_KINDS = {'Vector': VectorType(), 'Matrix': MatrixType()}

# What makes an address the structure of all arrays, or a matrix.
as_work = at(StructureType('Work', {
    name: _KINDS[str(getattr(kind, '__forward_arg__', kind))]
    for name, kind in Work.__annotations__.items()}))
as_matrix = at(MatrixType())
