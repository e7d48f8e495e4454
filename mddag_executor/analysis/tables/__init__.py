# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The result tables, one in each file: see ``analysis.result_table``."""
