# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What random task sets are like, and whether there can be such task sets."""

from __future__ import annotations

from dataclasses import dataclass
import math

from mddag_executor.errors import UsageError
from mddag_executor.text import counted
from msg_graph.duration import DAY
from msg_graph.model import MOST_WORKERS

LEAST_NS = 1_000
"""The shortest execution time of a callback."""
_LEAST_ABOVE_0 = 5e-324
# field: option, least and most value
_RANGES: dict[str, tuple[str, float, float]] = {
    'dags': ('--dags', 1, 1_000),
    'vertices': ('--vertices', 1, 1_000),
    'sinks': ('--sinks', 1, 1_000),
    'edge_probability': ('--edge-probability', 0, 1),
    'or_share': ('--or-share', 0, 1),
    'utilisation': ('--utilisation', _LEAST_ABOVE_0, 100),
    'workers': ('--workers', 1, MOST_WORKERS),
    'most_per_dag': ('--max-dag-load', _LEAST_ABOVE_0, 1_000),
    'periods_ns': ('--periods', LEAST_NS, DAY),
    'tightness': ('--tightness', _LEAST_ABOVE_0, 1_000),
}



@dataclass(frozen=True)
class Options:
    """
    What a random task set is like; pairs are the bounds of a uniform draw, both included.

    :ivar vertices: number of callbacks of each DAG; ``sinks``: of its sinks.
    :ivar edge_probability: of an edge between two callbacks of a DAG.
    :ivar or_share: share of the callbacks with several predecessors that run once for each
        message (OR), and so are several vertices; the others join the messages.
    :ivar utilisation: the load of all DAGs divided by the workers.
    :ivar most_per_dag: the largest load of one DAG, in cores.
    :ivar periods_ns: each DAG gets one of these.
    :ivar tightness: each deadline divided by the period of its DAG.
    """

    dags: tuple[int, int] = (8, 8)
    vertices: tuple[int, int] = (5, 15)
    sinks: tuple[int, int] = (1, 3)
    edge_probability: float = 0.2
    or_share: float = 0.0
    utilisation: float = 0.5
    workers: int = 4
    most_per_dag: float = 1.0
    periods_ns: tuple[int, ...] = (
        10_000_000, 20_000_000, 50_000_000, 100_000_000, 200_000_000)
    tightness: tuple[float, float] = (0.5, 1.0)
    seed: int = 0

    def check(self) -> None:
        """
        Check that there can be such a task set.

        :raises UsageError: there cannot.
        """
        for name, (option, least, most) in _RANGES.items():
            value = getattr(self, name)
            values = value if isinstance(value, tuple) else (value,)
            for one in values:
                if not (math.isfinite(one) and least <= one <= most):
                    lower = 'above 0' if least == _LEAST_ABOVE_0 else f'{least:g}'
                    raise UsageError(
                        f'{option} {one:g}: it is out of range: give {lower} to {most:g}')
            if name != 'periods_ns' and values[0] > values[-1]:
                raise UsageError(f'{option} {values[0]:g}:{values[-1]:g}: the first is larger: '
                                 'write the smaller one first')
        vertices, dags = self.vertices[0], self.dags[0]
        if self.sinks[0] > max(1, vertices - 1):
            raise UsageError(
                f'--sinks {self.sinks[0]}: a DAG of {counted(vertices, "vertex", "vertices")} has '
                f'at most {max(1, vertices - 1)}: give fewer, or more --vertices')
        load = self.utilisation * self.workers
        if load > dags * self.most_per_dag * (1 + 1e-12):
            raise UsageError(
                f'--utilisation {self.utilisation:g}: a load of {load:g} does not fit into '
                f'{counted(dags, "DAG")} of at most {self.most_per_dag:g}: give more --dags, or a '
                'larger --max-dag-load')
