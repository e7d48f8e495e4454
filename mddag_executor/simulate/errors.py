# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a simulation."""

from __future__ import annotations

from mddag_executor.errors import MddagError


class SimulationError(MddagError):
    """Input of a simulation that cannot be used."""
