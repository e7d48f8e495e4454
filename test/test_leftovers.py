# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What a session of tests that is killed leaves behind."""

from pathlib import Path
import signal
import subprocess
import sys
import time

from . import leftovers

SESSION = """
import os, runpy, signal, subprocess, sys
folder = sys.argv[2]
with runpy.run_path(sys.argv[1])['guarded'](folder):
    environment = {**os.environ, 'TMPDIR': os.path.join(folder, 'inner')}
    print(subprocess.Popen(['sleep', '600'], env=environment).pid, flush=True)
    os.kill(os.getpid(), int(sys.argv[3]))
"""


def test_the_processes_and_files_of_a_killed_session_are_removed(tmp_path):
    folder, other = tmp_path / 'session', tmp_path / 'session2'
    for each in (folder, other):
        each.mkdir()
        (each / 'file').touch()
    session = subprocess.run(
        [sys.executable, '-c', SESSION, leftovers.__file__, folder, str(int(signal.SIGKILL))],
        stdout=subprocess.PIPE, text=True, check=False, timeout=60)
    assert session.returncode == -signal.SIGKILL
    end = time.monotonic() + 30
    while folder.exists() or Path('/proc', session.stdout.strip()).exists():
        assert time.monotonic() < end
        time.sleep(0.01)
    assert (other / 'file').exists()
