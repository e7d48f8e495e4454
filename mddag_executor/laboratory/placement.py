# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Which node runs in which process: packed by the time that nodes need the interpreter.

Theory of operation
-------------------
A process computes Python on one core, so its interpreter bounds its load.

1. The *load* of a node is the share of time for which its callbacks hold the interpreter:
   execution time over period, of all vertices without ``holds_interpreter: false``.
2. A message that leaves its process costs ``TRANSPORT_NS`` more at either end.
3. Nodes that stay together are one *block*.  Nodes that publish one topic do, since otherwise the
   publisher of a message is unknown.  Each block, the largest first, is placed so that the largest
   load of a process is least; then single blocks are moved, and pairs exchanged, as long as that
   lowers the largest load, or the sum of all loads at an equal largest one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations

from mddag_executor.errors import UsageError
from mddag_executor.text import counted
from msg_graph import Process, TaskSet

TRANSPORT_NS = 150_000
"""What a message between two processes costs the interpreter of each of them."""


class Placing:
    """
    Places the nodes of a task set.

    :param execution_ns: the execution time of each vertex, by DAG and local index.
    :param together: nodes that run in one process, group by group.
    :raises UsageError: if there are more processes than nodes, or groups of nodes.
    """

    def __init__(
        self, task_set: TaskSet, n_processes: int, execution_ns: Sequence[Sequence[int]],
        together: Iterable[Sequence[str]] = (),
    ) -> None:
        self._task_set = task_set
        self._n = n_processes
        self.nodes = list(dict.fromkeys(callback.node for callback in task_set.callbacks))
        self._block = {node: i for i, node in enumerate(self.nodes)}
        for group in (*together, *self._publishers()):
            joined = {self._block[node] for node in group}
            for node, block in self._block.items():
                if block in joined:
                    self._block[node] = min(joined)
        self._blocks = sorted(set(self._block.values()))
        if n_processes > len(self._blocks):
            raise UsageError(
                f'--processes {n_processes}: only {counted(len(self._blocks), "node")}, or groups '
                'of nodes, can be placed: give fewer processes')
        self._own = dict.fromkeys(self._blocks, 0.0)
        self._between: dict[int, dict[int, float]] = {block: {} for block in self._blocks}
        self._measure(execution_ns)

    def _publishers(self) -> list[list[str]]:
        """Return the nodes that publish one topic, topic by topic (rule 3)."""
        by_topic: dict[str, list[str]] = {}
        for callback in self._task_set.callbacks:
            for topic in callback.publishes:
                by_topic.setdefault(topic, []).append(callback.node)
        return list(by_topic.values())

    def _measure(self, execution_ns: Sequence[Sequence[int]]) -> None:
        """Sum up what blocks compute, and what passes between two of them (rules 1 and 2)."""
        for dag in self._task_set.dags:
            for vertex in dag.vertices:
                block = self._block[vertex.callback.node]
                if vertex.callback.holds_interpreter is not False:
                    self._own[block] += execution_ns[dag.index][vertex.index] / dag.period_ns
                for after in vertex.successors:
                    other = self._block[dag.vertices[after].callback.node]
                    for a, b in ((block, other), (other, block)):
                        if a != b:
                            self._between[a][b] = (
                                self._between[a].get(b, 0.0) + TRANSPORT_NS / dag.period_ns)

    def block_of(self, node: str) -> int:
        """Return the block that a node is in."""
        return self._block[node]

    def loads(self, place: dict[int, int]) -> list[float]:
        """Return the load of each process; of blocks that are placed."""
        loads = [0.0] * self._n
        for block, process in place.items():
            loads[process] += self._own[block] + sum(
                cost for other, cost in self._between[block].items()
                if place.get(other, process) != process)
        return loads

    def place(self) -> dict[int, int]:
        """Return the process of each block (rule 3)."""
        place: dict[int, int] = {}
        for block in sorted(self._blocks, key=lambda b: (-self._own[b], b)):
            left = len(self._blocks) - len(place)
            empty = [p for p in range(self._n) if p not in place.values()]
            choice = empty if left <= len(empty) else range(self._n)
            # of equal ones the process with fewer blocks
            place[block] = min(choice, key=lambda p: (
                self._cost({**place, block: p}), sum(q == p for q in place.values()), p))
        better: dict[int, int] | None = place
        while better is not None:
            place, cost = better, self._cost(better)
            better = next((p for p in self._neighbours(place) if self._cost(p) < cost), None)
        return place

    def _cost(self, place: dict[int, int]) -> tuple[float, float]:
        loads = self.loads(place)
        return round(max(loads), 9), round(sum(loads), 9)

    def _neighbours(self, place: dict[int, int]) -> Iterator[dict[int, int]]:
        """Yield the placements that differ in one block, or in two exchanged ones."""
        moved = ({**place, block: process} for block in self._blocks
                 for process in range(self._n) if process != place[block])
        yield from (each for each in moved if len(set(each.values())) == self._n)
        for one, other in combinations(self._blocks, 2):
            if place[one] != place[other]:
                yield {**place, one: place[other], other: place[one]}

    def processes(self, place: dict[int, int]) -> tuple[Process, ...]:
        """Return the processes of a placement, ``p1`` with the node that is declared first."""
        order = list(dict.fromkeys(place[self._block[node]] for node in self.nodes))
        return tuple(
            Process(f'p{i}', tuple(n for n in self.nodes if place[self._block[n]] == process))
            for i, process in enumerate(order, 1))


def packed(
    task_set: TaskSet, n: int, execution_ns: Sequence[Sequence[int]],
    together: Iterable[Sequence[str]] = (),
) -> tuple[Process, ...]:
    """Return the nodes of a task set packed into N processes; see ``Placing``."""
    placing = Placing(task_set, n, execution_ns, together)
    return placing.processes(placing.place())
