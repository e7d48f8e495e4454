# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
CARET architecture files: nodes and callbacks from them.

Theory of operation
-------------------
An architecture file (caret_analyze's ``Architecture.export``) lists for each node its callbacks
with their start, its callback groups, its published and subscribed topics with their callbacks,
its ``variable_passings`` and its ``message_contexts``. ``UNDEFINED`` means that CARET could not
find a value, and that it was not filled in.

1. A topic's publisher is the callback named in the file; if none is named, the only callback of
   the node; else it is unknown.
2. A variable passing is a queue edge: the reading callback reads the writing one's variable.
3. A message context ``use_latest_message`` from a subscribed to a published topic means that the
   publisher's callback uses the latest message. If that message starts the callback itself, it
   adds nothing. If another callback receives the message, it is a queue edge on that callback; if
   no callback does, on the topic. The other contexts (``callback_chain``,
   ``inherit_unique_stamp``) repeat the variable passings.
4. A mutually exclusive callback group counts if it has several callbacks.
5. In 2021 files had ``type`` for ``callback_type``, one ``callback_name`` for each published
   topic, and paths that list callbacks (``path_name_aliases``).
6. Other keys are ignored: the format grows.
"""

from __future__ import annotations

from collections.abc import Callable

from msg_graph.draft import declaration_of, Draft, DraftCallback, DraftNode, DraftPath
from msg_graph.errors import GraphError, shown, ValueProblem
from msg_graph.language import CALLBACK, GROUP, Name, NODE, SERVICE, TOPIC
from msg_graph.yamltext import Mapping, parse_yaml, Scalar, Sequence, Tree

_REMEDY = "give an architecture file as caret_analyze's Architecture.export writes it"


def declaration_from_caret(
    text: str, file: str, measure: Callable[[Draft], object] | None = None
) -> str:
    """
    Return the text of a declaration with marked blanks.

    :param text: of the architecture file.
    :param file: its name, for errors and for the first line.
    :param measure: adds measured values before the declaration is written.
    """
    draft = read_architecture(text, file)
    if measure is not None:
        measure(draft)
    return declaration_of(draft)


def read_architecture(text: str, file: str) -> Draft:
    """Return the contents of an architecture file."""
    tree = parse_yaml(text, file)
    if not isinstance(tree, Mapping) or 'nodes' not in tree.entries:
        raise GraphError(file, None, 'this is no architecture file of CARET', _REMEDY)
    reader = _Reader(file)
    nodes = [reader.node(each) for each in reader.mappings(tree, 'nodes')]
    paths = [reader.path(each) for each in reader.mappings(tree, 'named_paths')]
    paths += [reader.alias(each) for each in reader.mappings(tree, 'path_name_aliases')]
    return Draft(
        f'the CARET architecture file {file}', [node for node in nodes if node.callbacks], paths)


class _Reader:

    def __init__(self, file: str) -> None:
        self._file = file

    def error(self, tree: Tree, problem: str) -> GraphError:
        return GraphError(self._file, tree.line, problem, _REMEDY)

    def mappings(self, tree: Mapping, key: str) -> list[Mapping]:
        value = tree.entries.get(key)
        if value is None or (isinstance(value, Scalar) and value.is_null):
            return []
        if not isinstance(value, Sequence):
            raise self.error(value, f"'{key}' is no list")
        for item in value.items:
            if not isinstance(item, Mapping):
                raise self.error(item, f"an entry of '{key}' is no mapping")
        return [item for item in value.items if isinstance(item, Mapping)]

    def text(self, tree: Mapping, key: str) -> str:
        value = tree.entries.get(key)
        if not isinstance(value, Scalar):
            raise self.error(tree, f"'{key}' is missing")
        return value.text

    def texts(self, tree: Mapping, key: str) -> list[str]:
        value = tree.entries.get(key)
        items = value.items if isinstance(value, Sequence) else []
        return [item.text for item in items if isinstance(item, Scalar)]

    def name(self, tree: Mapping, key: str, what: Name, text: str | None = None) -> str:
        try:
            return what.check(self.text(tree, key) if text is None else text)
        except ValueProblem as wrong:
            raise GraphError(
                self._file, tree.line, f"'{key}': {wrong.problem}", wrong.remedy) from None

    def node(self, tree: Mapping) -> DraftNode:
        node = DraftNode(self.name(tree, 'node_name', NODE))
        for each in self.mappings(tree, 'callbacks'):
            callback = self.callback(each, node.name)
            full = self.text(each, 'callback_name')
            if full in node.callbacks:
                raise self.error(each, f'the callback {shown(full)} is listed twice')
            node.callbacks[full] = callback
        for each in self.mappings(tree, 'callback_groups'):
            self._group(node, each)
        for each in self.mappings(tree, 'subscribes'):
            topic = self.name(each, 'topic_name', TOPIC)
            if self.text(each, 'callback_name') not in node.callbacks:
                node.taken.append(topic)
        for each in self.mappings(tree, 'publishes'):
            self._publisher(node, each)
        for each in self.mappings(tree, 'variable_passings'):
            writer = node.callbacks.get(self.text(each, 'callback_name_write'))
            reader = node.callbacks.get(self.text(each, 'callback_name_read'))
            if writer is not None and reader is not None:
                _read(reader, writer.name)
        for each in self.mappings(tree, 'message_contexts'):
            self._context(node, each)
        return node

    def callback(self, tree: Mapping, node: str) -> DraftCallback:
        full = self.text(tree, 'callback_name')
        name = full[len(node) + 1:] if full.startswith(f'{node}/') else full.rpartition('/')[2]
        self.name(tree, 'callback_name', CALLBACK, name)
        key = 'type' if 'type' in tree.entries else 'callback_type'
        kind = self.text(tree, key).removesuffix('_callback')
        if kind == 'timer':
            period = self.text(tree, 'period_ns')
            if not (period.isascii() and period.isdecimal() and 0 < int(period[:19]) < 2 ** 62):
                raise self.error(tree, f"'period_ns' is {shown(period)}")
            return DraftCallback(node, name, kind, period_ns=int(period))
        if kind == 'subscription':
            return DraftCallback(node, name, kind, [self.name(tree, 'topic_name', TOPIC)])
        if kind == 'service':
            service = self.name(tree, 'service_name', SERVICE)
            return DraftCallback(node, name, kind, [service])
        raise self.error(tree, f"'{key}' {shown(kind)} is not known")

    def _group(self, node: DraftNode, tree: Mapping) -> None:
        members = [node.callbacks[name] for name in self.texts(tree, 'callback_names')
                   if name in node.callbacks]
        name = self.text(tree, 'callback_group_name').rpartition('/')[2]
        if self.text(tree, 'callback_group_type') != 'mutually_exclusive' or len(members) < 2:
            return
        self.name(tree, 'callback_group_name', GROUP, name)
        for callback in members:
            callback.group = name

    def _publisher(self, node: DraftNode, tree: Mapping) -> None:
        topic = self.name(tree, 'topic_name', TOPIC)
        names = self.texts(tree, 'callback_names')
        if 'callback_name' in tree.entries:
            names.append(self.text(tree, 'callback_name'))
        known = [node.callbacks[name] for name in names if name in node.callbacks]
        if not known and len(node.callbacks) == 1:
            known = list(node.callbacks.values())
        for callback in known:
            if topic not in callback.publishes:
                callback.publishes.append(topic)
        if not known:
            for callback in node.callbacks.values():
                callback.maybe.append(topic)

    def _context(self, node: DraftNode, tree: Mapping) -> None:
        kind = tree.entries.get('context_type')
        if not isinstance(kind, Scalar) or kind.text != 'use_latest_message':
            return
        taken = self.text(tree, 'subscription_topic_name')
        published = self.text(tree, 'publisher_topic_name')
        for callback in node.callbacks.values():
            if published not in callback.publishes or taken in callback.starts:
                continue
            takers = [c.name for c in node.callbacks.values()
                      if c.kind == 'subscription' and taken in c.starts]
            for read in takers or ([taken] if taken in node.taken else []):
                _read(callback, read)

    def path(self, tree: Mapping) -> DraftPath:
        steps = []
        for each in self.mappings(tree, 'node_chain'):
            steps.append((self.text(each, 'node_name'),
                          self.text(each, 'subscribe_topic_name'),
                          self.text(each, 'publish_topic_name')))
        return DraftPath(self.text(tree, 'path_name'), steps)

    def alias(self, tree: Mapping) -> DraftPath:
        pairs = [text.rpartition('/') for text in self.texts(tree, 'callbacks')]
        return DraftPath(
            self.text(tree, 'path_name'), [], [f'{node}:{name}' for node, _, name in pairs])


def _read(reader: DraftCallback, what: str) -> None:
    if what != reader.name and what not in reader.reads:
        reader.reads.append(what)
