# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The figures of an HTML report, made with Bokeh.

The page's script ``html.js`` moves the timelines to a missed deadline.
"""

from __future__ import annotations

from typing import Any

from bokeh.models import (
    ColumnDataSource,
    CustomJSTickFormatter,
    FixedTicker,
    HoverTool,
    LinearColorMapper,
    Range1d,
    RangeTool,
    WheelZoomTool,
)
from bokeh.models.annotations import BoxAnnotation, Span
from bokeh.plotting import figure
from bokeh.themes import Theme
from mddag_executor.replay.usage import PoolUse
from mddag_executor.report.html_data import (
    BLUE,
    COLOURS,
    label,
    Line,
    Prepared,
    RED,
    ReportData,
    seconds,
)
from mddag_executor.report.tables import short_names
from mddag_executor.report.text import format_ns
import numpy as np

MOST_HISTOGRAMS = 30
_LEFT = 270             # room for the labels, the same in all timelines, so that they align
_LINE = 16              # height of a line of a timeline, pixels
_TOOLTIP = ('<div style="max-width:46em"><b>@a</b><br>@b<br>@c<br>@d</div>')
_ZOOM = 'xpan,xbox_zoom,xzoom_in,xzoom_out,reset,save'

THEME = Theme(json={'attrs': {
    'Plot': {'outline_line_color': '#bbbbbb', 'min_border_right': 24},  # half of the last label
    'Toolbar': {'logo': None}, 'Title': {'text_font_size': '12px'},
    'Axis': {'axis_label_text_font_style': 'normal', 'axis_label_text_font_size': '12px',
             'major_label_text_font_size': '11px', 'minor_tick_line_color': None},
    'BasicTickFormatter': {'use_scientific': False}}})


def figures(data: ReportData, prepared: Prepared) -> list[Any]:
    """Return the figures of a report: overview, timelines by worker and callback, histograms."""
    duration = max(1, data.duration_ns) / 1e9
    time = Range1d(
        start=0, end=duration, bounds=(-0.2 * duration, 1.2 * duration), name='timeline_range')
    gaps = [(seconds(data, left), seconds(data, right)) for left, right in data.timeline.gaps]
    executions = ColumnDataSource(prepared.executions, name='executions')
    marks = ColumnDataSource(prepared.marks, name='marks')
    return [
        _overview(data, time),
        _timeline('workers', prepared.worker_lines, time, gaps, executions, marks),
        _timeline('callbacks', prepared.lines, time, gaps, executions, marks),
        *_histograms(data)]


_TICKS = """
const span = range.end - range.start;
const [scale, unit] = span >= 2 ? [1, 's'] : span >= 2e-3 ? [1e3, 'ms'] : [1e6, 'us'];
const digits = Math.min(6, Math.max(0, 1 - Math.floor(Math.log10(span * scale))));
return `${(tick * scale).toFixed(digits)} ${unit}`;
"""


def _overview(data: ReportData, time: Range1d) -> Any:
    """Return the use of the pool over the whole run, with a movable window."""
    duration, workers = max(1, data.duration_ns) / 1e9, data.result['workers']
    plot: Any = figure(
        height=150, sizing_mode='stretch_width', tools='', toolbar_location=None,
        x_range=Range1d(start=0, end=duration), y_range=Range1d(start=0, end=workers * 1.08),
        min_border_left=_LEFT, name='overview')
    edges, busy = _over_time(data, data.timeline.busy_over_time)
    plot.quad(left=edges[:-1], right=edges[1:], bottom=0, top=busy,
              fill_color=BLUE, line_color=None)
    edges, missed = _over_time(data, data.timeline.missed_over_time)
    late = missed > 0
    plot.quad(left=edges[:-1][late], right=edges[1:][late], bottom=workers * 1.02,
              top=workers * 1.08, fill_color=RED, line_color=RED, line_width=3)
    plot.yaxis.axis_label = 'busy workers'
    plot.xaxis.axis_label = 'time (s)'
    tool = RangeTool(x_range=time)
    tool.overlay.fill_color = '#888888'      # on light and dark pages
    tool.overlay.fill_alpha = 0.2
    plot.add_tools(tool)
    return plot


def _over_time(data: ReportData, use: PoolUse) -> tuple[Any, Any]:
    """Return the edges of steps (s), and the mean number of busy workers in each."""
    edges = (use.start or 0) + use.step * np.arange(len(use.busy) + 1)
    return seconds(data, edges), np.array(use.busy) / use.step


def _timeline(
    name: str, lines: list[Line], time: Range1d, gaps: list[tuple[float, float]],
    executions: ColumnDataSource, marks: ColumnDataSource,
) -> Any:
    """Return a timeline with a line for each worker or callback, given by column ``name``."""
    count = len(lines)
    plot: Any = figure(
        height=count * _LINE + 94, sizing_mode='stretch_width', x_range=time,
        y_range=Range1d(start=-0.7, end=count - 0.3), tools=_ZOOM, active_drag='xpan',
        toolbar_location='above', min_border_left=_LEFT, name=name)
    for line in lines:
        if line.heading:
            plot.add_layout(BoxAnnotation(
                bottom=line.y - 0.5, top=line.y + 0.5, fill_color='#eeeeee', fill_alpha=1,
                line_color=None, level='underlay'))
    for left, right in gaps:
        plot.add_layout(BoxAnnotation(
            left=left, right=right, hatch_pattern='/',
            hatch_color='#cccccc', fill_color=None, line_color=None, level='underlay'))
    for kind, colour in (('job', '#ffe08a'), ('late', '#f4a6a0')):
        plot.add_layout(BoxAnnotation(
            left=0, right=0, fill_color=colour, fill_alpha=0.35, line_color=None,
            level='underlay', visible=False, name=f'{name}_{kind}'))
    # without Ctrl the wheel scrolls the page
    plot.toolbar.active_scroll = WheelZoomTool(dimensions='width', modifiers='ctrl')
    plot.add_tools(plot.toolbar.active_scroll)
    by_class: Any = {'field': 'class', 'transform': LinearColorMapper(
        palette=list(COLOURS), low=-0.5, high=len(COLOURS) - 0.5)}
    bars = plot.hbar(y=name, left='left', right='right', height=0.8, source=executions,
                     fill_color=by_class, line_color=by_class, line_width=0.5)
    plot.add_tools(HoverTool(renderers=[bars], tooltips=_TOOLTIP, point_policy='follow_mouse'))
    marked = plot.scatter('x', name, source=marks, marker='inverted_triangle', size=9,
                          fill_color=RED, line_color='#ffffff')
    plot.add_tools(HoverTool(renderers=[marked], tooltips=_TOOLTIP))
    plot.yaxis.ticker = FixedTicker(ticks=[line.y for line in lines])
    plot.yaxis.major_label_overrides = {line.y: line.label for line in lines}
    plot.yaxis.major_tick_line_color = None
    plot.xaxis.axis_label = 'time'
    plot.xaxis.formatter = CustomJSTickFormatter(code=_TICKS, args={'range': time})
    plot.ygrid.grid_line_color = None
    return plot


def _histograms(data: ReportData) -> list[Any]:
    """Return response-time histograms, sinks with the least slack first."""
    tally = data.replay.tally
    short = short_names(tally.vertex_name(vertex) for vertex in tally.sinks)
    sinks = [(short[tally.vertex_name(vertex)], sink)
             for vertex, sink in tally.sinks.items() if sink.responses]
    sinks.sort(key=lambda item: -(item[1].longest or 0) / max(1, item[1].relative_deadline_ns))
    return [_histogram(label(name, 46), sink) for name, sink in sinks[:MOST_HISTOGRAMS]]


def _histogram(title: str, tally: Any) -> Any:
    deadline = tally.relative_deadline_ns
    responses = np.fromiter(tally.responses, dtype=np.int64, count=len(tally.responses))
    scale, unit = _scale(max(deadline, int(responses.max())))
    # the deadline is a multiple of the width, so no bar is partly late
    width = deadline / max(1, round(40 * deadline / max(deadline, int(responses.max()))))
    places = np.floor(np.maximum(responses - 1, 0) / width).astype(np.int64)
    if int(places.max()) > 400:     # a few very late jobs: all of them in the last bar
        places = np.minimum(places, 400)
    counts = np.bincount(places)
    left = np.flatnonzero(counts) * width
    late = left >= deadline * (1 - 1e-9)
    plot: Any = figure(
        height=210, sizing_mode='stretch_width', tools='xwheel_zoom,xpan,reset',
        active_scroll=None, active_drag=None, toolbar_location=None,
        title=f'{title}: deadline {format_ns(deadline)}', min_border_left=50)
    plot.y_range.start = 0
    source = ColumnDataSource({
        'left': left / scale, 'right': (left + width) / scale, 'top': counts[counts > 0],
        'colour': np.where(late, RED, BLUE).tolist()})
    bars = plot.quad(left='left', right='right', bottom=0, top='top', source=source,
                     fill_color='colour', line_color='#ffffff', line_width=0.5)
    plot.add_tools(HoverTool(renderers=[bars], tooltips=[
        ('response', f'@left{{0.[000]}} to @right{{0.[000]}} {unit}'), ('jobs', '@top')]))
    plot.add_layout(Span(location=deadline / scale, dimension='height', line_color=RED,
                         line_dash='dashed', line_width=2))
    plot.x_range.start = 0
    plot.x_range.end = max(deadline * 1.06, float((left + width).max()) * 1.02) / scale
    plot.xaxis.axis_label = f'response time ({unit})'
    plot.yaxis.axis_label = 'jobs'
    return plot


def _scale(largest: int) -> tuple[float, str]:
    for scale, unit in ((1e9, 's'), (1e6, 'ms'), (1e3, 'us')):
        if largest >= 2 * scale:
            return scale, unit
    return 1.0, 'ns'
