# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Errors of simulations."""

from __future__ import annotations

from mddag_executor.errors import MddagError


class SimulationError(MddagError):
    """Input of a simulation that cannot be used."""
