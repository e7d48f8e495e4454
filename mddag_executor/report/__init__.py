# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Results as tables, pictures and files."""
