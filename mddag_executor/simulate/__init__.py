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

"""Simulation in virtual time: the core over releases and execution times."""

from mddag_executor.simulate.engine import END, Load, LogEntry, PREEMPT, START
from mddag_executor.simulate.errors import SimulationError
from mddag_executor.simulate.run import JUDGES, Run, Settings, simulate
from mddag_executor.simulate.workload import (
    draw_execution_times,
    periodic_load,
    read_execution_times,
    scale_execution_times,
    utilisation,
)

__all__ = [
    'END', 'JUDGES', 'Load', 'LogEntry', 'PREEMPT', 'Run', 'START', 'Settings', 'SimulationError',
    'draw_execution_times', 'periodic_load', 'read_execution_times', 'scale_execution_times',
    'simulate', 'utilisation',
]
