# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
The flows along paths as columns, and their response times by the definitions of ``path_cases``.

A flow is four times: the first publication (or the first start, where nothing is published), the
arrival, the begin of the first callback's execution and the end of the last one's.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from mddag_executor.core import quantile
from mddag_executor.replay.paths import Hop
from msg_graph import Path
import numpy as np
import numpy.typing as npt

Column = npt.NDArray[np.int64]
NONE = -1
_SAFE = 2 ** 62


class FlowColumns(NamedTuple):
    """The flows along a path; what there is not is -1.  All times in ns."""

    first: Column
    arrival: Column
    begin: Column
    end: Column


class Flows(NamedTuple):
    """The flows along all paths."""

    paths: list[Path]
    hops: list[list[Hop]]
    columns: list[FlowColumns]

    def figures(self) -> dict[str, Any]:
        """Return by path what ``path_results`` returns."""
        return {path.name: {
            'callbacks': list(path.callbacks), 'hops': [hop.kind for hop in hops],
            **figures(columns)}
            for path, hops, columns in zip(self.paths, self.hops, self.columns)}


class Times(NamedTuple):
    """Response times in each of the cases of ``path_cases.Cases``, ns, in no order."""

    every: Column
    best: Column
    worst: Column
    worst_with_external_latency: Column
    data_age: Column


def figures(columns: FlowColumns) -> dict[str, Any]:
    """Return the figures of a path from its flows."""
    inner = times(*_with(columns.first, columns.arrival))
    whole = times(*_with(columns.begin, columns.end))
    return {
        'flows': len(columns.first), 'arrived': int((columns.arrival != NONE).sum()),
        'response_time': _cases(inner),
        'reaction_time': statistics(inner.worst_with_external_latency),
        'data_age': statistics(inner.data_age),
        'whole': {
            'response_time': _cases(whole),
            'reaction_time': statistics(whole.worst_with_external_latency),
            'data_age': statistics(whole.data_age)}}


def _with(start: Column, end: Column) -> tuple[Column, Column]:
    known = start != NONE
    return start[known], end[known]


def times(start: Column, end: Column) -> Times:
    """
    Return the response times of a path.

    :param start: of each flow.
    :param end: of each flow, -1 where there is none.
    """
    kept = (end == NONE) | (end >= start)
    start, end = start[kept], end[kept]
    order = np.argsort(start, kind='stable')
    start, end = start[order], end[order]
    arrived = end != NONE
    _, last = np.unique(end[arrived][::-1], return_index=True)
    age = (end[arrived] - start[arrived])[::-1][last]
    # each input has the earliest of its own ends and of those after it
    earliest = np.minimum.accumulate(np.where(arrived, end, _SAFE)[::-1])[::-1]
    own = np.where(arrived, end, earliest)
    some = own < _SAFE
    start, own = start[some], own[some]
    if not len(start):
        return Times(start, start, start, start, age)
    first = np.flatnonzero(np.r_[True, start[1:] != start[:-1]])
    start, own = start[first], np.minimum.reduceat(own, first)
    counted = own != own.min()
    start, own = start[counted], own[counted]
    _, oldest = np.unique(own, return_index=True)
    _, newest = np.unique(own[::-1], return_index=True)
    _, after = np.unique(own[1:], return_index=True)
    return Times(
        own - start, (own - start)[::-1][newest], (own - start)[oldest],
        own[1:][after] - start[after], age)


def statistics(values: Column) -> dict[str, Any] | None:
    """Return count, min, mean, median, p99 and max of response times; None: there is none."""
    if not len(values):
        return None
    ordered = np.sort(values)
    n = len(ordered)
    small = int(ordered[-1]) < _SAFE // n
    total = int(ordered.sum()) if small else sum(ordered.tolist())
    view = memoryview(ordered)
    return {
        'count': n, 'min': view[0], 'mean': round(total / n), 'median': quantile(view, 0.5),
        'p99': quantile(view, 0.99), 'max': view[-1]}


def _cases(found: Times) -> dict[str, Any]:
    return {
        'all': statistics(found.every), 'best': statistics(found.best),
        'worst': statistics(found.worst),
        'worst_with_external_latency': statistics(found.worst_with_external_latency)}
