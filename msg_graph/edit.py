# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
New deadlines of sinks and new ``processes:``, in the text of a declaration and its task set.

Theory of operation
-------------------
1. Deadlines belong to callbacks: all vertices of a callback have its deadline.
2. In the text only the values of ``deadline:`` change; a callback without one gets a new line, or
   a new entry in its braces.  New ``processes:`` are the last entry.  Comments outside of it,
   order, layout and the ends of lines stay.
3. The new text must give the task set with only that change; else an error is raised.  (A value
   may be an alias of another one.)
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from collections.abc import Mapping as Table
from dataclasses import replace
from typing import Any

from msg_graph.declaration import processes_text, read_processes
from msg_graph.derive import loads
from msg_graph.duration import exact_duration, SECOND
from msg_graph.errors import GraphError
from msg_graph.language import Entry, FILE
from msg_graph.model import Process, TaskSet
from msg_graph.yamltext import Mapping, parse_yaml
import yaml

_LOADER: Any = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)


def checked(text: str, wanted: TaskSet) -> str:
    """Return a changed text; raise if it does not give the wanted task set."""
    try:
        same = without_lines(loads(text, wanted.file)) == without_lines(wanted)
    except GraphError:
        same = False
    if not same:
        raise _refused(wanted.file)
    return text


def without_lines(task_set: TaskSet) -> TaskSet:
    """Return the task set without line numbers."""
    nowhere = {callback.key: {'line': 0, 'file': None} for callback in task_set.callbacks}
    return replace(task_set.with_callbacks(nowhere), text='')


def _refused(name: str) -> GraphError:
    return GraphError(name, None, 'the file cannot be edited automatically',
                      'write anchors, quotes and multi-line texts more plainly')


def load_with_or_without_deadlines(text: str, name: str, path: str | None = None) -> TaskSet:
    """Return the task set of a declaration, see ``loads``; sinks without a deadline get 1 s."""
    missing: list[str] = []
    task_set = loads(text, name, path, without_deadline=missing)
    return with_deadlines(task_set, dict.fromkeys(missing, SECOND))


def deadlines_in_text(task_set: TaskSet, deadlines: Table[str, int]) -> str:
    """Return the text of a declaration with other deadlines (by key, ns)."""
    return checked(_with_deadlines(task_set.text, deadlines), with_deadlines(task_set, deadlines))


def callbacks_of(declaration: Any) -> Iterator[tuple[str, Any, dict[str, Any]]]:
    """Yield the key of each callback, its YAML node, and the nodes of its values."""
    for node in _entries(declaration)['nodes'].value:
        of_node = _entries(node)
        for callback in of_node['callbacks'].value:
            entries = _entries(callback)
            yield f'{of_node["node"].value}:{entries["name"].value}', callback, entries


def _entries(node: Any) -> dict[str, Any]:
    return {key.value: value for key, value in node.value}


def _with_deadlines(text: str, deadlines: Table[str, int]) -> str:
    lines = text.splitlines(keepends=True)
    edits: list[tuple[int, int, int, str]] = []  # line, from column, to column, new text
    for key, callback, entries in callbacks_of(yaml.compose(text, _LOADER)):
        if key not in deadlines:
            continue
        value = exact_duration(deadlines[key])
        if 'deadline' in entries:
            begin, end = entries['deadline'].start_mark, entries['deadline'].end_mark
            edits.append((begin.line, begin.column, end.column, value))
        elif callback.flow_style:
            end = callback.value[0][1].end_mark  # after the first entry
            edits.append((end.line, end.column, end.column, f', deadline: {value}'))
        else:
            # Before the second key, which begins a line; preferably before a later one.
            begin = callback.value[min(2, len(callback.value) - 1)][0].start_mark
            line = ' ' * begin.column + f'deadline: {value}{_line_end(text)}'
            edits.append((begin.line, 0, 0, line))
    for row, first, last, new in sorted(edits, reverse=True):
        lines[row] = lines[row][:first] + new + lines[row][last:]
    return ''.join(lines)


def with_deadlines(task_set: TaskSet, deadlines: Table[str, int]) -> TaskSet:
    """Return a task set with other deadlines of sinks, by the callback's key, ns."""
    return task_set.with_callbacks({key: {'deadline_ns': ns} for key, ns in deadlines.items()})


def load_processes(text: str, file: str, task_set: TaskSet) -> tuple[Process, ...]:
    """Return the processes that a file declares for a task set; its other keys are ignored."""
    entry = Entry(parse_yaml(text, file) or Mapping(file, 1), 'the file', FILE)
    processes = read_processes(entry, (callback.node for callback in task_set.callbacks))
    if not processes:
        raise GraphError(file, None, "there is no 'processes:'",
                         'write processes: {NAME: [/node, …], …}')
    return processes


def with_processes(task_set: TaskSet, processes: Iterable[Process]) -> TaskSet:
    """Return a task set, and its text, with other processes, which contain all of its nodes."""
    order = {callback.node: i for i, callback in enumerate(reversed(task_set.callbacks))}
    processes = tuple(
        replace(each, nodes=tuple(sorted(each.nodes, key=lambda node: -order[node])))
        for each in processes)
    after = replace(task_set, processes=processes,
                    text=_with_entry(task_set.text, task_set.file, processes))
    checked(after.text, after)
    return after


def _with_entry(text: str, file: str, processes: tuple[Process, ...]) -> str:
    tree = parse_yaml(text, file)
    lines = text.splitlines(keepends=True)
    if isinstance(tree, Mapping) and 'processes' in tree.entries:
        begin = tree.key_lines['processes'] - 1
        end = min((line - 1 for line in tree.key_lines.values() if line - 1 > begin),
                  default=len(lines))
        while not lines[end - 1].partition('#')[0].strip():     # comments on what follows
            end -= 1
        del lines[begin:end]
    line_end = _line_end(text)
    if lines and not lines[-1].endswith('\n'):
        lines[-1] += line_end
    return ''.join(lines) + processes_text(processes).replace('\n', line_end)


def _line_end(text: str) -> str:
    """Return what the lines of a text end with."""
    return '\r\n' if '\r\n' in text else '\n'
