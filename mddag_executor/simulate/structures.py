# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The core's named tuples as structures for compiled code (see ``vectors``), and its policies.

This module needs numba; nothing is compiled when it is imported.
"""

from __future__ import annotations

from typing import Any

from mddag_executor.core.policies import Key, POLICIES
from mddag_executor.core.state import State
from mddag_executor.core.tables import Tables
from mddag_executor.simulate.deliveries import Deliveries
from mddag_executor.simulate.engine import Orders
from mddag_executor.simulate.load import Load
from mddag_executor.simulate.machine import Machine
from mddag_executor.simulate.vectors import at, StructureType, VectorType
from numba import types
from numba.extending import overload

_KINDS = {
    'int': types.int64,
    'list[int]': VectorType(),
    'list[QueueEntry]': VectorType(5),
    'list[list[int]]': VectorType(nested=True),
    'list[list[QueueEntry]]': VectorType(5, nested=True),
    'list[Decision]': VectorType(6),
}


def _structure(row: Any, **more: Any) -> Any:
    """Return the structure type of a class of named tuples, with additional fields."""
    fields = {
        name: _KINDS[str(getattr(kind, '__forward_arg__', kind))]
        for name, kind in row.__annotations__.items()}
    return StructureType(row.__name__, {**fields, **more})


# Functions for compiled code that turn an address into a structure or vector.
as_tables = at(_structure(Tables, policy=types.int64))
as_state = at(_structure(State))
as_load = at(_structure(Load))
as_deliveries = at(_structure(Deliveries))
as_machine = at(_structure(Machine))
as_orders = at(_structure(Orders))
as_log = at(VectorType(6))
as_vector = at(VectorType())


def key_of_policy(t: Any, v: int, release: int, job: int, order: int) -> Key:
    """
    Return the key of the policy whose number is in the additional field ``policy`` of the tables.

    It is an overloaded function, because only these can be passed between functions in stored
    code.
    """
    key: Key = list(POLICIES.values())[t.policy].key(t, v, release, job, order)
    return key


def bind_policies(space: dict[str, Any]) -> None:
    """Register ``key_of_policy`` with numba, with the key functions of a namespace."""
    arguments = 't, v, release, job, order'
    *others, last = (row.key.__name__ for row in POLICIES.values())
    lines = [f'def choose({arguments}):']
    for number, key in enumerate(others):
        lines += [f'    if t.policy == {number}:', f'        return {key}({arguments})']
    lines.append(f'    return {last}({arguments})')
    exec('\n'.join(lines), space)
    chosen = space['choose']
    overload(key_of_policy, strict=False)(lambda t, v, release, job, order: chosen)
