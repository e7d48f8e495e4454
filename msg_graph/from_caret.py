# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A declaration to fill in, from a CARET architecture file."""

from __future__ import annotations

from collections.abc import Callable

from msg_graph.blanks import declaration_with_blanks, MARK
from msg_graph.caret import read_architecture
from msg_graph.sketch import Sketch

__all__ = ['MARK', 'declaration_from_caret']


def declaration_from_caret(
    text: str, file: str, measure: Callable[[Sketch], object] | None = None
) -> str:
    """
    Return the text of a declaration with marked blanks.

    :param text: the architecture file's.
    :param file: its name, for errors and for the first line.
    :param measure: fills in what was measured, before the declaration is written.
    :raises GraphError: it is not YAML, or no architecture file.
    """
    sketch = read_architecture(text, file)
    if measure is not None:
        measure(sketch)
    return declaration_with_blanks(sketch)
