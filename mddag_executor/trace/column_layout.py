# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
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
