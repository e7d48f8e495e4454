# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Declarations in golden/, and short ways to write one."""

from pathlib import Path
import textwrap

from msg_graph import loads

GOLDEN = Path(__file__).with_name('golden')
EVERYTHING = (GOLDEN / 'everything.yaml').read_text()
HEAD = 'mddag: 1\nnodes:\n- node: /n\n  callbacks:\n'


def graph(text):
    """Derive a declaration whose head is left out."""
    return loads('mddag: 1\nnodes:\n' + textwrap.indent(textwrap.dedent(text), '  '), 'g.yaml')


def write(folder, **files):
    """Write files, named by their stems with `__` for a folder; return the path of `top`."""
    for name, text in files.items():
        path = folder / (name.replace('__', '/') + '.yaml')
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    return folder / 'top.yaml'
