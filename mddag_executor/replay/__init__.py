# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Replay of recorded runs: as recorded, and rescheduled through the core.

``replay`` tells which deadlines a recorded run held and where its time went, ``reschedule`` what
the scheduler core would have done with its releases and execution times.
"""

from mddag_executor.replay.as_recorded import Replay, replay
from mddag_executor.replay.for_caret import caret_events
from mddag_executor.replay.recording import ReplayError
from mddag_executor.replay.reschedule import Reschedule, reschedule

__all__ = ['Replay', 'ReplayError', 'Reschedule', 'caret_events', 'replay', 'reschedule']
