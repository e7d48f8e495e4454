# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What a run that does not come to its end tells."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import threading, time
from mddag_executor.cli.stuck import dump_when_stuck
from mddag_executor.hosting.session import Session


class Executor:
    def spin(self):
        time.sleep(0.05)
    def shutdown(self, timeout_sec):
        time.sleep({takes})

with dump_when_stuck({patience}) as ends:
    with Session(Executor(), on_end=ends) as session:
        session.wait(None)
print('end')
time.sleep(0.7)  # it is over: nothing more is told
"""


@pytest.mark.parametrize(('patience', 'takes', 'times'), [(20.0, 0.0, 0), (0.5, 1.5, 1)])
def test_an_end_that_takes_too_long_tells_where_each_thread_stands(
    patience: float, takes: float, times: int
) -> None:
    process = subprocess.run(
        [sys.executable, '-c', PROGRAM.format(patience=patience, takes=takes)],
        capture_output=True, text=True, timeout=60, check=True)
    assert process.stdout == 'end\n'
    assert process.stderr.count('Timeout') == times
    assert process.stderr.count('in shutdown') == times
    assert process.stderr.count(' in end') == times
