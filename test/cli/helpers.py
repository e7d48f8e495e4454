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

"""Running a verb in this process."""

from __future__ import annotations

from collections.abc import Callable

from mddag_executor.cli import main as program
import pytest


def caller(*verb: str) -> Callable[..., tuple[int, str, str]]:
    """Return what runs a verb with arguments: the status, and what it printed and complained."""
    def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
        status = program.main([*verb, *map(str, arguments)])
        output = capsys.readouterr()
        return status, output.out, output.err

    return call
