# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What a session of tests may leave behind: processes, and files in its folder.

Run with a folder as its argument, this file is the guard of a session. It waits until its standard
input ends, as that of a killed session does, and removes what is left.
"""

import contextlib
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import time


def processes_of(folder):
    """Return the processes that have a session's folder, or one in it, in their environment."""
    found = {}
    mark = f'TMPDIR={folder}'.encode()
    for process in Path('/proc').glob('[0-9]*'):
        with contextlib.suppress(OSError):  # it has ended, or it is another user's
            environment = (process / 'environ').read_bytes() + b'\0'
            if mark + b'\0' in environment or mark + b'/' in environment:
                command = (process / 'cmdline').read_bytes().replace(b'\0', b' ').decode()
                # Those of the standard library end with this process.
                if 'multiprocessing.' not in command:
                    found[int(process.name)] = command
    return found


def kill(processes):
    """End processes, given by their ids."""
    for pid in processes:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


@contextlib.contextmanager
def guarded(folder):
    """Let a process remove what this one leaves behind in a folder, if this one is killed."""
    # Its own session: it must survive what ends this process, also Ctrl-C.
    guard = subprocess.Popen(
        [sys.executable, '-IS', __file__, folder], stdin=subprocess.PIPE, start_new_session=True,
        env={})
    try:
        yield
    finally:
        guard.communicate()


def main(folder):
    sys.stdin.read()
    if os.path.exists(folder):
        while processes := processes_of(folder):    # they may be starting others
            kill(processes)
            time.sleep(0.05)
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == '__main__':
    main(*sys.argv[1:])
