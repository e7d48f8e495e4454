# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verbs `graph from-trace` and `graph from-ros`, `--trace` of `from-caret`, and drift."""

import json
from pathlib import Path
import re
import subprocess
import sys

from mddag_executor import open_recording
from mddag_executor.report.tables import MOST_LINES
import msg_graph
import pytest

from ..replay.recorded import MS, Recorded

BAG = Path(__file__).resolve().parents[2] / 'bags' / 'demo_short.mcap'

ASKING = """\
from mddag_executor import MultiDeadlineExecutor
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_srvs.srv import Trigger


class Asking(Node):
    def __init__(self):
        super().__init__('asking')
        group = ReentrantCallbackGroup()
        for name in ('inner', 'outer'):
            self.create_service(Trigger, name, getattr(self, name), callback_group=group)
        self.inner_client, self.outer_client = (
            self.create_client(Trigger, name, callback_group=group) for name in ('inner', 'outer'))
        self.timer = self.create_timer(0.05, self.ask)
        self.asked = self.answered = 0

    def inner(self, request, response):
        return response

    async def outer(self, request, response):
        await self.inner_client.call_async(Trigger.Request())
        await self.inner_client.call_async(Trigger.Request())
        return response

    def ask(self):
        if self.asked == 5:
            self.timer.cancel()
            return
        self.asked += 1
        self.outer_client.call_async(Trigger.Request()).add_done_callback(self.count)

    def count(self, future):
        self.answered += 1


rclpy.init()
node = Asking()
executor = MultiDeadlineExecutor(None, trace='ask.mcap')
executor.add_node(node)
node.inner_client.wait_for_service()
node.outer_client.wait_for_service()
while node.answered < 5 or not node.timer.is_canceled():
    executor.spin_once(timeout_sec=1)
executor.shutdown()
print(node.asked)
"""


def test_from_trace(call, tmp_path):
    done = call('graph', 'from-trace', BAG, '-o', 'g.yaml', cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, 'no blanks to fill in\n', '')
    before, again = ([
        (dag.name, dag.period_ns, dag.edges, [(v.name, v.deadline_ns) for v in dag.vertices])
        for dag in task_set.dags] for task_set in (
            open_recording(BAG).task_set, msg_graph.load(tmp_path / 'g.yaml')))
    assert before == again and len(again) == 11
    done = call('graph', 'from-trace', '-', stdin=BAG.read_bytes())
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.splitlines()[1:] == (tmp_path / 'g.yaml').read_text().splitlines()[1:]


def test_from_trace_keeps_what_was_declared(call, mddag, tmp_path):
    pytest.importorskip('rclpy')
    (tmp_path / 'g.yaml').write_text(
        'mddag: 1\nnodes:\n  - node: /n\n    callbacks:\n      - {name: t, timer: 10ms, '
        'publishes: [/x], on_late: abort, max_active_jobs: 900, holds_interpreter: false}\n'
        '      - {name: s, subscription: /x, deadline: 5s}\n'
        "paths: [{name: p, callbacks: ['/n:t', '/n:s']}]\n")
    done = mddag('run', 'g.yaml', '--synthetic', 'sleep', '--duration', '0.3s', '--trace',
                 'r.mcap', cwd=tmp_path)
    assert done.returncode == 0
    done = call('graph', 'from-trace', 'r.mcap', '-o', 'again.yaml', cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')
    again = msg_graph.load(tmp_path / 'again.yaml')
    assert again.paths == (msg_graph.Path('p', ('/n:t', '/n:s')),)
    callback = again.callbacks[0]
    assert (callback.on_late, callback.max_active_jobs, callback.holds_interpreter) == (
        'abort', 900, False)


def composed(path):
    """Write five messages within a process: rclcpp runs the subscription's second callback."""
    r = Recorded(path)
    r.node(1, '/camera')
    r.node(2, '/detect')
    r.timer(11, 1, 100 * MS)
    r.publisher(100, 1, '/image')
    r.subscription(12, 2, '/image', within=13)
    for k in range(1, 6):
        at = k * 100 * MS
        r.run(11, 1, at, at + 2 * MS)
        r.add('ros2:rclcpp_intra_publish', at + MS, 1, 100, 0x500)
        r.add('ros2:rclcpp_ring_buffer_enqueue', at + MS + 1, 1, 0xB, 0, 1, 0)
        r.add('ros2:rclcpp_ring_buffer_dequeue', at + 3 * MS, 2, 0xB, 0, 0)
        r.run(13, 2, at + 3 * MS + 1, at + 7 * MS + 1, within=True)
    return r.write()


def test_messages_within_a_process_count(call, tmp_path):
    """From the recording alone, and with an architecture file."""
    composed(tmp_path / 'c.mcap')
    done = call('graph', 'from-trace', 'c.mcap', '--accept', '-o', 'g.yaml', cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, 'no blanks to fill in\n', '')
    grab, detect = msg_graph.load(tmp_path / 'g.yaml').callbacks
    assert (grab.publishes, detect.topics, detect.deadline_ns) == (
        ('/image',), ('/image',), 100 * MS)
    assert set(detect.execution_time.quantiles_ns) == {4 * MS}
    result = call('replay', 'c.mcap', 'g.yaml', '--json', '-', cwd=tmp_path).result
    sink, = result['dags']['/camera']['sinks'].values()
    assert (sink['completed'], sink['late'], sink['response_ns']['max']) == (5, 0, 7 * MS + 1)
    (tmp_path / 'a.yaml').write_text("""\
nodes:
- node_name: /camera
  callbacks:
  - {callback_name: /camera/callback_0, callback_type: timer_callback, period_ns: 100000000}
  publishes:
  - {topic_name: /image, callback_names: [UNDEFINED]}
- node_name: /detect
  callbacks:
  - {callback_name: /detect/callback_0, callback_type: subscription_callback, topic_name: /image}
""")
    done = call('graph', 'from-caret', 'a.yaml', '--trace', 'c.mcap', cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.count('# measured in 5 executions') == 2


def test_from_trace_accepts_the_proposals(call, tmp_path):
    """Two sources in a node, and what has no rate; the declaration then judges the recording."""
    r = Recorded(tmp_path / 'r.mcap')
    r.node(1, '/n')
    r.node(2, '/quiet')
    r.timer(11, 1, 10 * MS)
    r.timer(16, 1, 100_000_000 * MS)                # longer than a declaration allows
    r.publisher(100, 1, '/out')
    r.publisher(101, 1, '/status')                  # which no callback was seen to publish
    r.publisher(102, 2, '/alone')
    for callback, topic in ((12, '/in'), (13, '/never'), (14, '/once'), (15, '/status')):
        r.subscription(callback, 1, topic)
    r.subscription(17, 1, '/out')
    for k in range(1, 11):
        at = k * 10 * MS
        r.run(11, 1, at, at + MS)
        stamp = r.publish(100, 1, at + MS // 2)
        r.receive(17, 2, at + 2 * MS, at + (11 if k == 5 else 3) * MS, stamp)
        for callback in (12, 15) if k % 2 else ():
            r.receive(callback, callback, at, at + MS, at - MS)
    r.receive(14, 4, 50 * MS, 51 * MS, 49 * MS)
    r.write()
    done = call('graph', 'from-trace', 'r.mcap', '-o', 'blank.yaml', cwd=tmp_path)
    assert done.returncode == 0
    assert call('graph', 'check', 'blank.yaml', cwd=tmp_path).returncode == 2
    done = call('graph', 'from-trace', 'r.mcap', '--accept', '-o', 'g.yaml', cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout == (
        "no blanks to fill in\n4 callbacks left out: see '# Left out:' in it\n")
    assert sorted(line for line in (tmp_path / 'g.yaml').read_text().splitlines()
                  if line.startswith('# Left out:')) == [
        '# Left out: /n:callback_1 (timer): its rate is unknown',
        '# Left out: /n:callback_3 (subscription /never): it never ran',
        '# Left out: /n:callback_4 (subscription /once): its rate is unknown',
        '# Left out: /quiet:callback_0 (timer): its rate is unknown']
    dags = msg_graph.load(tmp_path / 'g.yaml').dags
    assert [(dag.name, dag.period_ns, [dag.vertices[sink].deadline_ns for sink in dag.sinks])
            for dag in dags] == [
        ('/n/callback_0', 10 * MS, [10 * MS]), ('/n/callback_2', 20 * MS, [20 * MS]),
        ('/n/callback_5', 20 * MS, [20 * MS])]
    judged = json.loads(
        call('replay', 'r.mcap', 'g.yaml', '--json', '-', cwd=tmp_path).stdout)['dags']
    assert {name: [(sink['completed'], sink['late']) for sink in dag['sinks'].values()]
            for name, dag in judged.items()} == {
        '/n/callback_0': [(10, 1)], '/n/callback_2': [(5, 0)], '/n/callback_5': [(5, 0)]}


def test_a_coroutine_is_one_execution_however_often_it_is_resumed(call, tmp_path):
    pytest.importorskip('rclpy')
    (tmp_path / 'ask.py').write_text(ASKING)
    done = subprocess.run(
        [sys.executable, 'ask.py'], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    asked = int(done.stdout)
    done = call('graph', 'from-trace', 'ask.mcap', '-o', 'g.yaml', cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    counts = dict(re.findall(
        r'name: (\w+)\n(?:(?!.*- name).*\n)*? *# measured in (\d+) ex',
        (tmp_path / 'g.yaml').read_text()))
    # the last execution of the timer's callback asks nothing
    assert counts == {'ask': str(asked + 1), 'inner': str(2 * asked), 'outer': str(asked)}


def test_from_ros_where_nothing_runs(mddag, tmp_path):
    pytest.importorskip('rclpy')
    done = mddag('graph', 'from-ros', '--timeout', '0.3', '-o', 'g.yaml', cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith('error: ROS graph: no node ')
    assert not (tmp_path / 'g.yaml').exists()
    done = mddag('graph', 'from-ros', '--timeout', '-1')
    assert (done.returncode, done.stderr.count('\n')) == (2, 1)


def test_replay_tells_of_drift(call, tmp_path):
    assert call('replay', BAG, '--json', '-').result['drift'] == []
    assert 'difference' not in call('replay', BAG).stdout
    call('graph', 'from-trace', BAG, '-o', 'g.yaml', cwd=tmp_path)
    text = (tmp_path / 'g.yaml').read_text()
    (tmp_path / 'h.yaml').write_text(text.replace('timer: 100ms', 'timer: 200ms'))
    done = call('replay', BAG, 'h.yaml', '--json', 'r.json', cwd=tmp_path)
    assert done.returncode == 0
    found = json.loads((tmp_path / 'r.json').read_text())['drift']
    assert {each['kind'] for each in found} == {'rate'}
    assert done.stdout.splitlines()[-1 - min(len(found), MOST_LINES)].startswith(
        f'{len(found)} difference')


def test_a_trace_holds_what_its_declaration_includes(call, tmp_path):
    (tmp_path / 'part.yaml').write_text(
        'mddag: 1\narguments:\n  d:\nnodes:\n  - {node: /n, callbacks: '
        '[{name: t, timer: 10ms, deadline: $(d)}]}\n')
    top = tmp_path / 'top.yaml'
    top.write_text('mddag: 1\ninclude:\n  - {file: part.yaml, namespace: /a, set: {d: 5ms}}\n'
                   '  - {file: part.yaml, namespace: /b, set: {d: 6ms}}\n')
    done = call('graph', 'check', '-', stdin=top.read_text(), cwd=tmp_path)
    assert done.returncode == 2
    assert 'not read from a file includes nothing' in done.stderr
    done = call('simulate', 'top.yaml', '--duration', '100ms', '--trace', 's.mcap',
                '--execution-times', '-', cwd=tmp_path,
                stdin='{"/a/n": {"/a/n:t": 10}, "/b/n": {"/b/n:t": 10}}')
    assert (done.returncode, done.stderr) == (0, '')
    top.unlink()
    done = call('replay', 's.mcap', cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')
