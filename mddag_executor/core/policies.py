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

from collections.abc import Callable
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


def key_ros2(t: Tables, v: int, release: int, job: int, order: int) -> Key:
    """
    Return the key of rclcpp's executor within a polling round: the index in the wait set.

    Timers come first, then subscriptions, services and clients, each in order of registration,
    which is that of the declaration (rclpy visits them node by node).  The polling rounds of this
    executor are rule 9 of ``rules``.  Source: D. Casini et al., "Response-Time Analysis of ROS 2
    Processing Chains Under Reservation-Based Scheduling", ECRTS 2019; for several workers X. Jiang
    et al., "Real-Time Scheduling and Analysis of Processing Chains on Multi-Threaded Executor in
    ROS 2", RTSS 2022; and rclcpp of Jazzy, which checks timers, too, only when it polls.
    """
    return (t.entity[v], order, 0, 0)


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
    callbacks cannot preempt and ignores it.  ``polling``: whether it works in rounds (rule 9 of
    ``rules``).  ``urgency``: which time the keys are, if any (rule 7).
    """

    name: str
    key: KeyFunction
    preemptive: bool
    meaning: str
    polling: bool = False
    urgency: int = OTHER_KEYS

    def mode(self, preemptive: bool | None, processes: int = 1) -> bool:
        """
        Return whether to preempt: as requested, else the default of the policy.

        :raises PolicyError: when the policy does not support preemption, or not with so many
            processes (rule 12).
        """
        if processes > 1 and (preemptive or self.polling):
            what = 'polling' if self.polling else 'preemption'
            raise PolicyError(
                f"policy '{self.name}': {what} is known of one process only: give "
                f"{'another policy' if self.polling else 'no preemption'}, or one process")
        if preemptive and self.polling:
            raise PolicyError(
                f"policy '{self.name}': an executor that polls preempts no callback: "
                'run it without preemption')
        return self.preemptive if preemptive is None else preemptive


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
    Policy('ros2', key_ros2, False, "rclcpp's executor: wait-set order by polling rounds", True),
    Policy('picas', key_picas, False, 'chain-aware fixed priorities (PiCAS)'),
)}


class PolicyError(MddagError):
    """An unknown policy, or one that cannot run with or without preemption as asked."""


def policy(name: str) -> Policy:
    """Return the policy with this name, or raise PolicyError."""
    try:
        return POLICIES[name]
    except (KeyError, TypeError):  # a list, for example
        raise PolicyError(
            f"policy '{name}': there is no such policy: choose one of {', '.join(POLICIES)}"
        ) from None
