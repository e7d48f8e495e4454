# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The paper's figure: acceptance ratio against normalised utilisation, number of runs below.

matplotlib (the extra ``batch``) is used without its windows and global state, and is imported when
a figure is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
import os
from typing import Any, BinaryIO, TYPE_CHECKING

from mddag_executor.errors import InputError
from mddag_executor.text import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from mddag_executor.laboratory.acceptance import Acceptance, Evaluation

FORMATS = ('.png', '.svg', '.pdf')

# Colours of Okabe and Ito, which colour-blind readers can distinguish; each with its own marker.
_STYLES = (
    ('#0072B2', 'o'), ('#D55E00', 's'), ('#009E73', '^'), ('#CC79A7', 'D'), ('#E69F00', 'v'),
    ('#56B4E9', 'P'), ('#000000', 'X'),
)
_MOST_TICKS = 15
_SHIFT = 0.003
"""Distance of the points of neighbouring policies, so that no bar hides another."""


def check_plot(path: str) -> None:
    """Find out whether a figure can be drawn into this file, before the work starts."""
    if os.path.splitext(path)[1].lower() not in FORMATS:
        raise InputError(
            path, 'unsupported file extension', f'use one of {", ".join(FORMATS)}')
    if find_spec('matplotlib') is None:
        raise InputError(
            path, 'matplotlib, which draws it, is not installed',
            "install 'mddag_executor[batch]' with pip")


def draw(evaluation: Evaluation, file: BinaryIO, path: str) -> None:
    """Draw the figure of an evaluation into a file; the ending of its path selects the format."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    kind = os.path.splitext(path)[1].lower()[1:]
    width = 6.4 if len(evaluation.experiments) == 1 else 8.8  # with the legend at its side
    # Without these, two figures of the same data would differ.
    metadata: dict[str, Any] = {'png': {}, 'svg': {'Date': None}, 'pdf': {'CreationDate': None}}
    with rc_context({'svg.hashsalt': 'mddag', 'font.size': 9.0}):
        figure = Figure(figsize=(width, 4.8), layout='constrained')
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
        _ratios(above, evaluation)
        _counts(below, evaluation)
        figure.savefig(file, format=kind, dpi=150, metadata=metadata[kind])


def _ratios(axes: Axes, evaluation: Evaluation) -> None:
    bound = evaluation.bound()
    bins = evaluation.bins
    axes.plot(*_points(bins, bound, 0.0), color='0.5', linestyle='--', linewidth=1.0,
              label=f'no scheduler above ({_total(bound)})')
    by_policy = evaluation.by_policy()
    for i, (name, acceptance) in enumerate(by_policy.items()):
        colour, marker = _STYLES[i % len(_STYLES)]
        shift = (i - (len(by_policy) - 1) / 2) * _SHIFT
        x, y = _points(bins, acceptance, shift)
        intervals = [each for each in acceptance.interval if each is not None]
        bars = ([ratio - low for ratio, (low, _) in zip(y, intervals)],
                [high - ratio for ratio, (_, high) in zip(y, intervals)])
        preemptive = evaluation.experiment.settings(name).preemptive
        label = f'{name}{"" if preemptive else ", non-preemptive"} ({_total(acceptance)})'
        axes.errorbar(x, y, yerr=bars, color=colour, marker=marker, markersize=4.5,
                      linewidth=1.2, elinewidth=0.8, capsize=2.0, label=label)
    axes.set_ylabel('acceptance ratio')
    axes.set_ylim(-0.03, 1.03)
    axes.grid(color='0.9', linewidth=0.6)
    axes.set_axisbelow(True)
    many = len(evaluation.experiments) > 1
    place: dict[str, Any] = {'loc': 'lower left'}  # free in the paper's figure
    if many:
        place = {'loc': 'upper left', 'bbox_to_anchor': (1.01, 1.0)}
    axes.legend(fontsize=8, frameon=False, title='bars: 95 % confidence (Wilson)',
                title_fontsize=8, alignment='left', **place)
    axes.set_title(_title(evaluation), fontsize=9)


def _title(evaluation: Evaluation) -> str:
    workers = {each.workers for each in evaluation.experiments}
    many = len(evaluation.experiments)
    least, most = min(workers), max(workers)
    return (
        f'{counted(evaluation.runs, "run")} of {evaluation.experiment.duration_ns / 1e9:g} s, '
        + (f'{many} declarations, ' if many > 1 else '')
        + (counted(most, 'worker') if least == most else f'{least} to {most} workers'))


def _points(
    bins: Sequence[float], acceptance: Acceptance, shift: float
) -> tuple[list[float], list[float]]:
    """Return the bins that are not empty and their ratios."""
    found = [(x + shift, y) for x, y in zip(bins, acceptance.ratio) if y is not None]
    return [x for x, _ in found], [y for _, y in found]


def _total(acceptance: Acceptance) -> str:
    return '-' if acceptance.total is None else f'{acceptance.total:.1%} of all'


def _counts(axes: Axes, evaluation: Evaluation) -> None:
    counts, bins = evaluation.bound().runs, evaluation.bins
    if len(evaluation.experiments) > 1:
        filled = [place for place, count in enumerate(counts) if count] or [0]
        chosen = slice(filled[0], filled[-1] + 1)
        counts, bins = counts[chosen], bins[chosen]
    bars = axes.bar(bins, counts, width=0.035, color='0.75')
    axes.bar_label(bars, labels=[f'{count:,}' if count else '' for count in counts], fontsize=7)
    axes.set_ylim(0, max([*counts, 1]) * 1.3)
    axes.set_ylabel('runs')
    axes.set_xlabel('normalised utilisation')
    ticks = bins if len(bins) <= _MOST_TICKS else bins[::2]
    axes.set_xticks(ticks, [f'{x:.2f}' for x in ticks])
    for side in ('top', 'right'):
        axes.spines[side].set_visible(False)
