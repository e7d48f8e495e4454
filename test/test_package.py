# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What `import mddag_executor` gives, and how its messages count and list."""

import mddag_executor
from mddag_executor.text import counted, listed
import pytest


def test_public_names_are_those_of_the_live_executor():
    from mddag_executor.executor.executor import MultiDeadlineExecutor
    from mddag_executor.executor.verdicts import DeadlineMiss
    assert mddag_executor.MultiDeadlineExecutor is MultiDeadlineExecutor
    assert mddag_executor.DeadlineMiss is DeadlineMiss
    names = {}
    exec('from mddag_executor import *', names)
    assert {'MultiDeadlineExecutor', 'DeadlineMiss'} <= set(names) & set(dir(mddag_executor))
    with pytest.raises(AttributeError, match="no attribute 'Nonsense'"):
        mddag_executor.Nonsense  # noqa: B018


def test_texts_for_messages():
    assert [counted(n, 'DAG') for n in (0, 1, 2)] == ['0 DAGs', '1 DAG', '2 DAGs']
    assert [counted(n, 'vertex', 'vertices') for n in (1, 2)] == ['1 vertex', '2 vertices']
    assert (listed(['a', 'b']), listed([]), listed('abc', 2)) == ('a, b', '', 'a, b, … (1 more)')
