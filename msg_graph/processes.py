# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Which node runs in which process: ``processes:`` of a file of its own, and written anew.

In a text ``processes:`` is the last entry where it is written anew; comments outside of it, order
and all else stay.  The new text must give the same task set with just that changed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from msg_graph.declaration import processes_text, read_processes
from msg_graph.entries import Entry
from msg_graph.errors import GraphError
from msg_graph.language import FILE
from msg_graph.layout import checked
from msg_graph.model import Process, TaskSet
from msg_graph.yamltext import Mapping, parse_yaml


def load_processes(text: str, file: str, task_set: TaskSet) -> tuple[Process, ...]:
    """Return the processes that a file declares for a task set; its other keys do not count."""
    entry = Entry(parse_yaml(text, file) or Mapping(1), file, 'the file', FILE)
    processes = read_processes(entry, (callback.node for callback in task_set.callbacks))
    if not processes:
        raise GraphError(file, None, "there is no 'processes:'",
                         'write processes: {NAME: [/node, …], …}')
    return processes


def with_processes(task_set: TaskSet, processes: Iterable[Process]) -> TaskSet:
    """Return a task set, and its text, with other processes, which have all of its nodes."""
    order = {callback.node: i for i, callback in enumerate(reversed(task_set.callbacks))}
    processes = tuple(
        replace(each, nodes=tuple(sorted(each.nodes, key=lambda node: -order[node])))
        for each in processes)
    after = replace(task_set, processes=processes,
                    text=_changed(task_set.text, task_set.file, processes))
    checked(after.text, after)
    return after


def _changed(text: str, file: str, processes: tuple[Process, ...]) -> str:
    tree = parse_yaml(text, file)
    lines = text.splitlines(keepends=True)
    if isinstance(tree, Mapping) and 'processes' in tree.entries:
        begin = tree.key_lines['processes'] - 1
        later = [line - 1 for line in tree.key_lines.values() if line - 1 > begin]
        del lines[begin:min(later, default=len(lines))]
    if lines and not lines[-1].endswith('\n'):
        lines[-1] += '\n'
    return ''.join(lines) + processes_text(processes)
