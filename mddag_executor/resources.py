# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Find the files that ship with the package.

Theory of operation: the files that belong to the code that runs come first. A checkout (also one
that is installed with `pip install -e`) has them next to the package, and an installation under a
prefix has them in `PREFIX/share/mddag_executor`, be it a virtual environment, a colcon workspace
or /usr/local. Only then other prefixes are searched: those of the ament index (REP 122 layout,
`AMENT_PREFIX_PATH`), the interpreter's, and the user's.
"""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import site
import sys

from mddag_executor.errors import InputError

_NAME = 'mddag_executor'


def roots() -> Iterator[Path]:
    """Yield the folders that may hold the shipped files, in the order in which they are tried."""
    package = Path(__file__).resolve().parent
    if (package.parent / 'package.xml').is_file():
        yield package.parent
    yield package.parent / 'share' / _NAME  # pip install --target
    # PREFIX/lib/python3.12/site-packages/mddag_executor, and Debian's PREFIX/local/lib/…
    for prefix in list(package.parents)[3:5]:
        yield prefix / 'share' / _NAME
    for entry in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        marker = Path(entry, 'share', 'ament_index', 'resource_index', 'packages', _NAME)
        if entry and marker.is_file():
            yield Path(entry, 'share', _NAME)
    yield Path(sys.prefix, 'share', _NAME)
    if site.ENABLE_USER_SITE:
        yield Path(site.getuserbase(), 'share', _NAME)


def find(name: str) -> Path:
    """Return the path of a shipped file (its name is from the top), or raise InputError."""
    for root in roots():
        path = root / name
        if path.exists():
            return path
    raise InputError(name, 'not found among the files that ship with mddag_executor',
                     'install the package again, or give a path of your own')
