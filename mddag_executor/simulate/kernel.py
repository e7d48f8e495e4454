# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Entry points of the compiled core: whole runs, in memory that ``compiled`` provides.

This module needs llvmlite.
"""

from __future__ import annotations

import ast

from mddag_executor.compiler.kinds import Kinds
from mddag_executor.compiler.program import Program, Source
from mddag_executor.compiler.runtime import free_all, REPLACED
from mddag_executor.compiler.statements import translate
from mddag_executor.core.policies import Key
from mddag_executor.core.state import State
from mddag_executor.core.tables import Tables
from mddag_executor.simulate.deliveries import Deliveries
from mddag_executor.simulate.engine import any_missed, EngineOptions, run
from mddag_executor.simulate.machine import Machine
from mddag_executor.simulate.policies import ALL_POLICIES
from mddag_executor.simulate.pool import Pool
from mddag_executor.simulate.workload import Workload


def program() -> Program:
    """Return the entry points, with all that they call, translated for LLVM."""
    return translate(
        (run_each, free_run), Kinds({Tables: ('policy',)}), REPLACED,
        (key_of_policy, _choice_of_policy()))


def key_of_policy(t: Tables, v: int, release: int, job: int, order: int) -> Key:
    """Return the key of the policy whose number is in the field ``policy`` that tables have."""
    raise NotImplementedError  # compiled code has the branches of the next function instead


def _choice_of_policy() -> Source:
    """Return the source of ``key_of_policy``: one branch for each policy."""
    arguments = 't, v, release, job, order'
    keys = [row.key for row in ALL_POLICIES.values()]
    lines = [f'def key_of_policy({arguments}):']
    for number, key in enumerate(keys):
        lines += [f'    if t.policy == {number}:', f'        return {key.__name__}({arguments})']
    definition = ast.parse('\n'.join(lines)).body[0]
    assert isinstance(definition, ast.FunctionDef)
    return Source('key_of_policy', definition, {key.__name__: key for key in keys}, 'the policies')


def run_each(
    t: Tables, load: Workload, o: EngineOptions, s: State, p: Pool, d: Deliveries, m: Machine,
    missed: list[int],
) -> int:
    """
    Run a load with one row of execution times after another; return when the last run ended.

    The caller frees the results of the last run.

    :param missed: receives by run whether a deadline was missed.
    """
    ended = 0
    for number in range(len(missed)):
        if number > 0:
            free_run(s, p, d, m)
            for dag in range(len(load.cost_base)):
                load.cost_base[dag] += t.n_vertices
        ended = run(t, s, p, d, m, key_of_policy, load, o, None)
        missed[number] = int(any_missed(s, 0))
    return ended


def free_run(s: State, p: Pool, d: Deliveries, m: Machine) -> None:
    """Free the results of a run."""
    free_all(s)
    free_all(p)
    free_all(d)
    free_all(m)
