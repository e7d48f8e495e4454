# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Run ROS 2 callbacks in the order their deadlines need, and check recorded runs offline.

The public names are those of `__all__`. They are looked up on first use, so that importing this
package (and `mddag --help`) does not load rclpy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mddag_executor.lazy import on_first_use

if TYPE_CHECKING:
    from mddag_executor.analysis.as_recorded import Replay, replay
    from mddag_executor.executor.executor import MultiDeadlineExecutor
    from mddag_executor.executor.verdicts import DeadlineMiss
    from mddag_executor.recording.head import ReplayError
    from mddag_executor.sources.open import open_recording, Traces
    from mddag_executor.whatif.reschedule import Reschedule, reschedule

__all__ = [
    'DeadlineMiss', 'MultiDeadlineExecutor', 'Replay', 'ReplayError', 'Reschedule', 'Traces',
    'open_recording', 'replay', 'reschedule', '__version__']
__version__ = '3.0.0'

__getattr__, __dir__ = on_first_use(__name__, {
    'DeadlineMiss': 'mddag_executor.executor',
    'MultiDeadlineExecutor': 'mddag_executor.executor',
    'Replay': 'mddag_executor.analysis.as_recorded',
    'ReplayError': 'mddag_executor.recording.head',
    'Reschedule': 'mddag_executor.whatif.reschedule',
    'Traces': 'mddag_executor.sources.open',
    'open_recording': 'mddag_executor.sources.open',
    'replay': 'mddag_executor.analysis.as_recorded',
    'reschedule': 'mddag_executor.whatif.reschedule',
})
