# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The tables of the core are made in time that grows with the declaration, not faster."""

from mddag_executor.core import tables
from msg_graph import loads

DAGS = 300
NODES = ''.join(f'  - {{node: /n{i}, callbacks: [{{name: t, timer: 10ms, deadline: 10ms, '
                'tolerate: 1 of 5}]}\n' for i in range(DAGS))


class Counted(list):
    """A list that counts what is copied out of it, or looked through."""

    touched = 0

    def __getitem__(self, key):
        found = super().__getitem__(key)
        Counted.touched += len(found) if isinstance(key, slice) else 1
        return found

    def __iter__(self):
        Counted.touched += len(self)
        return super().__iter__()


def test_a_dag_costs_the_same_however_many_there_are_before():
    columns = tables._Columns(False, tables.NEVER, tables.NEVER, 0)
    columns.lists = {name: Counted(values) for name, values in columns.lists.items()}
    task_set = loads('mddag: 1\nnodes:\n' + NODES, 'g.yaml')
    columns.enter(task_set.callbacks)
    for dag in task_set.dags:
        columns.add_dag(dag)
    assert Counted.touched < 20 * DAGS
