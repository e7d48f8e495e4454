# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What a signal does: a process that spins ends soon and quietly (rclpy#1279); it may publish."""

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


@pytest.mark.parametrize(('number', 'spin'), [
    (signal.SIGTERM, 'executor.spin()'), (signal.SIGINT, 'rclpy.spin(node, executor)')])
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


PUBLISHES = """
import faulthandler, signal, sys, threading, time
import rclpy
from std_msgs.msg import String
from mddag_executor import MultiDeadlineExecutor
from msg_graph import loads

faulthandler.dump_traceback_later(40, exit=True)
rclpy.init()
node = rclpy.create_node('node')
publisher = node.create_publisher(String, '/command', 10)
heard = []
node.create_subscription(String, '/command', lambda message: heard.append(message.data), 10000)
timer = node.create_timer(0.001, lambda: publisher.publish(String(data='job')))
executor = MultiDeadlineExecutor(loads('''
mddag: 1
nodes:
  - node: /node
    callbacks:
      - {name: tick, timer: 1ms, publishes: [/command]}
      - {name: obey, subscription: /command, deadline: 1s}
'''))
executor.add_node(node)
where = sys.argv[1]
stops = 0


def stop(*_):
    global stops
    publisher.publish(String(data='stop'))
    stops += 1
    if stops < 200:
        signal.setitimer(signal.ITIMER_REAL, 0.001)

signal.signal(signal.SIGALRM, stop)
signal.setitimer(signal.ITIMER_REAL, 0.001)


def done():
    return stops == 200 and heard.count('stop') >= 200

if where == 'spin':
    thread = threading.Thread(target=lambda: [time.sleep(0.01) for _ in iter(done, True)])
    thread.start()
    future = rclpy.Future()
    threading.Thread(target=lambda: (thread.join(), future.set_result(None))).start()
    executor.spin_until_future_complete(future)
elif where == 'spin_once':
    while not done():
        executor.spin_once(0.1)
else:
    thread = threading.Thread(target=executor.spin)
    thread.start()
    while not done():
        publisher.publish(String(data='go'))
        executor.statistics()
        executor.create_task(lambda: None)
    executor.shutdown()
    thread.join()
print(stops, heard.count('stop'))
"""


@pytest.mark.parametrize('where', ['spin', 'spin_once', 'beside'])
def test_a_signal_s_handler_may_publish(where):
    """Whatever the main thread does when the signal comes: it holds locks now and then."""
    done = subprocess.run(
        [sys.executable, '-c', PUBLISHES, where], capture_output=True, text=True, timeout=60,
        check=False)
    assert (done.returncode, done.stdout) == (0, '200 200\n'), done.stderr
