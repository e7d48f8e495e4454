# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What a signal does to a process that spins: it ends soon and quietly (rclpy#1279)."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest

PROGRAM = """
import sys, threading, time
import rclpy
from rclpy.executors import ExternalShutdownException
from mddag_executor import MultiDeadlineExecutor

rclpy.init()
node = rclpy.create_node('node')
node.create_timer(0.01, lambda: time.sleep(0.005))
executor = MultiDeadlineExecutor()
executor.add_node(node)
print('ready', flush=True)
try:
    {spin}
except (KeyboardInterrupt, ExternalShutdownException) as end:
    print(type(end).__name__)
executor.shutdown()
print([t.name for t in threading.enumerate() if t.name.startswith('mddag')])
"""


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('spin', ['executor.spin()', 'rclpy.spin(node, executor)'])
def test_a_signal_ends_spin(number, spin):
    process = subprocess.Popen(
        [sys.executable, '-c', PROGRAM.format(spin=spin)], stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == 'ready\n'
        time.sleep(0.5)
        process.send_signal(number)
        out, err = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 0, err
    assert out.splitlines()[0] in ('KeyboardInterrupt', 'ExternalShutdownException')
    assert out.splitlines()[1] == '[]'
    assert 'Traceback' not in err
