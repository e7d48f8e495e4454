# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the tests of the executor have, too."""

from __future__ import annotations

from ..executor.conftest import make_node, wait_for

__all__ = ['make_node', 'wait_for']
