# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the process's CPU time is spent on, as far as the kernel's thread names tell."""

from __future__ import annotations

from pathlib import Path

MIDDLEWARE = 'dds.'
"""What the names of Fast DDS's threads begin with."""


def middleware_cpu_ns() -> int | None:
    """
    Return the CPU time that the middleware's own threads have taken, ns.

    They receive and store messages, whatever the executor does.  None where the kernel does not
    tell (no Linux), or where no thread has such a name (another middleware).
    """
    times = []
    for task in Path('/proc/self/task').glob('*'):
        try:
            if (task / 'comm').read_text().startswith(MIDDLEWARE):
                times.append(int((task / 'schedstat').read_text().split()[0]))
        except (OSError, ValueError, IndexError):
            continue  # it has ended, or is not told
    return sum(times) if times else None
