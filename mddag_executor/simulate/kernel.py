# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Entry points of the compiled core: a whole run, in memory that ``compiled`` provides.

They are only called compiled: the names of the core that they use are then bound to its compiled
functions (see ``compiling``).  Structures are passed as addresses.
"""

from __future__ import annotations

from mddag_executor.core.state import State
from mddag_executor.simulate.deliveries import Deliveries
from mddag_executor.simulate.engine import run
from mddag_executor.simulate.machine import Machine
from mddag_executor.simulate.structures import (
    as_deliveries,
    as_load,
    as_log,
    as_machine,
    as_orders,
    as_state,
    as_tables,
    as_vector,
    key_of_policy,
)
from mddag_executor.simulate.vectors import free

STATE_FIELDS = len(State._fields)
DELIVERIES_FIELDS = len(Deliveries._fields)
MACHINE_FIELDS = len(Machine._fields)


def free_fields(structure: int, fields: int) -> None:
    """Free the memory of a structure of vectors without nested vectors."""
    for field in range(fields):
        free(as_vector(structure + 24 * field))


def run_once(
    tables: int, load: int, orders: int, state: int, deliveries: int, machine: int, busy: int,
    log: int,
) -> int:
    """Run a load and return when it ended; the caller frees the results."""
    return run(
        as_tables(tables), as_state(state), as_deliveries(deliveries), as_machine(machine),
        key_of_policy, as_load(load), as_orders(orders), as_vector(busy), as_log(log), None)


def free_run(state: int, deliveries: int, machine: int, busy: int, log: int) -> None:
    """Free the results of ``run_once``."""
    s = as_state(state)
    for group in range(len(s.group_heap)):
        free(s.group_heap[group])
    for entity in range(len(s.entity_queue)):
        free(s.entity_queue[entity])
    for vertex in range(len(s.demoted)):
        free(s.demoted[vertex])
    queues = as_machine(machine).lock_queue
    for process in range(len(queues)):
        free(queues[process])
    free_fields(state, STATE_FIELDS)
    free_fields(deliveries, DELIVERIES_FIELDS)
    free_fields(machine, MACHINE_FIELDS)
    free(as_vector(busy))
    free(as_log(log))
