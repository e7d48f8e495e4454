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
"""

from __future__ import annotations

from dataclasses import replace
import io

from msg_graph.errors import GraphError
from msg_graph.model import Callback, Dag, TaskSet

WIDTH = 87
"""A line of a list in brackets is broken after the item that reaches this column."""


def format_text(text: str, name: str = '<string>') -> str:
    """
    Return a declaration in normal form.

    :param name: what errors call it.
    :raises GraphError: it is no declaration, or it cannot be laid out anew without a change of
        its meaning.
    """
    from msg_graph import loads
    before = loads(text, name)
    result = text
    for _ in range(3):  # a comment that moves may make room for one more change
        last, result = result, _laid_out(result, name)
        if result == last:
            break
    else:
        raise _refused(name)
    try:
        after = loads(result, name)
    except GraphError:
        raise _refused(name) from None
    if _without_lines(before) != _without_lines(after):
        raise _refused(name)
    return result


def _refused(name: str) -> GraphError:
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
        raise _refused(name) from None
    lines = [line.rstrip() for line in stream.getvalue().strip('\n').splitlines()]
    return '\n'.join(lines) + '\n'


def _without_lines(task_set: TaskSet) -> TaskSet:
    """Return the task set with everything left out that tells where in the text it stood."""
    callbacks = {callback.key: replace(callback, line=0) for callback in task_set.callbacks}
    return replace(
        task_set, text='', callbacks=tuple(callbacks.values()),
        dags=tuple(_dag_without_lines(dag, callbacks) for dag in task_set.dags))


def _dag_without_lines(dag: Dag, callbacks: dict[str, Callback]) -> Dag:
    return replace(dag, vertices=tuple(
        replace(vertex, callback=callbacks[vertex.callback.key]) for vertex in dag.vertices))
