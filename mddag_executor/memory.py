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

"""How much memory this process has used."""

from __future__ import annotations

from pathlib import Path
import resource


def peak_memory_mb() -> float:
    """
    Return the most memory that this process has had in RAM so far, MB.

    From the kernel's ``VmHWM`` where there is one: what ``getrusage`` tells includes what the
    process that started this one had by then.
    """
    try:
        status = Path('/proc/self/status').read_text(encoding='ascii')
        return int(status.split('VmHWM:')[1].split()[0]) / 1024
    except (OSError, IndexError, ValueError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
