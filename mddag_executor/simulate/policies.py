# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The policies of simulation: those of the core, and rclcpp's, which no live run can have."""

from __future__ import annotations

from mddag_executor.core.policies import find, POLICIES, Policy, PolicyError
from mddag_executor.simulate.polling import key_ros2

ROS2 = 'ros2'
"""The policy whose workers poll."""
ALL_POLICIES: dict[str, Policy] = {
    **POLICIES,
    ROS2: Policy(
        ROS2, key_ros2, False, "rclcpp's executor: wait-set order by polling rounds")}


def policy(name: str) -> Policy:
    """Return the policy with this name, or raise PolicyError."""
    return find(name, ALL_POLICIES)


def preempts(name: str, preemptive: bool | None, processes: int = 1) -> bool:
    """
    Return whether to preempt under a policy: as requested, else as in the paper's experiment.

    :raises PolicyError: when there is no such policy, or it does not support preemption, or not
        with so many processes.
    """
    row = policy(name)
    if processes > 1 and (preemptive or name == ROS2):
        what = 'polling' if name == ROS2 else 'preemption'
        raise PolicyError(
            f"policy '{name}': {what} is known of one process only: give "
            f"{'another policy' if name == ROS2 else 'no preemption'}, or one process")
    if preemptive and name == ROS2:
        raise PolicyError(
            f"policy '{name}': an executor that polls preempts no callback: "
            'run it without preemption')
    return row.preemptive if preemptive is None else preemptive
