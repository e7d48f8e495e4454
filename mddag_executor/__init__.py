# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Run ROS 2 callbacks in the order their deadlines need, and check recorded runs offline.

The public names are `MultiDeadlineExecutor` and `DeadlineMiss`. They are looked up on first use,
so that importing this package (and `mddag --help`) does not load rclpy.
"""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from mddag_executor.live.executor import MultiDeadlineExecutor
    from mddag_executor.live.verdicts import DeadlineMiss

__all__ = ['DeadlineMiss', 'MultiDeadlineExecutor', '__version__']
__version__ = '1.0.0'

_LAZY = {
    'DeadlineMiss': 'mddag_executor.live',
    'MultiDeadlineExecutor': 'mddag_executor.live',
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use (PEP 562)."""
    if name not in _LAZY:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    from importlib import import_module
    value = getattr(import_module(_LAZY[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
