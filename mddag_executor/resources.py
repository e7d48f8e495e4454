# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Find the files that ship with the package.

A checkout (also one that is installed with `pip install -e`) has them next to the package, and an
installation under a prefix has them in `PREFIX/share/mddag_executor`, be it a virtual environment,
a colcon workspace, /usr/local or `~/.local`.
"""

from __future__ import annotations

from pathlib import Path

from mddag_executor.errors import InputError


def find(name: str) -> Path:
    """Return the path of a shipped file (its name is from the top), or raise InputError."""
    # PREFIX/lib/python3.12/site-packages, and Debian's PREFIX/local/lib/…
    top, *above = Path(__file__).resolve().parent.parents
    # `pip install --target` makes the package's folder the prefix
    for root in (top, *(each / 'share' / 'mddag_executor' for each in (top, *above[2:4]))):
        if (root / name).exists():
            return root / name
    raise InputError(name, 'not found among the files that ship with mddag_executor',
                     'install the package again, or give a path of your own')
