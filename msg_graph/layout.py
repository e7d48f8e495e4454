# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
4. A file with ``include:`` or ``arguments:`` is one part of a declaration only. Of it all values
   must be equal after; whether it is right, the whole declaration shows.
"""

from __future__ import annotations

from dataclasses import replace
import io

from msg_graph.declaration import FILE_KEYS
from msg_graph.errors import GraphError
from msg_graph.fields import Fields
from msg_graph.include import is_composed
from msg_graph.model import Callback, Dag, TaskSet
from msg_graph.yamltext import Mapping, parse_yaml, Scalar, Sequence, Tree

WIDTH = 87
"""A line of a list in brackets is broken after the item that reaches this column."""


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
        last, result = result, _laid_out(result, name)
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
    """Return what must stay the same: the task set, or all that stands in the text (rule 4)."""
    from msg_graph import loads
    tree = parse_yaml(text, name)
    if not isinstance(tree, Mapping) or not is_composed(tree):
        return without_lines(loads(text, name))
    Fields(tree, name, 'the declaration', FILE_KEYS).text('mddag', lambda _: None)
    return _plain(tree)


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


def _laid_out(text: str, name: str) -> str:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError
    yaml = YAML(typ='rt')
    yaml.preserve_quotes = True
    yaml.width = WIDTH
    yaml.indent(mapping=2, sequence=4, offset=2)
    stream = io.StringIO()
    try:
        yaml.dump(yaml.load(text), stream)
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
