# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A task set as a picture: boxes, frames and arrows, independent of the picture language.

Theory of operation
-------------------
1. A DAG is a frame, a vertex is a box in it. Trigger edges are solid arrows.
2. Queue edges are dotted arrows from the vertices that write to the vertices that read. If reader
   and writer have vertices in the same DAG, those are joined. A reader without a writer in its own
   DAG gets one arrow, from the writer's first vertex.
3. The colour of a box is its RAD offset (reference absolute deadline minus release): the most
   urgent is red, the least urgent is blue, on a logarithmic scale over the whole task set.
4. Names are kept as they are. Each picture language escapes them itself.
"""

from __future__ import annotations

from collections.abc import Iterable
from colorsys import hls_to_rgb
from dataclasses import dataclass
import math
from pathlib import PurePath

from mddag_executor.core import Tables
from mddag_executor.report.text import format_ns
from msg_graph import TaskSet, Vertex
from msg_graph.model import path_lengths

MOST_LABELLED = 30
"""Maximum number of boxes of a picture with topics on its arrows."""
_RED, _BLUE = 0.0, 0.62
_MOST_IN_LEGEND = 12


@dataclass(frozen=True, slots=True)
class Box:
    """
    A vertex; arrows refer to its ``mark``.

    :ivar node: the name of its node.
    :ivar lines: callback, trigger if that is not a topic, a sink's deadline, requirements of the
        paths that end here.
    :ivar kind: ``timer``, ``subscription``, ``sync`` or ``service``.
    """

    mark: str
    node: str
    lines: tuple[str, ...]
    kind: str
    colour: str
    sink: bool


@dataclass(frozen=True, slots=True)
class DagFrame:
    """A DAG: its title with name and period, and the number of boxes of its longest path."""

    mark: str
    title: str
    boxes: tuple[Box, ...]
    depth: int


@dataclass(frozen=True, slots=True)
class Arrow:
    """A trigger edge, or a queue edge if ``queue`` is set; ``note`` names the message."""

    start: str
    end: str
    queue: bool
    note: str


@dataclass(frozen=True, slots=True)
class Picture:
    """A whole picture; ``legend`` has the colours and their RAD offsets, most urgent first."""

    title: str
    dags: tuple[DagFrame, ...]
    arrows: tuple[Arrow, ...]
    legend: tuple[tuple[str, str], ...]

    @property
    def boxes(self) -> tuple[Box, ...]:
        """Return the boxes of all DAGs."""
        return tuple(box for dag in self.dags for box in dag.boxes)


def picture(task_set: TaskSet) -> Picture:
    """Return the picture of a task set."""
    tables = Tables.build(task_set)
    offsets = tables.rad_offset[:len(task_set.vertices)]
    colours = _colours(offsets)
    ends: dict[str, list[str]] = {}
    for path in task_set.paths:
        if path.requirements:
            ends.setdefault(path.callbacks[-1], []).append(f'path {path.name}: ' + ', '.join(
                f'{what} {format_ns(time)}' for what, time in path.requirements.items()))
    dags = []
    for dag in task_set.dags:
        first = tables.first_vertex[dag.index]
        boxes = tuple(
            _box(vertex, colours[offset], ends.get(vertex.callback.key, ()))
            for vertex, offset in zip(
                dag.vertices, offsets[first:first + len(dag.vertices)]))
        dags.append(DagFrame(
            f'd{dag.index}', f'{dag.name}, every {format_ns(dag.period_ns)}', boxes,
            max(path_lengths(dag, [1] * len(boxes)))))
    return Picture(
        PurePath(task_set.file).name, tuple(dags),
        (*_trigger_arrows(task_set), *_queue_arrows(task_set)), _legend(colours))


def _mark(vertex: Vertex) -> str:
    return f'd{vertex.dag}v{vertex.index}'


def _box(vertex: Vertex, colour: str, ends: Iterable[str]) -> Box:
    callback = vertex.callback
    _, several, number = vertex.name[len(callback.key):].partition('#')
    lines = [callback.name + several + number]
    if callback.kind == 'timer' and callback.timer_period_ns is not None:
        lines.append(f'timer {format_ns(callback.timer_period_ns)}' + ', once' * callback.once)
    elif callback.driven_by is not None:
        lines.append(f'sync by {callback.driven_by}')
    elif callback.kind == 'sync':
        lines.append(f'sync of {len(callback.topics)}')
    elif callback.kind == 'service':
        lines.append(f'service {callback.service}')
    if vertex.deadline_ns is not None:
        lines.append(f'deadline {format_ns(vertex.deadline_ns)}')
    lines += ends
    return Box(_mark(vertex), callback.node, tuple(lines), callback.kind, colour,
               vertex.deadline_ns is not None)


def _colours(offsets: list[int]) -> dict[int, str]:
    """Return a light colour for each RAD offset."""
    known = sorted(set(offsets))
    low, high = math.log(known[0]), math.log(known[-1])
    colours = {}
    for offset in known:
        share = (math.log(offset) - low) / (high - low) if high > low else 0.5
        rgb = hls_to_rgb(_RED + (_BLUE - _RED) * share, 0.80, 0.85)
        colours[offset] = '#' + ''.join(f'{round(255 * part):02x}' for part in rgb)
    return colours


def _legend(colours: dict[int, str]) -> tuple[tuple[str, str], ...]:
    known = list(colours)
    if len(known) > _MOST_IN_LEGEND:
        step = (len(known) - 1) / (_MOST_IN_LEGEND - 1)
        known = [known[round(i * step)] for i in range(_MOST_IN_LEGEND)]
    return tuple((colours[offset], format_ns(offset)) for offset in known)


def _trigger_arrows(task_set: TaskSet) -> list[Arrow]:
    arrows = []
    for dag in task_set.dags:
        for start, end in dag.edges:
            before, after = dag.vertices[start], dag.vertices[end]
            topics = [topic for topic in after.callback.topics
                      if topic in before.callback.publishes]
            arrows.append(Arrow(_mark(before), _mark(after), False, ', '.join(topics)))
    return arrows


def _queue_arrows(task_set: TaskSet) -> list[Arrow]:
    vertices: dict[str, dict[int, list[Vertex]]] = {}
    for vertex in task_set.vertices:
        vertices.setdefault(vertex.callback.key, {}).setdefault(vertex.dag, []).append(vertex)
    arrows: list[Arrow] = []
    for edge in task_set.queue_edges:
        note = edge.topic or 'member variable'
        for writer in edge.writers:
            written = vertices[writer]
            first = next(iter(written.values()))[0]
            for dag, readers in vertices[edge.reader].items():
                start = written[dag][0] if dag in written else first
                arrows.extend(
                    Arrow(_mark(start), _mark(reader), True, note) for reader in readers)
    return arrows
