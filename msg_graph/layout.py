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
4. No comment is ever left out: a text with comments in brackets is left alone, too. A comment
   behind an entry keeps its column, if there is room. One on a line of its own is indented as the
   entry below it, or, where it stood deeper than that, as the entries of the list or mapping above
   that it belongs to.
5. A file with ``include:`` or ``arguments:`` is one part of a declaration only. Of it all values
   must be equal after; whether it is right, the whole declaration shows.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from msg_graph.declaration import is_composed, top_of
from msg_graph.derive import loads
from msg_graph.errors import GraphError
from msg_graph.model import TaskSet
from msg_graph.yamltext import Scalar, Sequence, Tree
import yaml

WIDTH = 87
"""A line with brackets is broken ahead of the item that would pass this column."""


def format_text(text: str, name: str = '<string>') -> str:
    """
    Return a declaration in normal form.

    :param name: what errors call it.
    """
    before = _meaning(text, name)
    writer = _Writer(text.lstrip('\ufeff'), name)
    writer.write()
    result = '\n'.join(writer.lines).strip('\n') + '\n'
    try:
        if _meaning(result, name) == before:
            return result
    except GraphError:
        pass
    raise refused(name)


def _meaning(text: str, name: str) -> object:
    """Return what must stay the same: the task set, or all that stands in the text (rule 5)."""
    tree, top = top_of(text, name)
    return _plain(tree) if is_composed(top) else without_lines(loads(text, name))


def _plain(tree: Tree) -> object:
    if isinstance(tree, Scalar):
        return tree.text, tree.plain
    if isinstance(tree, Sequence):
        return [_plain(item) for item in tree.items]
    return [(key, _plain(value)) for key, value in tree.entries.items()]


def refused(name: str, comment: bool = False) -> GraphError:
    """Return the error about a text that cannot be written anew; for a comment's sake, perhaps."""
    if comment:
        return GraphError(
            name, None, 'its layout cannot be changed without the loss of a comment',
            'write the comments that stand inside of brackets above or below them')
    return GraphError(name, None, 'its layout cannot be changed without a change of its meaning',
                      'write anchors, quotes and multi-line texts more plainly')


_Comment = tuple[int, int, str]
"""Line, column and text; a blank line has no text."""


class _Writer:
    """
    Writes the parser's events as text again.

    ``_open`` has of each list and mapping in which the next entry may stand its column in the old
    and in the new text, ``_above`` the same for the last line that was written.
    """

    def __init__(self, text: str, name: str) -> None:
        self.lines: list[str] = []
        self._text = text
        self._name = name
        self._line = ''
        self._last = -1  # line of the old text that the line being written comes from
        self._behind: list[_Comment] = []
        self._alone: list[_Comment] = []
        self._open: list[tuple[int, int]] = []
        self._above: list[tuple[int, int]] = []
        self._find_comments()
        self._events: Any = yaml.parse(text, yaml.SafeLoader)

    def _find_comments(self) -> None:
        """Find what stands between two tokens."""
        end = depth = line = column = 0
        for token in yaml.scan(self._text, yaml.SafeLoader):
            gap = self._text[end:token.start_mark.index]
            if depth and '#' in gap:
                raise refused(self._name, comment=True)
            parts = gap.split('\n')
            for number, part in enumerate(parts):
                text = part.strip()
                indent = len(part) - len(part.lstrip())
                if number == 0 and text and end:
                    self._behind.append((line, column + indent, text))
                elif not depth and (text or 0 < number < len(parts) - 1):
                    self._alone.append((line + number, indent, text))
            if token.end_mark.index > end:
                end = token.end_mark.index
                line, column = token.end_mark.line, token.end_mark.column
            depth += isinstance(token, (yaml.FlowSequenceStartToken, yaml.FlowMappingStartToken))
            depth -= isinstance(token, (yaml.FlowSequenceEndToken, yaml.FlowMappingEndToken))

    def write(self) -> None:
        """Write all lines."""
        for event in self._events:
            mark: Any = event.start_mark
            if isinstance(event, yaml.DocumentStartEvent) and event.explicit:
                self._begin(0, mark.line, 0)
                self._line = self._source(event)
            elif isinstance(event, yaml.NodeEvent):
                self._value(event, -2)
        self._begin(0, len(self._text), 0)
        if self._behind or self._alone:
            raise refused(self._name, comment=True)

    def _begin(self, indent: int, line: int, column: int) -> None:
        """End a line, and begin one for what stands in the old text at a line and column."""
        while self._behind and self._behind[0][0] <= self._last:
            _, at, text = self._behind.pop(0)
            at = at - 2 if at + len(text) <= WIDTH else 0
            self._line = f'{self._line.rstrip():<{at}}  {text}'
        if self._last >= 0:
            self.lines.append(self._line.rstrip())
        while self._alone and self._alone[0][0] < line:
            _, at, text = self._alone.pop(0)
            deeper = [new for old, new in self._above if column < old <= at]
            self.lines.append(text and ' ' * (deeper[-1] if deeper else indent) + text)
        self._line = ' ' * indent
        self._above = list(self._open)

    def _source(self, event: Any) -> str:
        """Return how a text or an alias is written, with its anchor."""
        text: str = self._text[event.start_mark.index:event.end_mark.index]
        if '\n' in text:
            raise refused(self._name)
        self._last = event.end_mark.line
        return text

    def _value(self, event: Any, indent: int) -> None:
        """Write a value behind what stands on the line; its entries are indented by two more."""
        if isinstance(event, (yaml.ScalarEvent, yaml.AliasEvent)):
            self._line += self._source(event)
        elif event.flow_style:
            self._fill(self._pieces(event))
        else:
            if event.anchor:
                self._line += f'&{event.anchor}'
            self._entries(event, indent + 2)

    def _entries(self, event: Any, indent: int) -> None:
        """Write the entries of a list or mapping, the first one perhaps on the line of a dash."""
        is_list = isinstance(event, yaml.SequenceStartEvent)
        column = event.start_mark.column
        self._open.append((column, indent))
        inline = self._line == ' ' * (indent - 2) + '- '
        self._above = list(self._open)
        while not isinstance(entry := next(self._events), yaml.CollectionEndEvent):
            if not inline:
                self._begin(indent, entry.start_mark.line, column)
            inline = False
            if is_list:
                self._line += '- '
                self._value(entry, indent)
            else:
                self._line += self._source(entry) + ': '
                self._value(next(self._events), indent)
        self._open.pop()

    def _pieces(self, event: Any) -> list[str]:
        """Return a value in brackets in pieces between which a line may break."""
        if isinstance(event, (yaml.ScalarEvent, yaml.AliasEvent)):
            return [self._source(event)]
        is_list = isinstance(event, yaml.SequenceStartEvent)
        pieces = [f'&{event.anchor} ' if event.anchor else '']
        pieces[0] += '[' if is_list else '{'
        while not isinstance(entry := next(self._events), yaml.CollectionEndEvent):
            first, *rest = self._pieces(entry if is_list else next(self._events))
            if not is_list:
                first = f'{self._source(entry)}: {first}'
            if len(pieces) == 1 and pieces[0][-1] in '[{':
                pieces[0] += first
            else:
                pieces[-1] += ','
                pieces.append(first)
            pieces += rest
        pieces[-1] += ']' if is_list else '}'
        self._source(entry)
        return pieces

    def _fill(self, pieces: list[str]) -> None:
        """Write a value in brackets, in several lines if need be."""
        indent = len(self._line) - len(self._line.lstrip(' -')) + 2
        self._line += pieces[0]
        for piece in pieces[1:]:
            if len(self._line) + 1 + len(piece) > WIDTH:
                self.lines.append(self._line)
                self._line = ' ' * indent + piece
            else:
                self._line += f' {piece}'


def without_lines(task_set: TaskSet) -> TaskSet:
    """Return the task set without the places in the text."""
    nowhere = {callback.key: {'line': 0, 'file': None} for callback in task_set.callbacks}
    return replace(task_set.with_callbacks(nowhere), text='')
