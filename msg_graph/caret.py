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
5. Other keys are ignored: the format grows.
"""

from __future__ import annotations

from typing import Any

from msg_graph.draft import Draft, DraftCallback, DraftNode, DraftPath
from msg_graph.duration import DAY, MICROSECOND
from msg_graph.errors import GraphError, quoted, ValueProblem
from msg_graph.language import CALLBACK, GROUP, NODE, SERVICE, TOPIC
from msg_graph.yamltext import parse_yaml, plain

Plain = dict[str, Any]
"""An entry of the file; scalars are text, ``null`` is None."""


def read_architecture(text: str, file: str) -> Draft:
    """Return the contents of an architecture file; ``file`` is its name."""
    remedy = "give an architecture file as caret_analyze's Architecture.export writes it"
    tree: Any = plain(parse_yaml(text, file))
    if isinstance(tree, dict) and 'path_name_aliases' in tree:
        raise GraphError(
            file, None, 'CARET wrote this architecture file before ROS 2 Humble; such files are '
            'not read any more', 'write it with CARET of Humble or later')
    try:
        nodes = [_node(each) for each in tree['nodes'] or ()]
        paths = [_path(each) for each in tree.get('named_paths') or ()]
    except ValueProblem as wrong:
        raise GraphError(file, None, wrong.problem, wrong.remedy) from None
    except KeyError as missing:
        raise GraphError(
            file, None, f'this is not an architecture file of CARET: {missing} is missing', remedy
        ) from None
    except (AttributeError, TypeError):
        raise GraphError(file, None, 'this is not an architecture file of CARET', remedy) from None
    return Draft(
        f'the CARET architecture file {file}', [node for node in nodes if node.callbacks], paths)


def _node(tree: Plain) -> DraftNode:
    node = DraftNode(NODE.check(tree['node_name']))
    for each in tree.get('callbacks') or ():
        callback = _callback(each, node.name)
        if each['callback_name'] in node.callbacks:
            raise ValueProblem(
                f"two callbacks of {node.name} are called {quoted(each['callback_name'])}",
                'give each callback of a node its own name')
        node.callbacks[each['callback_name']] = callback
    for each in tree.get('callback_groups') or ():
        _group(node, each)
    for each in tree.get('subscribes') or ():
        if each['callback_name'] not in node.callbacks:
            node.polled_topics.append(TOPIC.check(each['topic_name']))
    for each in tree.get('publishes') or ():
        _publisher(node, each)
    for each in tree.get('variable_passings') or ():
        writer = node.callbacks.get(each['callback_name_write'])
        reader = node.callbacks.get(each['callback_name_read'])
        if writer is not None and reader is not None:
            _read(reader, writer.name)
    for each in tree.get('message_contexts') or ():
        _context(node, each)
    return node


def _callback(tree: Plain, node: str) -> DraftCallback:
    full = tree['callback_name']
    name = CALLBACK.check(
        full[len(node) + 1:] if full.startswith(f'{node}/') else full.rpartition('/')[2])
    kind = tree['callback_type'].removesuffix('_callback')
    if kind == 'timer':
        period = tree['period_ns']
        if not (period.isdecimal() and MICROSECOND <= int(period[:19]) <= DAY):
            raise ValueProblem(f"'period_ns' of {quoted(full)} is {quoted(period)}",
                               f'write ns, from {MICROSECOND} to {DAY}')
        return DraftCallback(node, name, kind, period_ns=int(period))
    if kind == 'subscription':
        return DraftCallback(node, name, kind, [TOPIC.check(tree['topic_name'])])
    if kind == 'service':
        return DraftCallback(node, name, kind, [SERVICE.check(tree['service_name'])])
    raise ValueProblem(f'the type {quoted(kind)} of {quoted(full)} is not known',
                       'use timer_callback, subscription_callback or service_callback')


def _group(node: DraftNode, tree: Plain) -> None:
    members = [node.callbacks[name] for name in tree.get('callback_names') or ()
               if name in node.callbacks]
    if tree['callback_group_type'] == 'mutually_exclusive' and len(members) > 1:
        name = GROUP.check(tree['callback_group_name'].rpartition('/')[2])
        for callback in members:
            callback.group = name


def _publisher(node: DraftNode, tree: Plain) -> None:
    topic = TOPIC.check(tree['topic_name'])
    names = tree.get('callback_names') or ()
    known = [node.callbacks[name] for name in names if name in node.callbacks]
    if not known and len(node.callbacks) == 1:
        known = list(node.callbacks.values())
    for callback in known:
        if topic not in callback.publishes:
            callback.publishes.append(topic)
    if not known:
        for callback in node.callbacks.values():
            callback.possible_topics.append(topic)


def _context(node: DraftNode, tree: Plain) -> None:
    if tree['context_type'] != 'use_latest_message':
        return
    taken, published = tree['subscription_topic_name'], tree['publisher_topic_name']
    for callback in node.callbacks.values():
        if published not in callback.publishes or taken in callback.started_by:
            continue
        takers = [c.name for c in node.callbacks.values()
                  if c.kind == 'subscription' and taken in c.started_by]
        for read in takers or ([taken] if taken in node.polled_topics else []):
            _read(callback, read)


def _path(tree: Plain) -> DraftPath:
    return DraftPath(_text(tree, 'path_name'), [
        (_text(each, 'node_name'), _text(each, 'subscribe_topic_name'),
         _text(each, 'publish_topic_name')) for each in tree['node_chain'] or ()])


def _text(tree: Plain, key: str) -> str:
    if not isinstance(tree[key], str):
        raise TypeError(key)
    return str(tree[key])


def _read(reader: DraftCallback, what: str) -> None:
    if what != reader.name and what not in reader.reads:
        reader.reads.append(what)
