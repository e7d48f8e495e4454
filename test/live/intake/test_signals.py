# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Signals and exits with intakes, in processes of their own."""

from __future__ import annotations

import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import pytest

from .helpers import THREADED

# --- signals -------------------------------------------------------------------------------------

PROGRAM = """
import signal, sys, threading, time
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerGuardCondition
from mddag_executor.live.intake.entities import snapshot
from mddag_executor.live.intake.events import EventsIntake
from mddag_executor.live.intake.waitset import WaitSetIntake

class Receiver:
    def __getattr__(self, name):
        return lambda *_: None

kind = sys.argv[1]
rclpy.init()
context = rclpy.get_default_context()
node = Node('node')
node.create_timer(0.05, lambda: None)
handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
if kind == 'single':
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    print('ready', flush=True)
    try:
        while rclpy.ok():
            executor.spin_once()
        print('context ended', flush=True)
    except KeyboardInterrupt:
        print('KeyboardInterrupt', flush=True)
    except rclpy.executors.ExternalShutdownException:
        print('context ended', flush=True)
    sys.exit(3)
done = threading.Event()
guard = SignalHandlerGuardCondition(context)
intake = {'events': EventsIntake, 'waitset': WaitSetIntake}[kind](
    context, Receiver(), (guard,), on_shutdown=done.set)
intake.update(snapshot([node]))
intake.start()
time.sleep(0.1)
assert handlers == (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM))
print('ready', flush=True)
try:
    done.wait()
    print('context ended', flush=True)
except KeyboardInterrupt:
    print('KeyboardInterrupt', flush=True)
start = time.monotonic()
intake.stop()
assert time.monotonic() - start < 20
assert not [t for t in threading.enumerate() if t.name.startswith('mddag')]
sys.exit(3)
"""


def _environment() -> dict[str, str]:
    root = Path(__file__).resolve().parents[3]
    path = os.pathsep.join([str(root), *filter(None, [os.environ.get('PYTHONPATH')])])
    return {**os.environ, 'PYTHONPATH': path}


def _signalled(tmp_path: Path, kind: str, number: signal.Signals) -> tuple[int, str, str]:
    program = tmp_path / 'program.py'
    program.write_text(PROGRAM)
    with subprocess.Popen(
        [sys.executable, str(program), kind], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, env=_environment(),
    ) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == 'ready\n', process.communicate()[1]
            time.sleep(0.2)
            process.send_signal(number)
            out, err = process.communicate(timeout=30.0)
        finally:
            process.kill()
    return process.returncode, out, err


@pytest.mark.parametrize('kind', THREADED)
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signals_do_what_they_do_with_rclpys_executors(
    tmp_path: Path, kind: str, number: signal.Signals
) -> None:
    said = {signal.SIGINT: 'KeyboardInterrupt', signal.SIGTERM: 'context ended'}
    expected = 3, f'{said[number]}\n', ''
    assert _signalled(tmp_path, kind, number) == expected
    # rclpy's own may fail instead, when the signal comes before its wait: "wait set is invalid".
    assert any(_signalled(tmp_path, 'single', number) == expected for _ in range(5))


@pytest.mark.parametrize('kind', THREADED)
def test_a_process_that_forgets_to_stop_ends_all_the_same(tmp_path: Path, kind: str) -> None:
    program = tmp_path / 'program.py'
    program.write_text(PROGRAM.split('done.wait()')[0] + 'sys.exit(4)\nfinally:\n    pass\n')
    ended = subprocess.run(
        [sys.executable, str(program), kind], capture_output=True, text=True, timeout=20.0,
        env=_environment(), check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (4, 'ready\n', '')
