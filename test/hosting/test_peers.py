# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Synthetic nodes under rclpy's executor; functions in a process of their own."""

import signal
import subprocess
import sys

from mddag_executor.hosting.child import ChildError, CrashError, run_child
from mddag_executor.hosting.peers import measure_peer
import pytest

from .conftest import has_ended, wait_for

GRAPH = """
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: t, timer: 20ms, publishes: [/x], execution_time: 1ms}]}
  - {node: /b, callbacks: [{name: s, subscription: /x, deadline: 500ms, execution_time: 1ms}]}
"""


def test_nodes_run_under_rclpys_executor(tmp_path):
    graph = tmp_path / 'graph.yaml'
    graph.write_text(GRAPH)
    result = measure_peer(str(graph), 2, seconds=1.0, seed=3, utilisation=0.05)
    assert 0 < result['on_time'] <= result['sink_jobs_due']
    assert (result['seed'], result['workers']) == (3, 2)
    assert result['utilisation'] == pytest.approx(0.05)
    assert list(result['dags']['/a']['sinks']) == ['/b:s'] and result['callbacks'] > 0


@pytest.mark.parametrize(('function', 'arguments', 'says'), [
    ('builtins:int', ('boom',), "ValueError: invalid literal for int.. with base 10: 'boom'$"),
    ('signal:raise_signal', (11,), 'it crashed with signal 11 and gave no result$'),
    ('os:_exit', (3,), 'it ended with status 3 and gave no result$'),
    ('nowhere:run', (), "ModuleNotFoundError: No module named 'nowhere'$"),
    ('time:sleep', (60,), 'it did not end within 1 s and was killed$')])
def test_a_crash_says_how(function, arguments, says):
    with pytest.raises(CrashError, match=f'^it: {says}'):
        run_child(function, arguments, 'it', 1.0 if function == 'time:sleep' else 60.0)


def test_what_the_child_refuses_is_its_message_and_its_output_is_not_shown(capfd):
    with pytest.raises(ChildError, match="^policy 'x': ") as raised:
        run_child('mddag_executor.core:policy', ('x',), 'it', 60.0)
    assert not isinstance(raised.value, CrashError)
    expression = '(__import__("os").write(1, b"said"), {2: None})'
    assert run_child('builtins:eval', (expression,), 'it', 60.0) == (4, {2: None})
    assert capfd.readouterr() == ('', '')


@pytest.mark.parametrize('hangs', [
    'time.sleep(60)',
    'ctypes.PyDLL(None).pause()'])  # with the interpreter: none of it runs any more
def test_a_child_does_not_outlive_who_wants_its_result(tmp_path, hangs):
    mark = tmp_path / 'pid'
    body = (f'import ctypes, os, time; open({str(mark)!r} + "x", "w").write(str(os.getpid())); '
            f'os.rename({str(mark)!r} + "x", {str(mark)!r}); {hangs}')
    parent = subprocess.Popen([sys.executable, '-c', (
        'from mddag_executor.hosting.child import run_child; '
        f'run_child("builtins:exec", ({body!r},), "it", 60.0)')])
    try:
        assert wait_for(mark.exists, 60.0)
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        assert wait_for(lambda: has_ended(int(mark.read_text())), 60.0)
    finally:
        parent.kill()
        parent.wait()
