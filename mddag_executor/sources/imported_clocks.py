# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The clocks of the computers of an imported recording.

Theory of operation
-------------------
A recording of LTTng says which processes ran on one computer (`mddag:host`), others do not.
Containers have names of their own, and the clock of their computer: what counts is its boot.

1. On one clock no message is received before it was published.  If none is, all processes are
   assumed to have one clock, and times are left as they are.  Between known computers, a warning
   says so, and by how much their clocks can differ: by less than the shortest message in the
   direction in which a difference makes messages shorter.
2. Otherwise processes are grouped into machines: those of one computer first, then those with the
   shortest messages, so that no message within a machine is received before it was published.
3. The offsets of the machines from the one with the most executions are estimated from messages in
   both directions (``clocks``).  Events of a machine with a known offset are moved to its clock.
4. Messages between machines without a known offset are *distrusted*: an execution that one of
   them started belongs to no known job, so its job is not judged.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property

from mddag_executor.recording.columns import Ints, Mask
from mddag_executor.recording.joins import different, distinct
from mddag_executor.sources import clocks
from mddag_executor.sources.links import Links
from mddag_executor.text import counted, listed
import numpy as np


class ImportedClocks:
    """
    The clocks of the processes of a recording.

    :param hosts: by process id its computer, if it is known: its name, and that of its boot.
    :ivar shift: by process id what is added to its times, ns; without those that do not change.
    """

    def __init__(self, links: Links, hosts: Mapping[int, tuple[str, str]]) -> None:
        self._links = links
        runs, messages = links.runs, links.messages
        pids, which = different(np.array([pid for pid, _ in links.threads], dtype=np.int64))
        self._pids: list[int] = pids.tolist()
        self._receives = which[runs['thread']]
        thread = links.events['thread'][messages['at']]
        self._sends = np.append(which[thread], -1)[runs['message']]
        self._latency = np.where(runs['taken'] != 0, runs['taken'], runs['start']) - np.append(
            messages['time'], 0)[runs['message']]
        self._between = (runs['message'] >= 0) & (self._sends != self._receives)
        self._ways = self._least(self._sends, self._receives)
        self.shift: dict[int, int] = {}
        self._machine = [0] * len(self._pids)
        self._offsets: dict[int, clocks.Offset] = {}
        self._clock = {pid: boot or name for pid, (name, boot) in hosts.items()}
        self._host = {self._clock[pid]: name for pid, (name, _) in hosts.items()}
        least = self._ways
        if any(each < 0 for each in least.values()):
            self._find_machines()
        self._assumed = self._of_computers(least)

    def _least(self, sends: Ints, receives: Ints) -> clocks.Ways:
        """Return the minimum time of messages from one process or machine to another."""
        mine = np.flatnonzero(self._between & (sends != receives))
        found: clocks.Ways = {}
        pairs, which = different(sends[mine].astype(np.int64) << 32 | receives[mine])
        least = np.full(len(pairs), np.iinfo(np.int64).max)
        np.minimum.at(least, which, self._latency[mine])
        for pair, latency in zip(pairs.tolist(), least.tolist()):
            found[pair >> 32, pair & 0xFFFFFFFF] = latency
        return found

    def _of_computers(self, ways: clocks.Ways) -> dict[tuple[str, str], int]:
        """
        Return the minimum time of messages from one known computer to another (rule 1).

        :param ways: of messages from process to process.
        :return: of computers whose clocks are assumed to be one.
        """
        found: dict[tuple[str, str], int] = {}
        for (a, b), least in ways.items():
            of, to = (self._clock.get(self._pids[each]) for each in (a, b))
            if of is not None and to is not None and of != to and (
                    self._machine[a] == self._machine[b]):
                found[of, to] = min(found.get((of, to), least), least)
        return found

    def _find_machines(self) -> None:
        """Group the processes into machines (rule 2), and find their offsets (rule 3)."""
        hosts, machine = self._clock, list(range(len(self._pids)))
        self._machine = machine
        apart = {pair for pair, least in self._ways.items() if least < 0}
        # a computer with messages that are received before they were published has no one clock
        odd = {hosts[self._pids[a]] for a, b in apart
               if hosts.get(self._pids[a], a) == hosts.get(self._pids[b], b)}
        first: dict[str, int] = {}
        for place, pid in enumerate(self._pids):
            if pid in hosts and hosts[pid] not in odd:
                machine[place] = first.setdefault(hosts[pid], place)
        for (a, b), least in sorted(self._ways.items(), key=lambda way: way[1]):
            both = {machine[a], machine[b]}
            if least >= 0 and not any({machine[x], machine[y]} == both for x, y in apart):
                machine[:] = [min(both) if each in both else each for each in machine]
        most = int(np.bincount(np.array(machine)[self._receives]).argmax())
        numbers = {of: n for n, of in enumerate(dict.fromkeys([most, *machine]))}
        machine[:] = [numbers[each] for each in machine]
        number = np.array(machine, dtype=np.int64)
        self._ways = self._least(number[self._sends], number[self._receives])
        self._offsets = clocks.offsets(numbers.values(), self._ways, {})
        self.shift = {pid: -self._offsets[of].ahead for pid, of in zip(self._pids, machine)
                      if of in self._offsets and self._offsets[of].ahead}

    @cached_property
    def distrusted(self) -> Mask:
        """Return which executions were started by a message between unknown clocks (rule 4)."""
        machine = np.array(self._machine, dtype=np.int64)
        known = np.array([each in self._offsets for each in self._machine], dtype=np.bool_)
        sends, receives = self._sends, self._receives
        if not self._offsets:
            return np.zeros(len(sends), dtype=np.bool_)
        found: Mask = self._between & (machine[sends] != machine[receives]) & ~(
            known[sends] & known[receives])
        return found

    def lines(self) -> Iterator[str]:
        """Yield what is assumed about the clocks, and what is not judged."""
        for one, other in {(min(way), max(way)): None for way in self._assumed}:
            both = [self._assumed[way] for way in ((one, other), (other, one))
                    if way in self._assumed]
            yield (f'the clocks of the computers {self._host[one]} and {self._host[other]} are '
                   'assumed to be synchronised: ' + (
                       f'by the messages both ways they differ by less than {max(both) / 1e6:.3f} '
                       'ms' if len(both) > 1 else
                       'no messages both ways show how they differ, and latencies and response '
                       'times between them are off by the difference'))
        for of, (ahead, uncertainty) in self._offsets.items():
            if of != 0:
                yield (
                    f'the clock of {self._names(of)} is taken to be {abs(ahead) / 1e6:.3f} ms '
                    f'{"behind" if ahead < 0 else "ahead of"} that of {self._names(0)}, '
                    f'within {uncertainty / 1e6:.3f} ms, by the messages both ways')
        if self.distrusted.any():
            (a, b), least = min((
                way for way in self._ways.items()
                if not {*way[0]} <= self._offsets.keys()), key=lambda way: way[1])
            when = f'up to {-least / 1e6:.3f} ms before they are published' if least < 0 else \
                f'{least / 1e6:.3f} ms after they are published, or later'
            yield (
                f'clocks of computers differ: messages from {self._names(a)} to {self._names(b)} '
                f'arrive {when}, and no messages both ways show by how much: '
                f'{counted(int(self.distrusted.sum()), "execution")} for such messages are of no '
                'known job, so what they would complete is not judged: synchronise the clocks')

    def _names(self, machine: int) -> str:
        """Return the nodes of a machine, or its processes if they are unknown."""
        links = self._links
        runs = links.runs['callback'][np.array(self._machine)[self._receives] == machine]
        callbacks = [links.callbacks[each] for each in distinct(runs).tolist()]
        names = dict.fromkeys(each.node.name for each in callbacks if each.node is not None)
        pids = [pid for pid, of in zip(self._pids, self._machine) if of == machine]
        return listed(list(names), 3) or f'process {listed([str(pid) for pid in pids], 3)}'
