# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Replay of recorded runs: as recorded, and rescheduled through the core.

``replay`` judges the deadlines of a recorded run and splits its response times; ``reschedule``
runs the scheduler core with its releases and execution times.
"""

from mddag_executor.recording.head import ReplayError
from mddag_executor.replay.as_recorded import Replay, replay
from mddag_executor.replay.reschedule import Reschedule, reschedule
from mddag_executor.replay.run import open_recording, Traces

__all__ = [
    'Replay', 'ReplayError', 'Reschedule', 'Traces', 'open_recording', 'replay',
    'reschedule']
