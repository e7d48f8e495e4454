# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Run ROS 2 callbacks in the order their deadlines need, and check recorded runs offline.

The public names are `MultiDeadlineExecutor`, `DeadlineMiss` and `open_recording`. They are looked
up on first use, so that importing this package (and `mddag --help`) does not load rclpy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mddag_executor.lazy import on_first_use

if TYPE_CHECKING:
    from mddag_executor.executor.executor import MultiDeadlineExecutor
    from mddag_executor.executor.verdicts import DeadlineMiss
    from mddag_executor.replay.run import open_recording

__all__ = ['DeadlineMiss', 'MultiDeadlineExecutor', 'open_recording', '__version__']
__version__ = '2.0.0'

__getattr__, __dir__ = on_first_use(__name__, {
    'DeadlineMiss': 'mddag_executor.executor',
    'MultiDeadlineExecutor': 'mddag_executor.executor',
    'open_recording': 'mddag_executor.replay',
})
