# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What noticing took in a recording: timers that were due, and messages of other processes.

Theory of operation
-------------------
The intake of a process (``simulate.intakes``) is not recorded, but what it does is seen twice:

* An execution that computes with Python's lock stands still meanwhile: its time is longer than
  its CPU time.  So what noticing takes of the interpreter is the median of that of executions in
  which just one timer, or one message, was noticed.
* What is noticed is ready some time after it was due, or sent.  Where nothing computes then, that
  is how long it takes alone; where a callback does, a switch interval more.
"""

from __future__ import annotations

from typing import NamedTuple

from mddag_executor.recording.tables import Ints
from mddag_executor.replay.alone import ENOUGH, Flags, Recorded
from mddag_executor.simulate.intakes import Costs
from mddag_executor.simulate.machine import SWITCH_NS
import numpy as np


class Noticed(NamedTuple):
    """
    What was noticed, by columns: rounds of timers, and messages of other processes.

    ``due`` is when a timer was due or the publisher of a message had ended, ``ready`` when what
    it starts was ready; ``interpreter`` is whose it was, from 1.
    """

    due: Ints
    ready: Ints
    interpreter: Ints
    timer: Flags

    def costs(self, ran: Recorded) -> Costs:
        """Return what noticing took, beside these executions; what is not known as usual."""
        ran = ran.of(ran.locks & (ran.cpu >= 0))
        beside = np.zeros(len(self.due), dtype=np.bool_)
        alone = np.zeros(len(ran.could), dtype=np.bool_)
        timers, messages = (np.zeros(len(ran.could), dtype=np.int64) for _ in range(2))
        begins, ends = ran.could, ran.could + ran.took
        for number in np.unique(ran.interpreter):
            here, came = ran.interpreter == number, self.interpreter == number
            order = np.flatnonzero(here)[np.argsort(begins[here], kind='stable')]
            beside[came] = (np.searchsorted(begins[order], self.due[came], 'right')
                            > np.searchsorted(np.sort(ends[order]), self.due[came], 'right'))
            latest = np.maximum.accumulate(ends[order])
            alone[order] = ((np.append(0, latest[:-1]) <= begins[order])
                            & (ends[order] <= np.append(begins[order][1:], latest[-1:])))
            for counted, kind in ((timers, self.timer), (messages, ~self.timer)):
                ready = np.sort(self.ready[came & kind])
                counted[order] = (np.searchsorted(ready, ends[order], 'left')
                                  - np.searchsorted(ready, begins[order], 'right'))
        stood = (ran.took - ran.cpu)[alone]
        late = self.ready - self.due - SWITCH_NS * beside
        found: dict[str, int] = {}
        for name, kind, here, other in (('timer', self.timer, timers[alone], messages[alone]),
                                        ('message', ~self.timer, messages[alone], timers[alone])):
            for what, values in (('ns', stood[(here == 1) & (other == 0)]),
                                 ('ready_ns', late[kind & ~beside]),
                                 ('ready_ns', late[kind & beside])):
                if len(values) >= ENOUGH:
                    value = max(0, int(np.median(values)))
                    found[f'{name}_{what}'] = min(value, found.get(f'{name}_{what}', value))
        return Costs(**found)

    def executions(self, costs: Costs) -> Recorded:
        """Return what the intakes did as executions."""
        takes = np.where(self.timer, costs.timer_ns, costs.message_ns)
        more = np.where(self.timer, costs.timer_rest, costs.message_rest)
        took = np.maximum(takes, self.ready - self.due + more)
        due = self.ready + more - took
        n = len(due)
        return Recorded(due, took, takes, np.ones(n, dtype=np.bool_), self.interpreter,
                        np.full(n, -1), np.ones(n, dtype=np.bool_))
