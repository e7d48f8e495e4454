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

from mddag_executor.replay.path_flows import Flows
from mddag_executor.replay.paths import PathBook


def path_results(book: PathBook | Flows) -> dict[str, Any]:
    """
    Return by path its figures, all times in ns.

    ``flows`` counts the inputs and ``arrived`` those whose flow reached the last callback.
    ``response_time`` has CARET's cases (see ``path_stream``) from the first publication to the
    start of the last callback, ``whole`` those from the start of the first to the end of the last.
    ``reaction_time`` is the worst case with external latency, ``data_age`` that of every output.
    Median and p99 are exact up to 32,768 response times; where there are more,
    ``quantiles_within`` tells how exact they are, as a share.
    """
    return {
        path.name: {'callbacks': list(path.callbacks), 'hops': [hop.kind for hop in hops],
                    **figures}
        for path, hops, figures in zip(book.paths, book.hops, book.figures())}
