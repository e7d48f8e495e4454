# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Programs that end while an executor spins in a daemon thread: no abort, no hang, no noise."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import os, sys, threading, time
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from mddag_executor import MultiDeadlineExecutor


def sleep():  # in C++, without the interpreter lock
    ran.set()
    node.get_clock().sleep_for(Duration(nanoseconds=10_000_000))


def block():
    ran.set()
    threading.Event().wait()


def spin():
    {spin}

rclpy.init()
node = rclpy.create_node('node')
ran = threading.Event()
group = ReentrantCallbackGroup()
for _ in range(7):
    node.create_timer(0.005, {callback}, callback_group=group)
executor = MultiDeadlineExecutor()
executor.add_node(node)
threading.Thread(target=spin, daemon=True).start()
assert ran.wait(10)
time.sleep(0.1)
{end}
print('end', flush=True)
"""

SPIN = 'executor.spin()'
STEPS = 'while rclpy.ok(): executor.spin_once(timeout_sec=0.005)'


def run(**parts: str) -> None:
    program = PROGRAM.format(**{'callback': 'sleep', 'end': '', **parts})
    process = subprocess.run(
        [sys.executable, '-c', program], capture_output=True, text=True, timeout=30, check=False)
    assert process.returncode == 0, process.stderr
    assert process.stdout.splitlines()[-1] == 'end'
    expected = 'cannot keep its rate', 'use of fork() may lead to deadlocks'
    noise = [line for line in process.stderr.splitlines()
             if not any(text in line for text in expected)]
    assert noise == []


@pytest.mark.parametrize('spin', [SPIN, STEPS])
def test_a_program_may_end_while_a_daemon_thread_spins(spin: str) -> None:
    run(spin=spin)


def test_a_callback_that_never_ends_does_not_keep_a_program_from_ending() -> None:
    run(spin=SPIN, callback='block')


def test_a_program_may_shut_the_executor_down_right_before_it_ends() -> None:
    run(spin=SPIN, end='executor.shutdown(0)')


def test_a_forked_child_ends_without_what_the_parent_has() -> None:
    # Only what Python does at exit: Fast DDS itself does not survive the end of such a child.
    end = (
        'import atexit, warnings\n'
        'warnings.simplefilter("ignore", DeprecationWarning)  # of a fork with threads\n'
        'with executor._pool.lock:\n'
        '    child = os.fork()\n'
        '    if not child:\n'
        '        atexit._run_exitfuncs()\n'
        '        os._exit(3)\n'
        'assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 3')
    run(spin=SPIN, callback='ran.set', end=end)
