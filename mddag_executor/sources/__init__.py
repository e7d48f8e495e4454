# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Sources of recordings: files of all kinds, and how recordings are made of their events."""
