# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Tables for people on a terminal, and for programs in a file or pipe."""

import sys

from mddag_executor.report.text import table

NAME = '/' + '/'.join(['a_very_long_name_of_a_node'] * 6) + ':callback'


def test_names_are_shortened_on_a_terminal_only(monkeypatch):
    for is_terminal in (False, True):
        monkeypatch.setattr(sys.stdout, 'isatty', lambda at=is_terminal: at, raising=False)
        text = table(('sink', 'late'), [(NAME, '7')])
        assert (NAME in text) != is_terminal
        assert ('…' in text) == is_terminal
        assert max(map(len, text.splitlines())) <= 100 or not is_terminal
    assert '…' in table(('sink', 'late'), [(NAME, '7')], most=40)
