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

"""The end-to-end part of a replay's result: the figures of each declared path."""

from __future__ import annotations

from typing import Any

from mddag_executor.replay.path_cases import cases, Record, statistics
from mddag_executor.replay.path_flows import Flows
from mddag_executor.replay.paths import PathBook


def path_results(book: PathBook | Flows) -> dict[str, Any]:
    """
    Return by path its figures, all times in ns.

    ``flows`` counts the inputs and ``arrived`` those whose flow reached the last callback.
    ``response_time`` has CARET's cases (see ``path_cases``) from the first publication to the
    start of the last callback, ``whole`` those from the start of the first to the end of the last.
    ``reaction_time`` is the worst case with external latency, ``data_age`` that of every output.
    """
    if isinstance(book, Flows):
        return book.figures()
    return {path.name: _result(book, number) for number, path in enumerate(book.paths)}


def _result(book: PathBook, number: int) -> dict[str, Any]:
    inner: list[Record] = []
    outer: list[Record] = []
    flows = arrived = 0
    for first, arrival, begin, end in book.ends(number):
        flows += 1
        arrived += arrival is not None
        if first is not None:
            inner.append((first, arrival))
        if begin is not None:
            outer.append((begin, end))
    response = cases(inner)
    whole = cases(outer)
    return {
        'callbacks': list(book.paths[number].callbacks),
        'hops': [hop.kind for hop in book.hops(number)],
        'flows': flows, 'arrived': arrived,
        'response_time': _cases(response), 'reaction_time':
            statistics(response.worst_with_external_latency),
        'data_age': statistics(response.data_age),
        'whole': {
            'response_time': _cases(whole),
            'reaction_time': statistics(whole.worst_with_external_latency),
            'data_age': statistics(whole.data_age)}}


def _cases(found: Any) -> dict[str, Any]:
    return {
        'all': statistics(found.every), 'best': statistics(found.best),
        'worst': statistics(found.worst),
        'worst_with_external_latency': statistics(found.worst_with_external_latency)}
