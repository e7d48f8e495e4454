# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Entry points of the compiled core: whole runs, in memory that ``compiled`` provides.

They are only called compiled: the names of the core that they use are then bound to its compiled
functions (see ``compiling``).  Structures are passed as addresses.
"""

from __future__ import annotations

from typing import Any

from mddag_executor.core.jobs import finish
from mddag_executor.core.state import fill_state, State
from mddag_executor.simulate.deliveries import Deliveries
from mddag_executor.simulate.engine import any_missed, run, run_load
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
from mddag_executor.simulate.vectors import free, set_address

STATE_FIELDS = len(State._fields)
DELIVERIES_FIELDS = len(Deliveries._fields)
MACHINE_FIELDS = len(Machine._fields)


def clear_state(state: int) -> None:
    """Empty all columns of a state and keep their memory, except for that of nested queues."""
    s = as_state(state)
    for group in range(len(s.group_heap)):
        free(s.group_heap[group])
    for entity in range(len(s.entity_queue)):
        free(s.entity_queue[entity])
    for field in range(STATE_FIELDS):
        as_vector(state + 24 * field).clear()


def free_state(state: int) -> None:
    """Free the memory of a state."""
    clear_state(state)
    free_fields(state, STATE_FIELDS)


def free_fields(structure: int, fields: int) -> None:
    """Free the memory of a structure of vectors without nested vectors."""
    for field in range(fields):
        free(as_vector(structure + 24 * field))


def accept_runs(
    tables: int, load: int, state: int, costs: int, row: int, n_workers: int, preemptive: int,
    polling: int, urgency: int, dispatch_overhead: int, switch_overhead: int, horizon: int,
    judge_open: bool, accepted: Any,
) -> None:
    """
    Simulate runs up to the first miss; return which of them had none.

    :param costs: address of the execution times of the first run; the others follow.
    :param row: bytes from one run to the next.
    :param accepted: array of bool, one for each run.
    """
    t = as_tables(tables)
    s = as_state(state)
    arrivals = as_load(load)
    for i in range(len(accepted)):
        set_address(arrivals.costs, costs + i * row)
        fill_state(
            t, s, n_workers, preemptive, 1, dispatch_overhead, switch_overhead, polling,
            urgency)
        ended = run(t, s, key_of_policy, arrivals, horizon, True, None, None)
        if judge_open:
            finish(t, s, ended)
        accepted[i] = not any_missed(s, 0)
        clear_state(state)
    free_state(state)


def run_once(
    tables: int, load: int, orders: int, state: int, deliveries: int, machine: int, busy: int,
    log: int,
) -> int:
    """Run a load and return when it ended; the caller frees the results."""
    return run_load(
        as_tables(tables), as_state(state), as_deliveries(deliveries), as_machine(machine),
        key_of_policy, as_load(load), as_orders(orders), as_vector(busy), as_log(log), None)


def free_run(state: int, deliveries: int, machine: int, busy: int, log: int) -> None:
    """Free the results of ``run_once``."""
    free_state(state)
    queues = as_machine(machine).lock_queue
    for process in range(len(queues)):
        free(queues[process])
    free_fields(deliveries, DELIVERIES_FIELDS)
    free_fields(machine, MACHINE_FIELDS)
    free(as_vector(busy))
    free(as_log(log))
