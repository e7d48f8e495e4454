# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
