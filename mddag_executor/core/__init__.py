# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The scheduler core: events with their times in, decisions out (see ``rules``).

Names are imported on first use: a replay judges without the scheduler.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mddag_executor.lazy import on_first_use

if TYPE_CHECKING:
    from mddag_executor.core.policies import POLICIES, Policy, policy, PolicyError
    from mddag_executor.core.scheduler import Scheduler
    from mddag_executor.core.tables import (
        DEFAULT_DEADLINE_NS,
        EXPIRE_AFTER_NS,
        MAX_ACTIVE_JOBS,
        NEVER,
        processes_of,
        rad_offsets,
        Tables,
    )
    from mddag_executor.core.tally import quantile, Tally
    from msg_graph.model import legs_of

__all__ = [
    'DEFAULT_DEADLINE_NS', 'EXPIRE_AFTER_NS', 'MAX_ACTIVE_JOBS', 'NEVER', 'POLICIES', 'Policy',
    'PolicyError', 'Scheduler', 'Tables', 'Tally', 'legs_of', 'policy', 'processes_of', 'quantile',
    'rad_offsets',
]

__getattr__, __dir__ = on_first_use(__name__, {
    'legs_of': 'msg_graph.model', **{
        name: f'{__name__}.{module}' for module, names in {
            'policies': ('POLICIES', 'Policy', 'PolicyError', 'policy'),
            'scheduler': ('Scheduler',),
            'tables': ('DEFAULT_DEADLINE_NS', 'EXPIRE_AFTER_NS', 'MAX_ACTIVE_JOBS', 'NEVER',
                       'Tables', 'processes_of', 'rad_offsets'),
            'tally': ('Tally', 'quantile'),
        }.items() for name in names}})
