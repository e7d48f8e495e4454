# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
YAML text to a tree of plain values with their files and lines.

Theory of operation
-------------------
The tree is built from the parser's events, not by PyYAML's composer or constructor:

1. Nesting beyond ``MAX_DEPTH`` is refused, so the stack cannot overflow.
2. Scalars stay text. Their key decides their meaning, so ``on``, ``1e3`` or ``2026-01-01`` are not
   converted.
3. An alias shares the tree of its anchor. Every tree knows its size with all aliases expanded; a
   file beyond ``MAX_SIZE`` is refused, so nested aliases cannot explode. An alias inside of its
   own anchor is refused.
4. Duplicate keys, explicit tags and a second document are errors.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import re
from typing import Any, ClassVar

from msg_graph.errors import GraphError, quoted
import yaml

MAX_BYTES = 16 * 1024 * 1024
_MCAP = b'\x89MCAP'
MAX_DEPTH = 32
MAX_SIZE = 2_000_000

_LOADER: Any = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
_NOT_YAML = re.compile('[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]')
_PLAIN_TAGS = (None, '!')
_ENDS = (yaml.SequenceEndEvent, yaml.MappingEndEvent)
_PLAIN = re.compile(r'[/A-Za-z_][/A-Za-z0-9_.-]*')
_WORDS = {'true', 'false', 'yes', 'no', 'on', 'off', 'null', 'y', 'n'}


@dataclass(eq=False, slots=True)
class Scalar:
    """A text; ``is_plain`` if it is written without quotes."""

    file: str
    line: int
    text: str
    is_plain: bool = True
    size: ClassVar[int] = 1

    @property
    def is_null(self) -> bool:
        """Return whether the value is empty."""
        return self.is_plain and self.text in ('', '~', 'null')


@dataclass(eq=False, slots=True)
class Sequence:
    """A list of trees."""

    file: str
    line: int
    items: list[Tree] = field(default_factory=list)
    size: int = 1


@dataclass(eq=False, slots=True)
class Mapping:
    """Trees by key, in file order, and the line of each key."""

    file: str
    line: int
    entries: dict[str, Tree] = field(default_factory=dict)
    key_lines: dict[str, int] = field(default_factory=dict)
    size: int = 1


Tree = Scalar | Sequence | Mapping


def decode(data: bytes, file: str) -> str:
    """Return the text of a file."""
    if len(data) > MAX_BYTES:
        raise GraphError(
            file, None, f'the file is larger than {MAX_BYTES // 1024 ** 2} MiB',
            'is this the declaration? Split it into several graphs')
    if data.startswith(_MCAP):
        raise GraphError(
            file, None, 'this is a recording, and a declaration is needed here',
            'give a YAML file; for several traces of one run, give the folder that has them')
    try:
        return data.decode('utf-8')
    except UnicodeDecodeError as error:
        line = data.count(b'\n', 0, error.start) + 1
        raise GraphError(
            file, line, f'byte {error.start} is not UTF-8 text',
            'give a YAML file in UTF-8') from None


def plain(tree: Tree | None) -> Any:
    """Return a tree as lists, dictionaries and texts; empty values are None."""
    if isinstance(tree, Mapping):
        return {key: plain(value) for key, value in tree.entries.items()}
    if isinstance(tree, Sequence):
        return [plain(item) for item in tree.items]
    return None if tree is None or tree.is_null else tree.text


def plain_scalar(text: str) -> str:
    """Return a name (without quotes in it), quoted if YAML would read it as another type."""
    return text if _PLAIN.fullmatch(text) and text.lower() not in _WORDS else f"'{text}'"


def parse_yaml(text: str, file: str) -> Tree | None:
    """Return the tree of the one document in ``text``, or None if there is none."""
    text = text[1:] if text.startswith('\ufeff') else text
    strange = _NOT_YAML.search(text)
    if strange is not None:
        raise GraphError(
            file, text.count('\n', 0, strange.start()) + 1,
            f'the file holds the character {quoted(strange.group())}, so it is not YAML',
            'give the YAML file of a declaration')
    if len(text.encode()) > MAX_BYTES:
        decode(text.encode(), file)
    try:
        return _Builder(text, file).document()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        what = error.problem or error.context or 'it cannot be parsed'
        raise GraphError(
            file, None if mark is None else mark.line + 1, f'not YAML: {what}',
            'check indentation (by blanks, not tabs), brackets and quotes') from None
    except yaml.YAMLError as error:
        raise GraphError(file, None, f'not YAML: {error}', 'give a YAML file') from None


class _Builder:
    """Builds the tree from the parser's events; its nesting is bounded."""

    def __init__(self, text: str, file: str) -> None:
        self._events: Any = yaml.parse(text, Loader=_LOADER)
        self._file = file
        self._open: list[Tree] = []
        self._anchors: dict[str, Tree] = {}

    def document(self) -> Tree | None:
        """Return the tree of the one document."""
        root: Tree | None = None
        for event in self._events:
            if isinstance(event, yaml.DocumentStartEvent) and root is not None:
                raise self._error(
                    event, 'a second YAML document starts here', 'keep one document in the file')
            if isinstance(event, yaml.NodeEvent):
                root = self._tree(event)
        return root

    def _error(self, event: Any, problem: str, remedy: str) -> GraphError:
        return GraphError(self._file, event.start_mark.line + 1, problem, remedy)

    def _tree(self, event: Any) -> Tree:
        """Return the tree that begins with an event."""
        kind = type(event)
        if kind is yaml.AliasEvent:
            return self._anchored(event)
        if event.tag not in _PLAIN_TAGS:
            raise self._error(
                event, f'the tag {quoted(event.tag)} has no meaning here', 'remove the tag')
        line = event.start_mark.line + 1
        if kind is yaml.ScalarEvent:
            scalar = Scalar(self._file, line, event.value, not event.style)
            if event.anchor is not None:
                self._anchors[event.anchor] = scalar
            return scalar
        tree = (Sequence if kind is yaml.SequenceStartEvent else Mapping)(self._file, line)
        if event.anchor is not None:
            self._anchors[event.anchor] = tree
        self._open.append(tree)
        if len(self._open) > MAX_DEPTH:
            raise self._error(
                event, f'more than {MAX_DEPTH} levels of nesting',
                'check the brackets: a declaration needs fewer than ten levels')
        self._fill(tree)
        self._open.pop()
        return tree

    def _anchored(self, event: Any) -> Tree:
        name = quoted(event.anchor)
        tree = self._anchors.get(event.anchor)
        if tree is None:
            raise self._error(
                event, f'the alias {name} has no anchor', 'define the anchor before it')
        if any(tree is each for each in self._open):
            raise self._error(
                event, f'the alias {name} is inside of its own anchor', 'write the value out')
        return tree

    def _fill(self, tree: Sequence | Mapping) -> None:
        """Read the entries of a list or mapping, and count them, with aliases expanded."""
        key: str | None = None
        while type(event := next(self._events)) not in _ENDS:
            each = self._tree(event)
            tree.size += each.size
            if tree.size > MAX_SIZE:
                raise self._error(
                    event,
                    f'more than {MAX_SIZE} entries (aliases count as often as they are used)',
                    'remove the aliases, or split the file into several graphs')
            if type(tree) is Sequence:
                tree.items.append(each)
            elif type(tree) is Mapping and key is None:
                key = self._key(event, tree, each)
            elif type(tree) is Mapping and key is not None:
                tree.entries[key] = each
                key = None

    def _key(self, event: Any, parent: Mapping, tree: Tree) -> str:
        if not isinstance(tree, Scalar):
            raise self._error(event, 'a key is a list or a mapping', 'write a plain word as key')
        if tree.text in parent.entries:
            raise self._error(
                event, f'the key {quoted(tree.text)} is given twice',
                f'remove one of them (the first is in line {parent.key_lines[tree.text]})')
        parent.key_lines[tree.text] = event.start_mark.line + 1
        return tree.text
