# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Around the executor: programs, several processes."""
