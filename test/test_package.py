# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What `import mddag_executor` gives."""

import mddag_executor
from mddag_executor.text import listed
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


def test_a_long_list_is_shortened():
    assert (listed('abcde'), listed('abcdefg')) == ('a, b, c, d, e', 'a, b, c, d, e, … (2 more)')
