# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
YAML text to a tree of plain values that know their lines.

Theory of operation
-------------------
The tree is built from the parser's events, not by PyYAML's composer or constructor:

1. It never recurses, so no nesting can overflow the stack; nesting beyond ``MAX_DEPTH`` ends it.
2. Scalars stay text. What a text means is decided by the key it stands at, so that ``on``, ``1e3``
   or ``2026-01-01`` are never turned into something that nobody wrote.
3. An alias shares the tree of its anchor. Every tree knows its size with all aliases written out;
   beyond ``MAX_SIZE`` the file is refused, so that nested aliases cannot explode. An alias inside
   of its own anchor is refused.
4. Duplicate keys, explicit tags and a second document are errors, not surprises.
"""

from __future__ import annotations

import re
from typing import Any

from msg_graph.errors import GraphError, shown
import yaml

MAX_BYTES = 16 * 1024 * 1024
MAX_DEPTH = 32
MAX_SIZE = 2_000_000

_LOADER: Any = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
_NOT_YAML = re.compile('[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]')
_PLAIN_TAGS = (None, '!')
_PLAIN = re.compile(r'[/A-Za-z_][/A-Za-z0-9_.-]*')
_SIMPLE = re.compile(r'[+-]?[A-Za-z0-9_/.][A-Za-z0-9_/. +-]*')
_WORDS = {'true', 'false', 'yes', 'no', 'on', 'off', 'null', 'y', 'n'}


class Scalar:
    """A text; ``plain`` if it stands there without quotes."""

    __slots__ = ('line', 'text', 'plain')
    size = 1

    def __init__(self, line: int, text: str, plain: bool) -> None:
        self.line = line
        self.text = text
        self.plain = plain

    @property
    def is_null(self) -> bool:
        """Whether nothing stands here."""
        return self.plain and self.text in ('', '~', 'null')


class Sequence:
    """A list of trees."""

    __slots__ = ('line', 'items', 'size')

    def __init__(self, line: int) -> None:
        self.line = line
        self.items: list[Tree] = []
        self.size = 1

    def with_items(self, items: list[Tree]) -> Sequence:
        """Return a list in the same place with as many other items."""
        result = Sequence(self.line)
        result.items, result.size = items, self.size
        return result


class Mapping:
    """Trees by key, in file order, and the line of each key."""

    __slots__ = ('line', 'entries', 'key_lines', 'size')

    def __init__(self, line: int) -> None:
        self.line = line
        self.entries: dict[str, Tree] = {}
        self.key_lines: dict[str, int] = {}
        self.size = 1

    def with_entries(self, entries: dict[str, Tree]) -> Mapping:
        """Return a mapping in the same place with other values of its keys."""
        result = Mapping(self.line)
        result.entries, result.key_lines, result.size = entries, self.key_lines, self.size
        return result


Tree = Scalar | Sequence | Mapping


def decode(data: bytes, file: str) -> str:
    """Return the text of a file."""
    if len(data) > MAX_BYTES:
        raise GraphError(
            file, None, f'the file is larger than {MAX_BYTES // 1024 ** 2} MiB',
            'is this the declaration? Split it into several graphs')
    try:
        return data.decode('utf-8')
    except UnicodeDecodeError as error:
        line = data.count(b'\n', 0, error.start) + 1
        raise GraphError(
            file, line, f'byte {error.start} is not UTF-8 text',
            'give a YAML file in UTF-8') from None


def plain_scalar(text: str) -> str:
    """Return a name (without quotes in it) that stands for itself, quoted where it would not."""
    return text if _PLAIN.fullmatch(text) and text.lower() not in _WORDS else f"'{text}'"


def yaml_lines(tree: Tree) -> list[str]:
    """Return the lines of a text that gives an equal tree; its texts have one line each."""
    if isinstance(tree, Scalar):
        simple = tree.plain and _SIMPLE.fullmatch(tree.text)
        return [tree.text if simple else "'" + tree.text.replace("'", "''") + "'"]
    if isinstance(tree, Sequence) and all(isinstance(item, Scalar) for item in tree.items):
        return [f'[{", ".join(line for item in tree.items for line in yaml_lines(item))}]']
    lines = []
    if isinstance(tree, Sequence):
        for item in tree.items:
            first, *rest = yaml_lines(item)
            lines += [f'- {first}', *(f'  {line}' for line in rest)]
        return lines
    for key, value in tree.entries.items():
        first, *rest = yaml_lines(value)
        if isinstance(value, Mapping) or first.startswith('- '):
            lines += [f'{key}:', f'  {first}', *(f'  {line}' for line in rest)]
        else:
            lines.append(f'{key}: {first}')
    return lines


def parse_yaml(text: str, file: str) -> Tree | None:
    """Return the tree of the one document in ``text``, or None where there is none."""
    text = text[1:] if text.startswith('\ufeff') else text
    strange = _NOT_YAML.search(text)
    if strange is not None:
        raise GraphError(
            file, text.count('\n', 0, strange.start()) + 1,
            f'the file holds the character {shown(strange.group())}, so it is not YAML',
            'give the YAML file of a declaration')
    if len(text.encode()) > MAX_BYTES:
        decode(text.encode(), file)
    builder = _Builder(file)
    try:
        for event in yaml.parse(text, Loader=_LOADER):
            builder.add(event)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        what = error.problem or error.context or 'it cannot be parsed'
        raise GraphError(
            file, None if mark is None else mark.line + 1, f'not YAML: {what}',
            'check indentation, brackets and quotes') from None
    except yaml.YAMLError as error:
        raise GraphError(file, None, f'not YAML: {error}', 'give a YAML file') from None
    return builder.root


class _Builder:
    """Builds the tree from parser events, keeping the containers that are open on a stack."""

    def __init__(self, file: str) -> None:
        self.root: Tree | None = None
        self._file = file
        self._stack: list[Sequence | Mapping] = []
        self._keys: list[str | None] = []  # of each open mapping the key without a value yet
        self._anchors: dict[str, Tree] = {}

    def add(self, event: Any) -> None:
        """Take the parser's next event."""
        kind = type(event)
        if kind is yaml.ScalarEvent:
            scalar = Scalar(event.start_mark.line + 1, event.value, not event.style)
            self._anchor(event, scalar)
            self._attach(event, scalar, 1)
        elif kind is yaml.AliasEvent:
            self._alias(event)
        elif kind is yaml.SequenceStartEvent:
            self._open(event, Sequence(event.start_mark.line + 1))
        elif kind is yaml.MappingStartEvent:
            self._open(event, Mapping(event.start_mark.line + 1))
        elif kind is yaml.SequenceEndEvent or kind is yaml.MappingEndEvent:
            self._close(event)
        elif kind is yaml.DocumentStartEvent and self.root is not None:
            raise self._error(
                event, 'a second YAML document starts here', 'keep one document in the file')

    def _error(self, event: Any, problem: str, remedy: str) -> GraphError:
        return GraphError(self._file, event.start_mark.line + 1, problem, remedy)

    def _anchor(self, event: Any, tree: Tree) -> None:
        """Look at the properties that may stand before a value."""
        if event.tag not in _PLAIN_TAGS:
            raise self._error(
                event, f'the tag {shown(event.tag)} has no meaning here', 'remove the tag')
        if event.anchor is not None:
            self._anchors[event.anchor] = tree

    def _alias(self, event: Any) -> None:
        name = shown(event.anchor)
        tree = self._anchors.get(event.anchor)
        if tree is None:
            raise self._error(
                event, f'the alias {name} has no anchor', 'define the anchor before it')
        if any(tree is each for each in self._stack):
            raise self._error(
                event, f'the alias {name} stands inside of its own anchor', 'write the value out')
        self._attach(event, tree, tree.size)

    def _open(self, event: Any, tree: Sequence | Mapping) -> None:
        self._anchor(event, tree)
        self._attach(event, tree, 0)  # its size is known when it closes
        self._stack.append(tree)
        self._keys.append(None)
        if len(self._stack) > MAX_DEPTH:
            raise self._error(
                event, f'more than {MAX_DEPTH} levels of nesting',
                'check the brackets: a declaration needs fewer than ten levels')

    def _close(self, event: Any) -> None:
        tree = self._stack.pop()
        self._keys.pop()
        if self._stack:
            self._grow(event, self._stack[-1], tree.size)

    def _attach(self, event: Any, tree: Tree, size: int) -> None:
        """Hang a tree below the innermost open container."""
        if not self._stack:
            self.root = tree
            return
        parent = self._stack[-1]
        self._grow(event, parent, size)
        if type(parent) is Sequence:
            parent.items.append(tree)
        elif type(parent) is Mapping:
            key = self._keys[-1]
            if key is None:
                self._keys[-1] = self._key(event, parent, tree)
            else:
                parent.entries[key] = tree
                self._keys[-1] = None

    def _key(self, event: Any, parent: Mapping, tree: Tree) -> str:
        if not isinstance(tree, Scalar):
            raise self._error(event, 'a key is a list or a mapping', 'write a plain word as key')
        if tree.text in parent.entries:
            raise self._error(
                event, f'the key {shown(tree.text)} stands here twice',
                f'remove one of them (the first is in line {parent.key_lines[tree.text]})')
        parent.key_lines[tree.text] = event.start_mark.line + 1
        return tree.text

    def _grow(self, event: Any, parent: Sequence | Mapping, size: int) -> None:
        """Count what a container gets, with aliases written out."""
        parent.size += size
        if parent.size > MAX_SIZE:
            raise self._error(
                event, f'more than {MAX_SIZE} entries (aliases count as often as they are used)',
                'remove the aliases, or split the file into several graphs')
