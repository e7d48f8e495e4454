# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How numbers and lists stand in messages."""

from __future__ import annotations

from pathlib import Path
import re

from mddag_executor.text import counted, listed

TOP = Path(__file__).resolve().parent.parent


def test_nouns_agree_with_their_numbers() -> None:
    assert [counted(n, 'DAG') for n in (0, 1, 2)] == ['0 DAGs', '1 DAG', '2 DAGs']
    assert [counted(n, 'vertex', 'vertices') for n in (1, 2)] == ['1 vertex', '2 vertices']


def test_long_lists_are_cut() -> None:
    assert listed(['a', 'b']) == 'a, b'
    assert listed({'a': 1, 'b': 2, 'c': 3}, 2) == 'a, b, … (1 more)'
    assert listed([]) == ''


def test_cannot_is_one_word() -> None:
    files = [path for folder in ('mddag_executor', 'msg_graph', 'docs', 'examples')
             for path in (TOP / folder).rglob('*') if path.suffix in ('.py', '.md')]
    assert len(files) > 200
    split = re.compile(r'\bcan\s+not\b')
    assert not [path.name for path in files if split.search(path.read_text(encoding='utf-8'))]
