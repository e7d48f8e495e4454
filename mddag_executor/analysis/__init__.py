# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Analyses of recordings: verdicts, chains, causes, usage, paths, drift, drafts."""
