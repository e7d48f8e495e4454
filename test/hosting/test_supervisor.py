# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How processes, functions in a process of their own, and a session end; all only pretend."""

import io
from pathlib import Path
import signal
import subprocess
import sys
import threading

from mddag_executor.child import ChildError, CrashError, run_child
from mddag_executor.executor.session import Session
from mddag_executor.hosting import processes as module
from mddag_executor.hosting.processes import Run, Supervisor
import pytest

from .conftest import is_gone, wait_for
from .helpers import Idle

# Ready for SIGTERM, a program notes that in a file, whose name replaces MARK; others wait for it.
WAITS = """
import pathlib, signal, threading
end = threading.Event()
signal.signal(signal.SIGTERM, lambda *_: end.set())
pathlib.Path('MARK').touch()
end.wait(60)
print('ends')
"""
DEAF = WAITS.replace('lambda *_: end.set()', 'signal.SIG_IGN')
OBEYS = WAITS.replace('lambda *_: end.set()', 'signal.SIG_DFL')
ENDS = """
import os, time
while not os.path.exists('MARK'):
    time.sleep(0.01)
"""


class Case:
    """A supervisor of programs by name."""

    def __init__(self, folder, goes_on=False, **programs):
        self.out, self.err = io.StringIO(), io.StringIO()
        self.died = []
        self.mark = folder / 'mark'
        self.programs = programs
        self.supervisor = Supervisor(self.command, goes_on, self.out, self.err, self.ended)

    def ended(self, run):
        if run.died:
            self.died.append((run.name, run.how))

    def command(self, name):
        return [sys.executable, '-c', self.programs[name].replace('MARK', str(self.mark))]

    def run(self, seconds=None):
        self.supervisor.run(list(self.programs), seconds)
        return [(run.name, run.status) for run in self.supervisor.runs]


def test_output_has_the_name_of_the_process_before_each_line(tmp_path):
    """And Ctrl-C does not reach a process, not even at its start, so it does not fail."""
    group = 'import os; print(1); print(os.getpgrp() == os.getpid(), end="")'
    case = Case(tmp_path, True, a=group, b='import sys; print("three", file=sys.stderr)')
    assert case.run() == [('a', 0), ('b', 0)]
    assert case.out.getvalue() == f'[a] 1\n[a] {sys.version_info >= (3, 11)}\n'
    assert case.err.getvalue() == '[b] three\n'
    assert not case.died


def test_the_end_of_one_ends_all(tmp_path):
    case = Case(tmp_path, a=WAITS, b=ENDS)
    assert case.run() == [('a', 0), ('b', 0)]
    assert case.out.getvalue() == '[a] ends\n' and not case.died


@pytest.mark.parametrize(('program', 'status', 'is_asked'), [
    (DEAF, -signal.SIGKILL, True), (DEAF, -signal.SIGKILL, False),
    (OBEYS, -signal.SIGTERM, False)])
def test_a_process_that_does_not_end_is_asked_then_killed(
        monkeypatch, tmp_path, program, status, is_asked):
    """When the run is asked to end, or when it is over and another process has ended."""
    monkeypatch.setattr(module, 'END_TIMEOUT_S', 0.1)
    case = Case(tmp_path, a=program, **({} if is_asked else {'b': ENDS}))
    if is_asked:
        threading.Thread(
            target=lambda: wait_for(case.mark.exists, 60.0) and case.supervisor.stop()).start()
    assert case.run(None if is_asked else 0.0)[0] == ('a', status)
    is_killed = status == -signal.SIGKILL
    assert case.died == [('a', 'was ended by signal 9 (Killed)')] * is_killed
    assert case.err.getvalue().splitlines() == [
        *['warning: process a has not ended with the others: it is asked to'] * (not is_asked),
        *['warning: process a has not ended within 0.1 s: it is killed'] * is_killed]


def test_a_process_that_the_terminal_interrupts_at_its_start_has_not_died(tmp_path):
    """It gets the SIGINT that ends the run, if it has no group of its own yet."""
    interrupted = WAITS.replace(
        'lambda *_: end.set()', 'lambda *_: signal.raise_signal(signal.SIGINT)').replace(
        'end = ', 'signal.signal(signal.SIGINT, signal.SIG_DFL)\nend = ')
    case = Case(tmp_path, a=interrupted, b=WAITS.replace("pathlib.Path('MARK').touch()", ''))
    threading.Thread(
        target=lambda: wait_for(case.mark.exists, 60.0) and case.supervisor.stop()).start()
    assert ('a', -signal.SIGINT) in case.run() and not case.died


# --- a function in a process of its own ----------------------------------------------------------


@pytest.mark.parametrize(('function', 'argument', 'says'), [
    ('builtins:int', 'boom', "ValueError: invalid literal for int.. with base 10: 'boom'$"),
    ('signal:raise_signal', 11, 'it crashed with signal 11 and gave no result$'),
    ('os:_exit', 3, 'it ended with status 3 and gave no result$'),
    ('time:sleep', 60, 'it did not end within 1 s and was killed$')])
def test_a_crash_says_how(function, argument, says):
    with pytest.raises(CrashError, match=f'^it: {says}'):
        run_child(function, (argument,), 'it', 1.0 if function == 'time:sleep' else 60.0)


def test_what_the_child_refuses_is_its_message_and_its_output_is_not_shown(capfd):
    with pytest.raises(ChildError, match="^policy 'x': ") as raised:
        run_child('mddag_executor.core:policy', ('x',), 'it', 60.0)
    assert not isinstance(raised.value, CrashError)
    expression = '(__import__("os").write(1, b"said"), {2: None})'
    assert run_child('builtins:eval', (expression,), 'it', 60.0) == (4, {2: None})
    assert capfd.readouterr() == ('', '')


NODE = """
import pathlib, sys, time
import rclpy
sys.path.insert(0, sys.argv[1])
from helpers import segments_of

def make_node(seconds):
    rclpy.init()
    make_node.node = rclpy.create_node('node')
    segment, = segments_of('self')
    print(segment, flush=True)
    time.sleep(seconds)
    return segment

if __name__ == '__main__':
    make_node(60)
"""


@pytest.fixture
def program(tmp_path, monkeypatch):
    """Give the path of `NODE`, which can be imported as `one_node`."""
    path = tmp_path / 'one_node.py'
    path.write_text(NODE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, 'argv', ['', str(Path(__file__).parent)])
    return path


def test_a_child_leaves_no_shared_memory(program):
    """Though it does not destroy its node."""
    assert not run_child('one_node:make_node', (0,), 'it', 60.0).exists()


def test_a_process_that_is_killed_leaves_no_shared_memory(program):
    with subprocess.Popen(
            [sys.executable, program, sys.argv[1]], stdout=subprocess.PIPE, text=True) as process:
        run = Run('it', process)
        segment = Path(process.stdout.readline().strip())
        existed = segment.exists()
        run.kill()
    assert existed and not segment.exists()


@pytest.mark.parametrize('code', [
    'from mddag_executor.child import run_child; '
    'run_child("builtins:exec", ({body!r},), "it", 60.0)',
    'import subprocess, sys; subprocess.run([sys.executable, "-c", "import os; from '
    'mddag_executor.hosting.processes import belong_to_parent; belong_to_parent(os.getppid());" '
    '+ {body!r}])'])
def test_a_child_does_not_outlive_who_started_it(tmp_path, code):
    mark = tmp_path / 'pid'
    body = (f'import ctypes, os, pathlib; pathlib.Path({str(mark)!r} + "x").write_text('
            f'str(os.getpid())); os.rename({str(mark)!r} + "x", {str(mark)!r}); ')
    # with the interpreter: none of it runs any more
    body += 'ctypes.PyDLL(None).pause()' if 'run_child' in code else 'ctypes.CDLL(None).pause()'
    parent = subprocess.Popen([sys.executable, '-c', code.format(body=body)])
    try:
        assert wait_for(mark.exists, 60.0)
    finally:
        parent.kill()
        parent.wait()
    assert wait_for(lambda: is_gone(int(mark.read_text())), 60.0)


# Its first thread ends, as it does first in a process that was killed; the second one waits.
PARENT_ENDS = """
import ctypes, os, subprocess, sys, threading
threading.Thread(target=lambda: sys.stdin.read()).start()
subprocess.Popen([sys.executable, '-c', sys.argv[1], str(os.getpid())], stdin=subprocess.DEVNULL)
ctypes.CDLL(None).syscall(60 if os.uname().machine == 'x86_64' else 93, 0)  # exit
"""
CHILD_SEES = """
import os, signal, sys
from mddag_executor.child import has_ended, signal_at_end_of
parent = int(sys.argv[1])
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
signal_at_end_of(parent, signal.SIGTERM)
signal.sigwait([signal.SIGTERM])
print(os.getppid() == parent, has_ended(parent), flush=True)
"""


def test_a_killed_parent_has_ended_though_some_of_its_threads_have_not():
    with subprocess.Popen(
        [sys.executable, '-c', PARENT_ENDS, CHILD_SEES], stdin=subprocess.PIPE,
        stdout=subprocess.PIPE, text=True,
    ) as parent:
        try:
            assert parent.stdout.readline() == 'True True\n'
        finally:
            parent.kill()


# --- a session -----------------------------------------------------------------------------------


def test_a_signal_stops_a_session_wherever_it_interrupts_the_wait():
    """A trace function stops it, as a signal's handler would."""
    def wait(session, left, answers):
        def trace(frame, event, _):
            nonlocal left
            frame.f_trace_opcodes = True
            if event == 'opcode':
                left -= 1
                if left == 0:
                    session.stop()
            return trace

        sys.settrace(trace)
        answers.append(session.wait(0.01))
        sys.settrace(None)
        session.end()

    # More steps of the interpreter than there are in `wait` and below before it sleeps.
    for step in range(1, 60):
        session, answers = Session(Idle()), []
        session.__enter__()
        # A daemon, and no `with`: where one waits for ever, the tests are to end all the same.
        thread = threading.Thread(target=wait, args=(session, step, answers), daemon=True)
        thread.start()
        thread.join(5.0)
        assert not thread.is_alive(), 'the handler waits for what it has interrupted'
        assert session.clean and len(answers) == 1
