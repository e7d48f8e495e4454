# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Declarations from CARET architecture files, made up in golden/ in CARET's format.

`test/cli/golden/from_caret.txt` has one more.
"""

import re

from msg_graph import GraphError, loads
from msg_graph.blanks import MARK
from msg_graph.caret import read_architecture
from msg_graph.draft import declaration_of
import pytest

from ..cli import golden
from .helpers import GOLDEN


def test_a_file_from_before_humble_is_refused_in_one_line():
    with pytest.raises(GraphError, match='^a.yaml: CARET wrote .* before ROS 2 Humble; .*: write'):
        read_architecture('path_name_aliases: []\nnodes: []\n', 'a.yaml')


def test_an_architecture_file():
    text = declaration_of(read_architecture((GOLDEN / 'caret.yaml').read_text(), 'arch.yaml'))
    golden.compare('caret', text, GOLDEN)
    # All blanks at once, with their lines, instead of the errors that follow from them.
    blanks = [n for n, line in enumerate(text.splitlines(), 1) if f'# {MARK}: ' in line]
    with pytest.raises(GraphError) as caught:
        loads(text)
    assert [each.line for each in caught.value.errors] == blanks and len(blanks) > 1
    # Accepted, the proposals are a declaration.
    loads(re.sub(rf'^( +)# (\w+: .*# {MARK}: (?!if))', r'\1\2', text, flags=re.MULTILINE))
