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
Response times of a path, as CARET defines them.

Theory of operation
-------------------
The records of a path are pairs of an input's time (*start*) and an output's (*end*); where a flow
did not arrive there is no end.  Source: caret_analyze, ``ResponseTime`` (0.5), and CARET's
documentation of the response time's cases.

* An input whose flow did not arrive takes the earliest of the ends of the inputs after it: that is
  when something at least as new came out.  Of several outputs of an input the earliest counts.
  The inputs of the earliest output are left out: what came before them is not known.
* `all`: every input.  `best`: of the inputs with the same output the newest.  `worst`: the oldest.
  `worst-with-external-latency`: the same, from the input before it on: what happened right after
  that one had to wait for the next.  That is the *reaction time* to something outside.
* The *data age* of an output is the time since the newest input that it is made of, for every
  output, also where an earlier one was made of that input.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from mddag_executor.core import quantile

Record = tuple[int, int | None]
Response = tuple[int, int]      # start, response time


class Cases(NamedTuple):
    """Start and response time of each input or output, in order of the start, ns."""

    every: list[Response]
    best: list[Response]
    worst: list[Response]
    worst_with_external_latency: list[Response]
    data_age: list[Response]


def cases(records: Iterable[Record]) -> Cases:
    """
    Return the response times of a path.

    :param records: start and end of each flow, ns; they need no order.
    """
    ordered = sorted(
        (record for record in records if record[1] is None or record[1] >= record[0]),
        key=lambda record: record[0])
    pairs = _by_input(ordered)
    newest: dict[int, int] = {}
    oldest: dict[int, int] = {}
    for start, end in pairs:
        newest[end] = start
        oldest.setdefault(end, start)
    external: dict[int, int] = {}
    for (before, _), (_, end) in zip(pairs, pairs[1:]):
        external.setdefault(end, before)
    made_of: dict[int, int] = {}
    for start, arrived in ordered:
        if arrived is not None:
            made_of[arrived] = start
    return Cases(
        [(start, end - start) for start, end in pairs],
        *(sorted((start, end - start) for end, start in chosen.items())
          for chosen in (newest, oldest, external, made_of)))


def _by_input(ordered: Sequence[Record]) -> list[tuple[int, int]]:
    """Return each input with the output that it counts for."""
    first_end: dict[int, int] = {}
    least: int | None = None
    for start, end in reversed(ordered):
        if end is None:
            end = least
        if end is None:
            continue
        if end < first_end.get(start, end + 1):
            first_end[start] = end
        least = end if least is None else min(least, end)
    return sorted((start, end) for start, end in first_end.items() if end != least)


def statistics(responses: Sequence[Response]) -> dict[str, Any] | None:
    """Return count, min, mean, median, p99 and max (ns) of response times; None: there is none."""
    if not responses:
        return None
    ordered = sorted(time for _, time in responses)
    return {
        'count': len(ordered), 'min': ordered[0], 'mean': round(sum(ordered) / len(ordered)),
        'median': quantile(ordered, 0.5), 'p99': quantile(ordered, 0.99), 'max': ordered[-1]}
