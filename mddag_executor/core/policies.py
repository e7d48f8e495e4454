# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Scheduling policies: the order in which ready callbacks run.

A policy is a key function and one row of ``POLICIES``.  The key is a tuple of four integers;
smaller runs first.  The first integer is the *priority*: only it decides about preemption, which
needs a strictly smaller one.  The others break ties, so that all runs and machines agree.  The
ties are those of the paper's own program.

A key function receives the tables, the global vertex index, the job's release and index, and the
*order*, a running number of entries into the ready queue (rule 3 of ``rules``).  It must contain
only integer arithmetic on its arguments, because it is compiled for the simulator and called
directly by the live executor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from mddag_executor.core.state import DAG_KEYS, DEADLINE_KEYS, OTHER_KEYS, START_KEYS
from mddag_executor.core.tables import Tables
from mddag_executor.errors import MddagError

Key = tuple[int, int, int, int]
KeyFunction = Callable[[Tables, int, int, int, int], Key]


def key_rad(t: Tables, v: int, release: int, job: int, order: int) -> Key:
    """Return the key of extended GEDF: reference absolute deadline, vertex, DAG."""
    return (release + t.rad_offset[v], t.index_in_dag[v], t.dag_of[v], order)


def key_rm(t: Tables, v: int, release: int, job: int, order: int) -> Key:
    """Return the key of rate monotonic: period, job index, order of becoming ready."""
    return (t.period[t.dag_of[v]], job, order, 0)


def key_wc(t: Tables, v: int, release: int, job: int, order: int) -> Key:
    """Return the key of the paper's work-conserving baseline: job index, then order."""
    return (job, order, 0, 0)


def key_fifo(t: Tables, v: int, release: int, job: int, order: int) -> Key:
    """Return the key of plain order of becoming ready."""
    return (order, 0, 0, 0)


def key_gedf(t: Tables, v: int, release: int, job: int, order: int) -> Key:
    """Return the key of GEDF with one deadline for each DAG, its latest."""
    return (release + t.dag_deadline[t.dag_of[v]], t.index_in_dag[v], t.dag_of[v], order)


def key_dm(t: Tables, v: int, release: int, job: int, order: int) -> Key:
    """Return the key of deadline monotonic: relative reference deadline, then as ``rm``."""
    return (t.rad_offset[v], job, order, 0)


def key_picas(t: Tables, v: int, release: int, job: int, order: int) -> Key:
    """
    Return the key of PiCAS: the fixed priority of the callback, then order of becoming ready.

    Source: H. Choi, Y. Xiang and H. Kim, "PiCAS: New Design of Priority-Driven Chain-Aware
    Scheduling for ROS2", RTAS 2021.  See ``Tables.chain_rank`` for the order of chains and DAGs.
    """
    return (t.chain_rank[v], order, 0, 0)


def key_llf(t: Tables, v: int, release: int, job: int, order: int) -> Key:
    """Return the key of least laxity first by the remaining critical path: latest start."""
    return (release + t.latest_start[v], t.index_in_dag[v], t.dag_of[v], order)


class Policy(NamedTuple):
    """
    A row of the policy table.

    ``preemptive``: whether the paper's experiment runs the policy with preemption; an executor of
    callbacks cannot preempt and ignores it.  ``urgency``: which time the keys are, if any (rule 7
    of ``rules``).
    """

    name: str
    key: KeyFunction
    preemptive: bool
    meaning: str
    urgency: int = OTHER_KEYS


POLICIES: dict[str, Policy] = {p.name: p for p in (
    Policy('rad', key_rad, True, 'reference absolute deadline (extended GEDF of the paper)',
           urgency=DEADLINE_KEYS),
    Policy('rm', key_rm, True, 'rate monotonic: the shortest period first'),
    Policy('wc', key_wc, False, 'work-conserving baseline of the paper: job index, order'),
    Policy('fifo', key_fifo, False, 'order of becoming ready'),
    Policy('gedf', key_gedf, True, 'one deadline for each DAG: its latest', urgency=DAG_KEYS),
    Policy('dm', key_dm, True, 'deadline monotonic: the shortest relative deadline first'),
    Policy('llf', key_llf, True, 'least laxity first: deadline less the critical path to it',
           urgency=START_KEYS),
    Policy('picas', key_picas, False, 'chain-aware fixed priorities (PiCAS)'),
)}


SIMULATED_ONLY = ('ros2',)
"""Policies that only simulation knows (``simulate.policies``)."""


class PolicyError(MddagError):
    """An unknown policy, or one that cannot run with or without preemption as asked."""


def policy(name: str) -> Policy:
    """Return the policy with this name, or raise PolicyError."""
    return find(name, POLICIES)


def find(name: str, policies: Mapping[str, Policy]) -> Policy:
    """Return the policy with this name of a table, or raise PolicyError."""
    try:
        return policies[name]
    except (KeyError, TypeError):  # a list, for example
        what = 'only simulations know it' if name in SIMULATED_ONLY else 'there is no such policy'
        raise PolicyError(
            f"policy '{name}': {what}: choose one of {', '.join(policies)}") from None
