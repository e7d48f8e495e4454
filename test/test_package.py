# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What `import mddag_executor` gives."""

from __future__ import annotations

import subprocess
import sys

import mddag_executor
import pytest


def test_the_public_names_are_those_of_the_live_executor() -> None:
    from mddag_executor.executor.executor import MultiDeadlineExecutor
    from mddag_executor.executor.verdicts import DeadlineMiss
    assert mddag_executor.MultiDeadlineExecutor is MultiDeadlineExecutor
    assert mddag_executor.DeadlineMiss is DeadlineMiss
    assert {'MultiDeadlineExecutor', 'DeadlineMiss'} <= set(dir(mddag_executor))


def test_star_gives_them_too() -> None:
    names: dict[str, object] = {}
    exec('from mddag_executor import *', names)
    assert {'MultiDeadlineExecutor', 'DeadlineMiss'} <= set(names)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Nonsense'"):
        mddag_executor.Nonsense  # noqa: B018


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = ('import sys, mddag_executor\n'
            "sys.exit(bool({'rclpy', 'numpy', 'yaml'} & set(sys.modules)))")
    assert subprocess.run([sys.executable, '-c', code], check=False).returncode == 0
