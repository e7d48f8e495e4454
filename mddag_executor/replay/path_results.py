# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The end-to-end part of a replay's result: the figures of each declared path."""

from __future__ import annotations

from typing import Any

from mddag_executor.replay.paths import PathBook


def path_results(book: PathBook) -> dict[str, Any]:
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
