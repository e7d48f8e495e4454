# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Signals of a run whose main thread belongs to a program: forked children, our own interrupt."""

import subprocess
import sys

CODE = """
import os, signal, threading, time
from mddag_executor.hosting.signals import Signals

class Session:
    stopped = hurried = False
    def stop(self): self.stopped = True
    def hurry(self): self.hurried = True

def until(condition):
    end = time.monotonic() + 10
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    return condition()

session, signals = Session(), Signals()
held = [os.open('/dev/null', os.O_RDONLY) for _ in range(1030)] if MANY else []
with signals:
    signals.end_of(session)
    with signals.of_program():
        pid = os.fork()
        if not pid:
            raise SystemExit(0)     # it unwinds through all of this
        assert os.waitpid(pid, 0)[1] == 0
        session.stopped = True
        try:
            signals.interrupt()
            time.sleep(10)
        except KeyboardInterrupt:
            pass
        time.sleep(0.1)
        assert not session.hurried, 'our own interrupt counts as that of the user'
        session.stopped = False
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(10)
        except KeyboardInterrupt:
            pass
        assert until(lambda: session.stopped), 'no thread reads the signals any more'
os._exit(0)
"""


def run(many):
    code = ('from mddag_executor.executor.loop import raise_limit\nraise_limit()\n'
            f'MANY = {many}\n{CODE}')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          timeout=60, check=False)
    assert done.returncode == 0, done.stderr


def test_a_forked_child_and_our_own_interrupt_leave_the_users_signals():
    run(many=False)


def test_descriptors_may_be_many():
    run(many=True)
