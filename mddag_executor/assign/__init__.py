# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Relative deadlines for sinks, where nobody has given them."""

from mddag_executor.assign.search import (
    AssignError,
    Found,
    least_runs,
    measure,
    Measured,
    proportional,
    scaled,
    Search,
)

__all__ = [
    'AssignError', 'Found', 'Measured', 'Search', 'least_runs', 'measure',
    'proportional', 'scaled']
