# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Declarations in normal form: the same text, evenly indented, with its comments.

Theory of operation
-------------------
1. Only the layout changes: indentation, spaces, the breaks of long lines, blank lines at the ends.
   Keys, entries, quotes and comments keep their order, as the order of entries counts for ties and
   comments belong to where they stand.
2. The text must be a declaration before, and give an equal task set after; else it is left alone,
   with an error. Lines are the one thing that may differ.
3. The normal form of a normal form is itself.
4. No comment is ever left out: a text in which that cannot be had is left alone, too. (ruamel.yaml
   drops comments in brackets, and its older versions those ahead of a list that is not indented;
   the latter is tried once more with the list indented.)
5. ruamel.yaml breaks no lines, as each version does it in another way; this module does.
6. A file with ``include:`` or ``arguments:`` is one part of a declaration only. Of it all values
   must be equal after; whether it is right, the whole declaration shows.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
import io
import re
import sys

from msg_graph.errors import GraphError
from msg_graph.include import is_composed, top_of
from msg_graph.loading import loads
from msg_graph.model import Callback, Dag, TaskSet
from msg_graph.yamltext import Scalar, Sequence, Tree
import yaml

WIDTH = 87
"""A line with brackets is broken ahead of the item that would pass this column."""


def format_text(text: str, name: str = '<string>') -> str:
    """
    Return a declaration in normal form.

    :param name: what errors call it.
    :raises GraphError: it is no declaration, or it cannot be laid out anew without a change of
        its meaning.
    """
    before = _meaning(text, name)
    result = text
    for _ in range(3):  # a comment that moves may make room for one more change
        last, result = result, _with_comments(result, name)
        if result == last:
            break
    else:
        raise refused(name)
    try:
        after = _meaning(result, name)
    except GraphError:
        raise refused(name) from None
    if before != after:
        raise refused(name)
    return result


def _meaning(text: str, name: str) -> object:
    """Return what must stay the same: the task set, or all that stands in the text (rule 6)."""
    tree, top = top_of(text, name)
    return _plain(tree) if is_composed(top) else without_lines(loads(text, name))


def _plain(tree: Tree) -> object:
    if isinstance(tree, Scalar):
        return tree.text, tree.plain
    if isinstance(tree, Sequence):
        return [_plain(item) for item in tree.items]
    return [(key, _plain(value)) for key, value in tree.entries.items()]


def refused(name: str) -> GraphError:
    """Return the error about a text that cannot be written anew."""
    return GraphError(name, None, 'its layout cannot be changed without a change of its meaning',
                      'write anchors, quotes and multi-line texts more plainly')


def _with_comments(text: str, name: str) -> str:
    """Return the text laid out anew, with the comments that it has (rule 4)."""
    try:
        comments = _comments(text)
        for indent in (False, True):
            result = _broken(_laid_out(_indented(text) if indent else text, name))
            if _comments(result) == comments:
                return result
    except yaml.YAMLError:
        raise refused(name) from None
    raise GraphError(name, None, 'its layout cannot be changed without the loss of a comment',
                     'write the comments that stand inside of brackets above or below them')


def _comments(text: str) -> list[str]:
    """Return the comments: what stands between two tokens, from a ``#`` on."""
    result: list[str] = []
    end = 0
    for token in yaml.scan(text, yaml.SafeLoader):
        gap = text[end:token.start_mark.index]
        result += (comment.rstrip() for comment in re.findall('#.*', gap))
        end = max(end, token.end_mark.index)
    return result


def _indented(text: str) -> str:
    """Return the text with lists that stand in the column of their keys two columns deeper."""
    lines = text.splitlines()
    shifts = Counter[int]()
    starts: list[tuple[int, int]] = []  # of what is open: line and column
    for event in yaml.parse(text, yaml.SafeLoader):
        mark = event.start_mark
        if mark is None:
            continue
        if isinstance(event, yaml.CollectionStartEvent):
            starts.append((mark.line, mark.column))
        elif isinstance(event, yaml.CollectionEndEvent):
            first, column = starts.pop()
            if (isinstance(event, yaml.SequenceEndEvent) and starts
                    and starts[-1][1] == column and starts[-1][0] < first):
                shifts.update(range(first, mark.line + (mark.column > column)))
    ends = _ends(text)
    for index, times in shifts.items():
        content, rest = lines[index][:ends.get(index)], lines[index][ends.get(index, 0):]
        if content.strip() and content.lstrip()[0] != '#':
            if not rest.lstrip().startswith('#') or index not in ends:
                lines[index] = '  ' * times + lines[index]
            else:  # a comment stays in its column, if there is room
                room = len(rest) - len(rest.lstrip())
                lines[index] = (
                    '  ' * times + content + ' ' * max(2, room - 2 * times) + rest.lstrip())
    return '\n'.join(lines) + '\n'


def _ends(text: str) -> dict[int, int]:
    """Return the column at which the content of a line ends, for each with the end of a token."""
    ends: dict[int, int] = {}
    for token in yaml.scan(text, yaml.SafeLoader):
        if token.end_mark.index > token.start_mark.index:
            mark = token.end_mark
            ends[mark.line] = max(ends.get(mark.line, 0), mark.column)
    return ends


def _broken(text: str) -> str:
    """Return the text with lines broken after commas in brackets, where they are too long."""
    lines = text.splitlines()
    if all(len(line) <= WIDTH for line in lines):
        return text
    commas: dict[int, list[int]] = {}
    inside: set[int] = set()  # lines that begin in brackets
    depth = last = 0
    for token in yaml.scan(text, yaml.SafeLoader):
        mark = token.end_mark
        if depth:
            inside.update(range(last + 1, mark.line + 1))
        last = mark.line
        if isinstance(token, yaml.FlowEntryToken):
            commas.setdefault(mark.line, []).append(mark.column)
        depth += isinstance(token, (yaml.FlowSequenceStartToken, yaml.FlowMappingStartToken))
        depth -= isinstance(token, (yaml.FlowSequenceEndToken, yaml.FlowMappingEndToken))
    ends = _ends(text)
    result: list[str] = []
    for index, line in enumerate(lines):
        places = [column for column in commas.get(index, []) if column < ends[index]]
        result += _pieces(line, ends.get(index, 0), places, index in inside)
    return '\n'.join(result) + '\n'


def _pieces(line: str, end: int, places: list[int], inside: bool) -> list[str]:
    """Return a line, whose content ends at a column, broken at some of the places."""
    start = len(line) - len(line.lstrip(' -' if not inside else ' '))
    indent = ' ' * (start if inside else start + 2)
    result: list[str] = []
    begin = shift = 0  # of the piece: where it begins in the line, its indent less that
    while end + shift > WIDTH and (later := [place for place in places if place > begin]):
        fitting = [place for place in later if place + shift <= WIDTH]
        place = fitting[-1] if fitting else later[0]
        result.append((indent if begin else '') + line[begin:place])
        begin = place + len(line[place:]) - len(line[place:].lstrip())
        shift = len(indent) - begin
    result.append((indent if begin else '') + line[begin:])
    return result


def _laid_out(text: str, name: str) -> str:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError
    writer = YAML(typ='rt')
    writer.preserve_quotes = True
    writer.width = sys.maxsize  # rule 5
    writer.indent(mapping=2, sequence=4, offset=2)
    stream = io.StringIO()
    try:
        writer.dump(writer.load(text), stream)
    except (YAMLError, ValueError, NotImplementedError):
        raise refused(name) from None
    lines = [line.rstrip() for line in stream.getvalue().strip('\n').splitlines()]
    return '\n'.join(lines) + '\n'


def without_lines(task_set: TaskSet) -> TaskSet:
    """Return the task set with everything left out that tells where in the text it stood."""
    callbacks = {callback.key: replace(callback, line=0) for callback in task_set.callbacks}
    return replace(
        task_set, text='', callbacks=tuple(callbacks.values()),
        dags=tuple(_dag_without_lines(dag, callbacks) for dag in task_set.dags))


def _dag_without_lines(dag: Dag, callbacks: dict[str, Callback]) -> Dag:
    return replace(dag, vertices=tuple(
        replace(vertex, callback=callbacks[vertex.callback.key]) for vertex in dag.vertices))
