# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What is around the executor: programs, synthetic nodes, several processes, diagnostics."""
