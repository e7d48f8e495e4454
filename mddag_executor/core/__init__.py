# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The scheduler core: events with their times in, decisions out (see ``rules``)."""

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
