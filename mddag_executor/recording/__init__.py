# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Recordings in memory: tables with named columns, and what their numbers mean."""
