# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The policies of simulation: those of the core, rclcpp's, and those of users.

``MODULE:FUNCTION`` names a policy of a user: a key function, or a ``Policy`` that has one.  Its
module is imported, so such a name must come from the command line or from the caller, never from
a file: names that are read from recordings are only looked up in ``ALL_POLICIES``.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from operator import index
import os
import sys
from typing import Any

from mddag_executor.core.policies import find, Key, KeyFunction, POLICIES, Policy, PolicyError
from mddag_executor.core.tables import Tables
from mddag_executor.errors import UserCodeError
from mddag_executor.simulate.polling import key_ros2

ROS2 = 'ros2'
"""The policy whose workers poll."""
ALL_POLICIES: dict[str, Policy] = {
    **POLICIES,
    ROS2: Policy(
        ROS2, key_ros2, False, "rclcpp's executor: wait-set order by polling rounds")}


def policy(name: str) -> Policy:
    """Return the policy with this name, which may be MODULE:FUNCTION, or raise PolicyError."""
    return _of_user(name) if is_of_user(name) else find(name, ALL_POLICIES)


def is_of_user(name: str) -> bool:
    """Return whether a name is MODULE:FUNCTION: such a policy is not compiled."""
    return isinstance(name, str) and ':' in name


@cache
def _of_user(name: str) -> Policy:
    """Import a policy; raise PolicyError if there is none."""
    module, _, attribute = name.partition(':')
    if '' not in sys.path and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())     # as `python -m` does
    try:
        found: Any = getattr(import_module(module), attribute)
    except Exception as error:  # whatever the module raises
        said = ' '.join(f'{type(error).__name__}: {error}'.split())
        raise PolicyError(f"policy '{name}': it cannot be imported ({said}): write "
                          'MODULE:FUNCTION of a module in this folder or on PYTHONPATH') from error
    row = found if isinstance(found, Policy) else Policy(name, found, False, 'policy of a user')
    if not callable(row.key):
        raise PolicyError(f"policy '{name}': it cannot be called: give a function of (tables, "
                          'vertex, release, job, order), or a Policy with one')
    return row._replace(name=name, key=_checked(name, row.key))


def _checked(name: str, key: KeyFunction) -> KeyFunction:
    """Return a key function whose errors name the policy."""
    def checked(t: Tables, v: int, release: int, job: int, order: int) -> Key:
        try:
            found = key(t, v, release, job, order)
        except Exception as error:
            raise UserCodeError(f"policy '{name}': {type(error).__name__}: {error}") from error
        try:
            first, second, third, fourth = map(index, found)
        except (TypeError, ValueError):
            raise PolicyError(f"policy '{name}': it returned {found!r}: let it return four "
                              'integers') from None
        return first, second, third, fourth

    return checked


def preempts(name: str, preemptive: bool | None, processes: int = 1) -> bool:
    """
    Return whether to preempt under a policy: as requested, else as in the paper's experiment.

    :raises PolicyError: when there is no such policy, or it does not support preemption, or not
        with several processes.
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
