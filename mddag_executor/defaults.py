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

"""What is meant where neither a command line nor a declaration says it: the paper's experiment."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from msg_graph import TaskSet

WORKERS = 7
POLICIES = ('rad', 'rm', 'wc', 'fifo')
"""Those that an evaluation compares."""
DURATION_NS = 3_000_000_000
"""Virtual time of a simulated run."""
LIVE_SEED = 2
"""Of the execution times of live runs: each deadline of the Autoware workload leaves room."""


def workers(asked: int | None, task_set: TaskSet | None) -> int:
    """Return the number of workers: what was asked for, else what is declared, else seven."""
    declared = None if task_set is None else task_set.workers
    return asked or declared or WORKERS
