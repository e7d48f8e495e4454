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

"""Numbers that ``columns`` and its compiled part agree on."""

from __future__ import annotations

# Columns of a row: when, what, thread, process, and the fields from there on.
TIME, KIND, THREAD, PROCESS, FIELDS = range(5)
ROW = 11
OTHER = 0
"""The kind of an event that is not decoded here; its thread is its place among those."""

# What a channel's messages are; from FIRST_LAYOUT on: in which layout.
UNKNOWN, PASSED_OVER, FIRST_LAYOUT = range(3)

# Columns of a layout: kind, size, number of fields; then offset, size and sign of each field.
L_KIND, L_SIZE, L_FIELDS, L_FIRST = range(4)
LAYOUT = L_FIRST + 3 * ROW

# What is handed back.
POSITION, ROWS, MESSAGES, OTHERS, STATUS, N_RESULTS = range(6)
DONE, DEFINITION, CUT, FULL = range(4)
