# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Measures what noticing due timers and messages of other processes cost in a recording.

Theory of operation
-------------------
The intake thread of a process (``simulate.intakes``) is not recorded.  Its work shows in two ways:

* A computing execution that holds the GIL pauses while the intake runs, so its duration exceeds
  its CPU time.  The intake's GIL time is the median excess of executions during which exactly one
  timer or message was noticed.
* A timer or message is ready some time after it was due or sent.  If no callback computes, this is
  the intake's latency; if one computes, a switch interval is added.
"""

from __future__ import annotations

from typing import NamedTuple

from mddag_executor.recording.tables import Ints
from mddag_executor.replay.isolation import ENOUGH, Flags, Recorded
from mddag_executor.simulate.intakes import Costs
from mddag_executor.simulate.machine import SWITCH_NS
import numpy as np


class Noticed(NamedTuple):
    """
    What was noticed: rounds of timers, and messages of other processes.

    ``due`` is when the timer was due or the message's publisher ended; ``ready`` is when the
    started callback was ready; ``interpreter`` is the number of the process's interpreter, from 1.
    """

    due: Ints
    ready: Ints
    interpreter: Ints
    timer: Flags

    def costs(self, ran: Recorded) -> Costs:
        """Measure what noticing costs in parallel with these executions; defaults if unknown."""
        ran = ran.of(ran.locks & (ran.cpu >= 0))
        during = np.zeros(len(self.due), dtype=np.bool_)
        single = np.zeros(len(ran.could), dtype=np.bool_)
        timers, messages = (np.zeros(len(ran.could), dtype=np.int64) for _ in range(2))
        begins, ends = ran.could, ran.could + ran.took
        for number in np.unique(ran.interpreter):
            here, came = ran.interpreter == number, self.interpreter == number
            order = np.flatnonzero(here)[np.argsort(begins[here], kind='stable')]
            during[came] = (np.searchsorted(begins[order], self.due[came], 'right')
                            > np.searchsorted(np.sort(ends[order]), self.due[came], 'right'))
            latest = np.maximum.accumulate(ends[order])
            single[order] = ((np.append(0, latest[:-1]) <= begins[order])
                            & (ends[order] <= np.append(begins[order][1:], latest[-1:])))
            for counted, kind in ((timers, self.timer), (messages, ~self.timer)):
                ready = np.sort(self.ready[came & kind])
                counted[order] = (np.searchsorted(ready, ends[order], 'left')
                                  - np.searchsorted(ready, begins[order], 'right'))
        stood = (ran.took - ran.cpu)[single]
        late = self.ready - self.due - SWITCH_NS * during
        found: dict[str, int] = {}
        timers, messages = timers[single], messages[single]
        for name, kind, here, other in (('timer', self.timer, timers, messages),
                                        ('message', ~self.timer, messages, timers)):
            for what, values in (('ns', stood[(here == 1) & (other == 0)]),
                                 ('ready_ns', late[kind & ~during]),
                                 ('ready_ns', late[kind & during])):
                if len(values) >= ENOUGH:
                    value = max(0, int(np.median(values)))
                    found[f'{name}_{what}'] = min(value, found.get(f'{name}_{what}', value))
        return Costs(**found)

    def executions(self, costs: Costs) -> Recorded:
        """Return the work of the intakes as executions."""
        takes = np.where(self.timer, costs.timer_ns, costs.message_ns)
        more = np.where(self.timer, costs.timer_rest, costs.message_rest)
        took = np.maximum(takes, self.ready - self.due + more)
        due = self.ready + more - took
        n = len(due)
        return Recorded(due, took, takes, np.ones(n, dtype=np.bool_), self.interpreter)
