# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The middleware's shared memory in a process that ends without destroying its contexts.

Fast DDS makes a file of about 0.5 MB in ``/dev/shm`` for each context, and removes it when the
context is destroyed.  ``os._exit`` and SIGKILL destroy nothing, so the file would stay until the
machine restarts.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import os
import re

# Only the process that has made a segment keeps its lock open.
_LOCK = re.compile('(/dev/shm/fast(?:dds|rtps)_[0-9a-f]+)_el')


def remove_segments() -> None:
    """
    Remove the shared memory of this process's contexts, which must not be used any more.

    Other processes that read a segment keep it until they have finished.
    """
    with segments_removed('self'):
        pass


@contextmanager
def segments_removed(process: int | str) -> Iterator[None]:
    """
    Remove the shared memory of a process that is killed in the block.

    :param process: its id; one that has ended has none.
    """
    paths = []
    with suppress(OSError):     # it has ended
        for descriptor in os.scandir(f'/proc/{process}/fd'):
            with suppress(OSError):     # it was closed meanwhile
                lock = _LOCK.fullmatch(os.readlink(descriptor))
                if lock is not None:
                    paths += [lock[1], lock[0]]
    try:
        yield
    finally:
        for path in paths:
            with suppress(OSError):     # it has been removed by its process
                os.unlink(path)
