# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What a live run says of drift, of wrong names and of what never ran."""

from mddag_executor import MultiDeadlineExecutor
from mddag_executor.executor.statistics import Watch
from mddag_executor.replay import open_recording
from mddag_executor.replay.drift import drift_of
from mddag_executor.report.live_runs import live_lines
from msg_graph import loads
import pytest
from rclpy.action import ActionClient, ActionServer
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from std_msgs.msg import Empty, Header, String
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

from .conftest import Spinning, wait_for


def test_a_sync_that_never_got_one_of_its_topics(make_executor, make_node, tmp_path):
    task_set = loads("""
mddag: 1
nodes:
  - node: /camera
    callbacks: [{name: grab, timer: 20ms, publishes: [/image, /info]}]
  - node: /eye
    callbacks: [{name: see, sync: [/image, /info], deadline: 20ms}]
""")
    path = str(tmp_path / 'run.mcap')
    executor = make_executor(task_set, num_workers=2, trace=path)
    watch = Watch(executor, task_set)
    camera, eye = make_node('camera'), make_node('eye')
    image, seen = camera.create_publisher(Empty, 'image', 10), []
    for topic in ('image', 'inf'):
        eye.create_subscription(Empty, topic, seen.append, 10)
    camera.create_timer(0.02, lambda: image.publish(Empty()))
    for node in (camera, eye):
        executor.add_node(node)
    with Spinning(executor):
        assert wait_for(lambda: len(seen) > 8, 10.0)
    live = watch.drift(executor.statistics())
    executor.shutdown()
    for text in (live[0].text, drift_of(open_recording(path))[0].text):
        assert text.startswith('/eye:see never got a message of /info in ')
        assert text.endswith(": did you mean the topic '/inf'?")


LEAST_S = 0.3


@pytest.fixture(autouse=True)
def check_soon(monkeypatch):
    monkeypatch.setattr('mddag_executor.executor.name_check.LEAST_S', LEAST_S)


def test_undeclared_callbacks_have_names(make_executor, make_node):
    executor = make_executor()
    node = make_node('robot')
    done = []

    def execute(goal):
        goal.succeed()
        return Fibonacci.Result()

    def tick():
        publisher.publish(String())
        done.append('tick')

    def hear(message):
        done.append('hear')

    def answer(request, response):
        done.append('answer')
        return response

    def wake():
        done.append('wake')

    server = ActionServer(node, Fibonacci, 'count', execute)
    action = ActionClient(node, Fibonacci, 'count')
    publisher = node.create_publisher(String, 'words', 10)
    node.create_subscription(String, 'words', hear, 10)
    node.create_timer(0.0125, tick)
    node.create_service(Trigger, 'ask', answer)
    client = node.create_client(Trigger, 'ask')
    guard = node.create_guard_condition(wake)
    executor.add_node(node)
    with Spinning(executor):
        assert client.wait_for_service(10.0) and action.wait_for_server(10.0)
        asked = client.call_async(Trigger.Request())
        goal = action.send_goal_async(Fibonacci.Goal())
        guard.trigger()
        assert wait_for(lambda: {'tick', 'hear', 'answer', 'wake'} <= {*done})
        assert wait_for(lambda: goal.done() and asked.done())
        assert executor.shutdown(5.0)
    expected = {
        '/robot: tick (timer 12.5ms)', '/robot: hear (subscription /words)',
        '/robot: answer (service /ask)', '/robot: wake (guard condition)',
        '/robot: ActionServer (waitable)', '/robot: ActionClient (waitable)'}
    assert expected <= {*executor.statistics()['callbacks']}
    server.destroy()
    action.destroy()


CAMERA = """
mddag: 1
nodes:
  - node: /camera
    callbacks: [{name: capture, timer: 50ms, publishes: [/image], dag: vision}]
  - node: /detector
    callbacks: [{name: detect, subscription: /image, deadline: 50ms}]
"""


@pytest.mark.parametrize(('node', 'topic', 'expected'), [
    ('camera', 'image', None),
    ('kamera', 'image', '1 declared callback was found in no node: /camera:capture '
     "(did you mean the node '/kamera'?); undeclared callbacks that ran: "
     '/kamera: tick (timer 50ms): '),
    ('camera', 'robot/image', '1 declared callback was found in no node: /detector:detect '
     "(did you mean the topic '/robot/image'?); undeclared callbacks that ran: /detector: hear "
     '(subscription /robot/image): ')])
def test_a_wrong_name_is_warned_of_once(ros_context, make_node, capfd, node, topic, expected):
    camera, detector = make_node(node), make_node('detector')
    publisher = camera.create_publisher(String, topic, 10)
    heard = []

    def tick():
        publisher.publish(String())

    def hear(message):
        heard.append(message)

    camera.create_timer(0.05, tick)
    detector.create_subscription(String, topic, hear, 10)
    executor = MultiDeadlineExecutor(loads(CAMERA, 'camera.yaml'), context=ros_context)
    executor.add_node(camera)
    executor.add_node(detector)
    executor.spin_until_future_complete(Future(), 2 * LEAST_S + 0.5)
    executor.shutdown()
    assert heard
    warned = [line for line in capfd.readouterr().err.splitlines() if 'found in no node' in line]
    if expected is None:
        assert warned == []
    else:
        line, = warned
        assert f'camera.yaml: {expected}' in line


def test_a_subscription_that_gets_nothing_for_its_qos_is_named(make_executor, make_node):
    source, sink = make_node('source'), make_node('sink')
    publisher = source.create_publisher(
        Header, '/a', QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    source.create_timer(0.05, lambda: publisher.publish(Header()))
    sink.create_subscription(Header, '/a', lambda message: None, 10)
    executor = make_executor(loads("""
mddag: 1
nodes:
  - node: /source
    callbacks: [{name: tick, timer: 50ms, publishes: [/a], dag: d}]
  - node: /sink
    callbacks: [{name: hear, subscription: /a, deadline: 50ms}]
"""))
    executor.add_node(source)
    executor.add_node(sink)

    def callbacks():
        return executor.statistics()['callbacks']

    with Spinning(executor):
        assert wait_for(lambda: callbacks().get('/sink:hear', {}).get('incompatible_qos'))
    assert callbacks()['/sink:hear']['incompatible_qos'] == 'RELIABILITY'
    assert callbacks()['/source:tick']['incompatible_qos'] is None
    lines = list(live_lines({**executor.statistics(), 'measured': None}))
    assert ('1 callback without messages, as a publisher has an incompatible QoS: '
            '/sink:hear (RELIABILITY)') in lines
