# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How the processes of a run end, and how a session does, with programs that only pretend."""

import io
import signal
import subprocess
import sys
import threading
import time

from mddag_executor.hosting import processes as module
from mddag_executor.hosting.processes import Supervisor
from mddag_executor.hosting.session import Session
import pytest

from .conftest import has_ended, wait_for

WAITS = """
import signal, sys, threading
end = threading.Event()
signal.signal(signal.SIGTERM, lambda *_: end.set())
print('waits')
end.wait(60)
print('ends')
"""


class Case:
    """A supervisor of programs by name."""

    def __init__(self, goes_on=False, **programs):
        self.out, self.err = io.StringIO(), io.StringIO()
        self.died = []
        self.programs = programs
        self.supervisor = Supervisor(self.command, goes_on, self.out, self.err, self.ended)

    def ended(self, run):
        if run.died:
            self.died.append(run)

    def command(self, name):
        return [sys.executable, '-c', self.programs[name]]

    def run(self, seconds=None):
        self.supervisor.run(list(self.programs), seconds)
        return [(run.name, run.status) for run in self.supervisor.runs]

    def stop_when(self, wanted):
        """Ask for the end as soon as something has been printed."""
        def wait():
            end = time.monotonic() + 60
            while wanted not in self.out.getvalue() and time.monotonic() < end:
                time.sleep(0.01)
            self.supervisor.stop()

        threading.Thread(target=wait, daemon=True).start()


def test_output_has_the_name_of_the_process_before_each_line():
    case = Case(True, a='print("one"); print("two", end="")',
                b='import sys; print("three", file=sys.stderr)')
    assert case.run() == [('a', 0), ('b', 0)]
    assert case.out.getvalue() == '[a] one\n[a] two\n'
    assert case.err.getvalue() == '[b] three\n'
    assert not case.died


def test_the_end_of_one_ends_all(tmp_path):
    mark = tmp_path / 'waits'
    waits = WAITS.replace("print('waits')", f'open({str(mark)!r}, "w").close()')
    ends = f'import os, time\nwhile not os.path.exists({str(mark)!r}): time.sleep(0.01)'
    case = Case(a=waits, b=ends)
    assert case.run() == [('a', 0), ('b', 0)]
    assert case.out.getvalue() == '[a] ends\n' and not case.died


def test_all_end_when_asked_and_who_does_not_is_killed(monkeypatch):
    monkeypatch.setattr(module, 'END_TIMEOUT_S', 0.1)
    deaf = WAITS.replace('lambda *_: end.set()', 'signal.SIG_IGN')
    case = Case(a=deaf)
    case.stop_when('[a] waits')
    assert case.run() == [('a', -signal.SIGKILL)]
    assert [run.how for run in case.died] == ['was ended by signal 9 (Killed)']
    assert case.err.getvalue() == (
        'warning: process a has not ended within 0.1 s: it is killed\n')


@pytest.mark.parametrize('is_deaf', [False, True])
def test_who_does_not_end_when_the_run_is_over_is_asked_then_killed(
        monkeypatch, tmp_path, is_deaf):
    monkeypatch.setattr(module, 'END_TIMEOUT_S', 0.1)
    mark = tmp_path / 'goes on'
    how = 'signal.SIG_IGN' if is_deaf else 'signal.SIG_DFL'
    goes_on = (f'import signal, time\nsignal.signal(signal.SIGTERM, {how})\n'
               f'open({str(mark)!r}, "w").close()\nwhile True: time.sleep(60)')
    ends = f'import os, time\nwhile not os.path.exists({str(mark)!r}): time.sleep(0.01)'
    case = Case(a=goes_on, b=ends)
    assert case.run(seconds=0.0) == [('a', -signal.SIGKILL if is_deaf else -signal.SIGTERM),
                                     ('b', 0)]
    assert [run.name for run in case.died] == ['a'] * is_deaf
    said = case.err.getvalue().splitlines()
    assert said[0] == 'warning: process a has not ended with the others: it is asked to'
    assert said[1:] == ['warning: process a has not ended within 0.1 s: it is killed'] * is_deaf


def test_it_ends_with_who_started_it(tmp_path):
    mark = tmp_path / 'pid'
    child = ('import os, sys; from mddag_executor.hosting.processes import belong_to_parent; '
             'belong_to_parent(int(sys.argv[1])); from pathlib import Path; '
             f'Path({str(mark)!r} + "x").write_text(str(os.getpid())); '
             f'os.rename({str(mark)!r} + "x", {str(mark)!r}); import time; time.sleep(60)')
    parent = subprocess.Popen([sys.executable, '-c', (
        'import os, subprocess, sys; '
        f'subprocess.run([sys.executable, "-c", {child!r}, str(os.getpid())])')])
    try:
        assert wait_for(mark.exists, 60.0)
    finally:
        parent.kill()
        parent.wait()
    assert wait_for(lambda: has_ended(int(mark.read_text())), 60.0)


DEEPEST = 60
"""So many steps of the interpreter are in `wait` and below before it sleeps, and some more."""


class Idle:
    """An executor that has nothing to run."""

    def __init__(self):
        self.ended = threading.Event()

    def spin(self):
        self.ended.wait()

    def shutdown(self, timeout_sec):
        self.ended.set()
        return True


def stop_after(session, steps):
    """Return a trace function that stops the session, as a signal's handler would, at a step."""
    left = steps

    def trace(frame, event, _):
        nonlocal left
        frame.f_trace_opcodes = True
        if event == 'opcode':
            left -= 1
            if left == 0:
                session.stop(hurried=True)
        return trace

    return trace


def test_a_signal_stops_a_session_wherever_it_interrupts_the_wait():
    for steps in range(1, DEEPEST):
        stop_at(steps)


def stop_at(steps):
    session = Session(Idle())
    answers = []

    def wait():
        sys.settrace(stop_after(session, steps))
        answers.append(session.wait(0.01))
        sys.settrace(None)
        session.end()

    session.__enter__()
    # A daemon, and no `with`: where one waits for ever, the tests are to end all the same.
    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    thread.join(5.0)
    assert not thread.is_alive(), 'the handler waits for what it has interrupted'
    assert session.clean
    assert len(answers) == 1
