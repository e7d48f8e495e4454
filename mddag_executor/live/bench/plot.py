# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Draw what was measured: a curve for each executor, the load from left to right.

Above is what the load asks for: for declared loads with deadlines the share in time, as in the
paper's figure, for message loads the dispatch latency.  Below is the CPU time for each callback;
there the nodes without an executor are a dashed line, the least that any of them can take.
matplotlib (the extra ``batch``) is imported when a figure is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
import os
from typing import Any, BinaryIO, TYPE_CHECKING

from mddag_executor.live.bench.spec import NONE
from mddag_executor.simulate.plot import two_plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MARKERS = 'os^Dv*PX'
_X_LABELS = {
    'autoware': 'normalised utilisation', 'reference-system': 'normalised utilisation',
    'topics': 'load', 'entities': 'idle subscriptions beside an active one'}


def draw(results: Sequence[dict[str, Any]], file: BinaryIO, path: str) -> None:
    """
    Draw results of one load into a file.

    :param results: as ``run_all`` returns them.
    :param path: the file's name, whose ending says the kind of picture.
    """
    from matplotlib import style
    first = results[0]
    load = first['load']
    with style.context('tableau-colorblind10'), two_plots(
            file, path, (6.4, 5.6), (3, 2)) as (above, below):
        _curves(above, results, _in_time if load == 'autoware' else _latency)
        _curves(below, results, _cpu)
        if load == 'autoware':
            above.set_ylabel('sink jobs in time, %')
            above.set_ylim(-3, 103)
        else:
            hot = load == 'reference-system'
            above.set_ylabel('hot path p99, ms' if hot else 'dispatch latency p99, us')
            above.set_yscale('log')
        below.set_ylabel('CPU for each callback, us')
        taken = [cpu for result in results if (cpu := _cpu(result))]
        if taken and max(taken) > 5 * min(taken):
            below.set_yscale('log')
        else:  # the differences are small, and shall look so
            below.set_ylim(bottom=0)
        below.set_xlabel(_X_LABELS[load])
        if load == 'entities':
            below.set_xscale('symlog', linthresh=1)
            below.set_xlim(left=-0.3)
        above.legend(fontsize=8, frameon=False)
        above.set_title(
            f'{_load(first)}: {first["seconds"]:g} s each, median of {first["repeat"]}, '
            f'{first["workers"]} workers', fontsize=9)


def _curves(axes: Axes, results: Sequence[dict[str, Any]], value: Any) -> None:
    for i, name in enumerate(dict.fromkeys(result['executor'] for result in results)):
        points = [(_x(result), value(result)) for result in results
                  if result['executor'] == name]
        points = [(x, y) for x, y in points if x is not None and y is not None]
        look = {'color': '0.4', 'linestyle': '--'} if name == NONE else {
            'marker': _MARKERS[i % len(_MARKERS)], 'markersize': 4.5}
        axes.plot([x for x, _ in points], [y for _, y in points], label=name, linewidth=1.2,
                  **look)
    axes.grid(color='0.9', linewidth=0.6)
    axes.set_axisbelow(True)


def _load(result: dict[str, Any]) -> str:
    """Return the load's name, or that of the declaration's file."""
    graph = result.get('graph')
    name: str = os.path.splitext(os.path.basename(graph))[0] if graph else result['load']
    return name


def _x(result: dict[str, Any]) -> Any:
    if result['load'] == 'topics':
        return f'{result["topics"]} topics at {result["rate_hz"]:g} Hz'
    return result['idle'] if result['load'] == 'entities' else result['utilisation']


def _in_time(result: dict[str, Any]) -> float | None:
    ratio = result['on_time_ratio']
    return None if ratio is None or result['executor'] == NONE else 100 * float(ratio)


def _latency(result: dict[str, Any]) -> float | None:
    """Return the p99 of the hot path in ms, or else of the dispatch latency in us."""
    if result['load'] == 'reference-system':
        hot = result['hot_path_us']
        return None if hot is None or hot['p99'] is None else float(hot['p99']) / 1000
    latency = result['dispatch_latency_us']
    return None if latency is None else float(latency['p99'])


def _cpu(result: dict[str, Any]) -> float | None:
    cpu: float | None = result['cpu_us_per_callback']
    return cpu
