# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Entry points of the compiled core: whole runs, in memory that ``compiled`` provides.

They are only called compiled: the names of the core that they use are then bound to its compiled
functions.  The core's named tuples are structures (see ``vectors``), which are passed as
addresses.

This module needs numba; nothing is compiled when it is imported.
"""

from __future__ import annotations

from typing import Any

from mddag_executor.core.policies import Key
from mddag_executor.core.state import State
from mddag_executor.core.tables import Tables
from mddag_executor.simulate.deliveries import Deliveries
from mddag_executor.simulate.engine import any_missed, EngineOptions, run
from mddag_executor.simulate.machine import Machine
from mddag_executor.simulate.policies import ALL_POLICIES
from mddag_executor.simulate.pool import Pool
from mddag_executor.simulate.vectors import at, free, StructureType, VectorType
from mddag_executor.simulate.workload import Workload
from numba import extending, types

_KINDS = {
    'int': types.int64,
    'list[int]': VectorType(),
    'list[QueueEntry]': VectorType(5),
    'list[list[int]]': VectorType(nested=True),
    'list[list[QueueEntry]]': VectorType(5, nested=True),
    'list[Decision]': VectorType(6),
    'list[LogEntry]': VectorType(6),
}


def _structure(row: Any, **more: Any) -> Any:
    """Return the structure type of a class of named tuples, with additional fields."""
    fields = {
        name: _KINDS[str(getattr(kind, '__forward_arg__', kind))]
        for name, kind in row.__annotations__.items()}
    return StructureType(row.__name__, {**fields, **more})


KINDS: dict[str, Any] = {
    **_KINDS, 'Tables': _structure(Tables, policy=types.int64),
    **{row.__name__: _structure(row)
       for row in (State, Pool, Workload, Deliveries, Machine, EngineOptions)}}
"""The types of compiled code, by the annotations of the source."""

# Functions for compiled code that turn an address into a structure or vector.
as_tables = at(KINDS['Tables'])
as_state = at(KINDS['State'])
as_pool = at(KINDS['Pool'])
as_load = at(KINDS['Workload'])
as_deliveries = at(KINDS['Deliveries'])
as_machine = at(KINDS['Machine'])
as_options = at(KINDS['EngineOptions'])
as_vector = at(VectorType())
STATE_FIELDS = len(State._fields)
POOL_FIELDS = len(Pool._fields)
DELIVERIES_FIELDS = len(Deliveries._fields)
MACHINE_FIELDS = len(Machine._fields)


def key_of_policy(t: Any, v: int, release: int, job: int, order: int) -> Key:
    """
    Return the key of the policy whose number is in the additional field ``policy`` of the tables.

    It is an overloaded function, because only these can be passed between functions in stored
    code.
    """
    key: Key = list(ALL_POLICIES.values())[t.policy].key(t, v, release, job, order)
    return key


def bind_policies(space: dict[str, Any]) -> None:
    """Register ``key_of_policy`` with numba, with the key functions of a namespace."""
    arguments = 't, v, release, job, order'
    *others, last = (row.key.__name__ for row in ALL_POLICIES.values())
    lines = [f'def choose({arguments}):']
    for number, key in enumerate(others):
        lines += [f'    if t.policy == {number}:', f'        return {key}({arguments})']
    lines.append(f'    return {last}({arguments})')
    exec('\n'.join(lines), space)
    chosen = space['choose']
    extending.overload(key_of_policy, strict=False)(lambda t, v, release, job, order: chosen)


def run_each(
    tables: int, load: int, options: int, state: int, pool: int, deliveries: int, machine: int,
    missed: int,
) -> int:
    """
    Run a load with one row of execution times after another; return when the last run ended.

    The caller frees the results of the last run.

    :param missed: receives by run whether a deadline was missed.
    """
    t, s, rows, misses = as_tables(tables), as_state(state), as_load(load), as_vector(missed)
    ended = 0
    for number in range(len(misses)):
        if number > 0:
            free_run(state, pool, deliveries, machine)
            for dag in range(len(rows.cost_base)):
                rows.cost_base[dag] += t.n_vertices
        ended = run(
            t, s, as_pool(pool), as_deliveries(deliveries), as_machine(machine), key_of_policy,
            rows, as_options(options), None)
        misses[number] = int(any_missed(s, 0))
    return ended


def free_run(state: int, pool: int, deliveries: int, machine: int) -> None:
    """Free the results of a run."""
    s, m = as_state(state), as_machine(machine)
    for group in range(len(s.group_heap)):
        free(s.group_heap[group])
    for process in range(len(m.lock_queue)):
        free(m.lock_queue[process])
    for structure, fields in ((state, STATE_FIELDS), (pool, POOL_FIELDS),
                              (deliveries, DELIVERIES_FIELDS), (machine, MACHINE_FIELDS)):
        for field in range(fields):
            free(as_vector(structure + 24 * field))
