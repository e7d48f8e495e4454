# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The callback groups of a recording, for the core.

Declared callbacks keep the callback groups that they had in the recording.  A `group:` of another
declaration than the recorded one goes before.
"""

from __future__ import annotations

from mddag_executor.core import Tables


def with_groups(
    tables: Tables, callback_of: dict[int, int], groups: dict[int, int], declared_first: bool
) -> Tables:
    """
    Return tables with the callback groups of a recording.

    :param callback_of: by global vertex the callback that ran as it.
    :param groups: by callback its group in the recording, -1 for a reentrant one.
    :param declared_first: whether declared groups go before recorded ones.
    """
    numbers: dict[tuple[bool, int], int] = {}
    column = []
    for vertex, declared in enumerate(tables.group):
        recorded = groups.get(callback_of.get(vertex, 0))
        if recorded is None or (declared_first and declared >= 0):
            choice = (False, declared)
        else:
            choice = (True, recorded)
        column.append(-1 if choice[1] == -1 else numbers.setdefault(choice, len(numbers)))
    return tables._replace(group=column, n_groups=len(numbers))
