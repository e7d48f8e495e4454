# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Short ways to write declarations and to look at errors."""

import textwrap

from msg_graph import GraphError, loads
import pytest

MARK = '# <-'


def graph(text):
    """Derive a declaration whose head is left out."""
    return loads('mddag: 1\nnodes:\n' + textwrap.indent(textwrap.dedent(text), '  '), 'g.yaml')


def error(text, line=None):
    """Return the error of a declaration; it must be in that line, or in that with MARK."""
    with pytest.raises(GraphError) as caught:
        loads(text, 'g.yaml')
    found = caught.value
    marked = [i for i, each in enumerate(text.split('\n'), 1) if each.endswith(MARK)]
    assert len(marked) <= 1
    assert found.line == (marked[0] if marked else line), str(found)
    place = f'g.yaml:{found.line}' if found.line else 'g.yaml'
    assert found.file == 'g.yaml' and str(found).startswith(f'{place}: ')
    assert str(found).isprintable()
    assert found.problem and found.remedy
    return found


def refusal(text, right, wrong):
    """Return the error of a declaration with a replacement; it must be in the line of that."""
    assert right in text
    return error(text.replace(right, wrong, 1), text[:text.index(right)].count('\n') + 1)


def nodes_error(text, *says):
    """Return the error of a declaration whose head is left out, which must say all of that."""
    found = error('mddag: 1\nnodes:\n' + textwrap.indent(textwrap.dedent(text), '  '))
    for part in says:
        assert part in str(found), str(found)
    return found
