# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Nodes run again from a bag: what they see, what they publish, and when."""

import asyncio
from contextlib import closing
from functools import cached_property, partial
import gc
import os
import random
import resource
import sqlite3
import threading
import uuid

from builtin_interfaces.msg import Time
from mcap.reader import make_reader
from mcap.writer import Writer
from mddag_executor import open_recording, replay
from mddag_executor.core import Tables
from mddag_executor.errors import UsageError
from mddag_executor.laboratory.generate import generate, Options
from mddag_executor.recording.columns import rows
from mddag_executor.recording.recorded_jobs import Jobs
from mddag_executor.recording.tables import RELEASES
from mddag_executor.rerun import assert_same, CallbackFailed, compare, programs, rerun, RerunError
from mddag_executor.rerun.durations import Durations
from mddag_executor.rerun.inputs import MessageBag, open_input
from mddag_executor.rerun.message_types import definition
from mddag_executor.rerun.run import Rerun
from mddag_executor.simulate import draw_execution_times, periodic_workload, simulate, Workload
from mddag_executor.simulate import END as ENDS
from mddag_executor.simulate import Settings as SimulatorSettings
from mddag_executor.simulate import START as STARTS
from mddag_executor.trace import TraceError, TraceReader
from msg_graph import load, loads
from msg_graph.duration import parse_duration
import numpy
import pytest
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.highlevel import AnyReader
from std_msgs.msg import Float64, Header, String
import yaml

from ..executor.conftest import wait_for
from ..sources.bags import BEGIN, HEADER, header, SQLITE, write
from ..sources.helpers import ns, Written
from .helpers import GRAPH, MS, run_filter, START, write_bag

GAIN = 2.0


class Filter(Node):
    """Passes on what comes, with the time at which it came."""

    def __init__(self):
        super().__init__('filter')
        self.create_subscription(Header, '/points', self.take, 10)

    @cached_property
    def publisher(self):  # made late, as by lifecycle nodes, which are configured by a request
        return self.create_publisher(Header, '/filtered', 10)

    def take(self, message):
        now = self.get_clock().now()
        self.publisher.publish(Header(stamp=now.to_msg(), frame_id=message.frame_id))


class Sink(Node):

    def __init__(self):
        super().__init__('sink')
        self.publisher = self.create_publisher(Float64, '/out', 10)
        self.create_subscription(Header, '/filtered', self.take, 10)

    def take(self, message):
        self.publisher.publish(Float64(data=GAIN * int(message.frame_id)))


def published(result, topic):
    """Return what was published on a topic: when (ms after the start), and the message."""
    return [((each.time - START) / MS, deserialize_message(each.data, each.kind))
            for each in result.outputs if each.topic == topic]


def test_the_middleware_is_left(bag, graph):
    rerun(bag, graph, [Filter, Sink])   # the first one starts a thread that stays
    before = len(os.listdir('/proc/self/task'))
    gc.disable()
    try:
        rerun(bag, graph, [Filter, Sink])
        # a thread that has ended is there for a moment
        assert wait_for(lambda: len(os.listdir('/proc/self/task')) <= before)
    finally:
        gc.enable()


def test_nodes_run_in_virtual_time(bag, graph):
    result = rerun(bag, graph, [Filter, Sink])
    filtered = published(result, '/filtered')
    assert [time for time, _ in filtered] == [100.0 * i + 10 for i in range(20)]
    assert filtered[3][1] == Header(
        frame_id='3', stamp=Time(sec=START // 10 ** 9, nanosec=300 * MS))
    out = published(result, '/out')
    assert [(time, message.data) for time, message in out] == [
        (100.0 * i + 15, 2.0 * i) for i in range(20)]
    sink = result.result()['dags']['main']['sinks']['/sink:take']
    assert (sink['completed'], sink['late'], sink['response_ns']['max']) == (20, 0, 15 * MS)
    assert rerun(bag, graph, [Filter, Sink], workers=7).digest == result.digest


def test_a_changed_constant_is_found_in_the_outputs(bag, graph, tmp_path, monkeypatch):
    """They are a bag that others read."""
    out = tmp_path / 'out.mcap'
    result = rerun(bag, graph, [Filter, Sink], output=out)
    with AnyReader([out]) as reader:
        found = [(time, reader.deserialize(data, connection.msgtype).data)
                 for connection, time, data in reader.messages() if connection.topic == '/out']
    assert found == [(each.time, 2.0 * i) for i, each in enumerate(
        each for each in result.outputs if each.topic == '/out')]
    assert_same(result, out)
    before = result
    monkeypatch.setattr(f'{__name__}.GAIN', 2.0001)
    result = rerun(bag, graph, [Filter, Sink])
    assert result.digest != before.digest
    assert_same(result, out, 1e-3)
    with pytest.raises(AssertionError, match='\n/out: content, first in message 1 at 0.115000 s: '
                       'data is 2.0001, expected 2.0$'):
        assert_same(result, out)
    less = write_bag(tmp_path / 'less.mcap', [(i * 100, '/points', Header(frame_id=str(i)))
                                              for i in range(2)])
    difference, = compare(rerun(less, graph, [Filter, Sink]), out, 1e-3)[-1:]
    assert difference.line() == (
        '/out: missing, first in message 2 at 0.215000 s: it is missing, expected a '
        'message; 2 messages, expected 20')


def test_processes_share_one_interpreter(bag, graph):
    """A node that computes in Python waits for the others, even if it is of another process."""
    text = GRAPH.replace('execution_time: 10ms', 'execution_time: 90ms, holds_interpreter: true')
    text = text.replace('execution_time: 5ms', 'execution_time: 60ms, holds_interpreter: true')
    graph.write_text(text)
    expected = rerun(bag, graph, [Filter, Sink])
    graph.write_text(f'{text}\nprocesses:\n  one: [/driver, /filter]\n  two: [/sink]\n')
    found = rerun(bag, graph, [Filter, Sink])
    assert found.digest == expected.digest
    assert [warning.split(': ')[1] for warning in found.warnings] == ['processes']


IMPORTANT = """\
mddag: 1
workers: 1
nodes:
  - node: /filter
    callbacks:
      - {name: important, subscription: /points, period: 100ms, dag: important, importance: high,
         execution_time: 60ms, deadline: 70ms, on_late: demote}
      - {name: other, subscription: /others, period: 140ms, dag: other, importance: low,
         execution_time: 70ms, deadline: 140ms, on_late: demote}
"""


def test_less_important_work_does_not_wait_for_what_may_come(tmp_path, graph):
    """Though the load is too high, and it would delay the important job of 600 ms."""
    graph.write_text(IMPORTANT)
    bag = write_bag(tmp_path / 'in.mcap', [
        *((i * 100, '/points', Header()) for i in range(6)),
        *((ms, '/others', String()) for ms in (565, 2000))])

    def node():
        made = rclpy.create_node('filter')
        made.create_subscription(Header, '/points', lambda message: None, 10)
        publisher = made.create_publisher(String, '/done', 10)
        made.create_subscription(String, '/others', publisher.publish, 10)
        return made

    done = published(rerun(bag, graph, [node]), '/done')
    assert [round(time) for time, _ in done] == [635, 2070]


class SlowAtFirst(Filter):

    def take(self, message):
        super().take(message)
        if message.frame_id == '0':
            self.get_clock().sleep_for(Duration(nanoseconds=40 * MS))


def test_the_trace_replays_and_gives_the_times(bag, graph, tmp_path):
    """Those of a job count for releases within half a period, for others the medians."""
    trace = tmp_path / 'run.mcap'
    result = rerun(bag, graph, [SlowAtFirst, Sink], trace=trace)
    again = replay(trace)
    assert not again.warnings
    mine, theirs = result.result()['dags']['main'], again.result()['dags']['main']
    assert theirs['jobs'] == mine['jobs'] == 20
    assert again.result()['callbacks']['/sink:take']['cpu_ns'] == 20 * 5 * MS
    sink = theirs['sinks']['/sink:take']
    assert sink['response_ns'] == mine['sinks']['/sink:take']['response_ns']
    handles = {
        name: {handle for _, _, _, _, handle, *_ in TraceReader(trace).events({name})}
        for name in ('ros2:rcl_publisher_init', 'ros2:rclcpp_publish')}
    assert len(handles['ros2:rclcpp_publish'] & handles['ros2:rcl_publisher_init']) == 2
    graph.write_text(GRAPH.replace('10ms', '30ms'))
    longer = write_bag(tmp_path / 'longer.mcap', [
        (i * 100 + 40 * (i == 0), '/points', Header(frame_id=str(i))) for i in range(-2, 20)])
    result = rerun(longer, graph, [Filter, Sink], times=trace)
    assert [time for time, _ in published(result, '/filtered')] == [
        100.0 * i + (80 if i == 0 else 10) for i in range(-2, 20)]


@pytest.mark.parametrize('takes', [', execution_time: 10ms', ''])
def test_recorded_publications_belong_to_their_executions(bag, graph, tmp_path, takes):
    """Also if the next execution of the thread starts, or even ends, at that instant."""
    graph.write_text(GRAPH.replace(', execution_time: 10ms', takes).replace(
        ' execution_time: 5ms,', ''))
    trace = str(tmp_path / 'run.mcap')
    rerun(bag, graph, [Filter, Sink], workers=1, trace=trace)
    run = open_recording(trace)
    by = [run.task_set.vertices[v].name for v in run.publications['vertex'].tolist() if v >= 0]
    assert by == 20 * ['/filter:take', '/sink:take']


def test_tasks_have_the_names_of_their_functions(bag, graph, tmp_path):
    def plan():
        pass

    def take(node, number):
        node.executor.create_task(plan)

    trace = str(tmp_path / 'run.mcap')
    run_filter(bag, graph, take, Sink, trace=trace)
    run = open_recording(trace)
    names = {run.callback_name(each) for each in run.executions['callback'].tolist()}
    assert 'plan (task)' in {name.rpartition('.')[2] for name in names}
    assert not any('callback (task)' in name for name in names)


@pytest.mark.parametrize(('delay_ms', 'out_ms'), [(4, 24), (-4, 20)])
def test_messages_leave_at_the_end_and_take_their_recorded_time(bag, graph, delay_ms, out_ms):
    """Each callback takes 10 ms; what was recorded before a callback's end arrives at the end."""
    task_set = load(str(graph))
    recorded = Workload([0], [0], [0], [0, 10 * MS, 10 * MS], [0], [0],
                    delays=[0, delay_ms * MS], delay_base=[0], delay_stride=[0])
    jobs = Jobs(1, rows(RELEASES, 1))
    times = Durations(Tables.build(task_set), recorded, jobs)
    result = Rerun(MessageBag(bag), times, task_set, workers=2).run(
        lambda: programs([Filter, Sink]))
    assert [time for time, _ in published(result, '/filtered')][:2] == [10, 110]
    assert [time for time, _ in published(result, '/out')][:2] == [out_ms, 100 + out_ms]


def make_node(declared):
    """Return a node whose callbacks only publish what they declare."""
    node = rclpy.create_node(declared['node'][1:])
    for callback in declared['callbacks']:
        publishers = [node.create_publisher(Header, topic, 100)
                      for topic in callback.get('publishes', ())]

        def publish(message=None, publishers=publishers):
            for publisher in publishers:
                publisher.publish(Header())

        group = ReentrantCallbackGroup()
        if 'timer' in callback:
            node.create_timer(parse_duration(callback['timer']) / 1e9, publish, group)
        else:
            node.create_subscription(
                Header, callback['subscription'], publish, 100, callback_group=group)
    return node


@pytest.mark.parametrize('seed', range(6))
def test_callbacks_start_and_end_as_in_the_simulator(tmp_path, monkeypatch, seed):
    cpus, workers = (None, 1, 2)[seed % 3], 1 + seed % 2
    declared = yaml.safe_load(generate(Options(
        dags=(2, 4), vertices=(1, 5), or_share=1.0, utilisation=0.5, workers=workers, seed=seed)))
    for place, node in enumerate(declared['nodes']):
        for callback in node['callbacks']:
            callback['holds_interpreter'] = (place + seed) % 2 == 0
    task_set = loads(yaml.safe_dump(declared, sort_keys=False))
    simulated = simulate(
        task_set, periodic_workload(task_set, draw_execution_times(task_set, 0), 1000 * MS),
        SimulatorSettings('rad', (workers,), 1000 * MS, cpus=cpus, on_late='demote'),
        log=True).log
    bag = write_bag(tmp_path / 'in.mcap', [(ms, '/unused', String()) for ms in (0, 1000)])
    monkeypatch.setattr(Durations, 'first_release', lambda times, dag: START)
    trace = str(tmp_path / 'run.mcap')
    Rerun(*open_input(bag, task_set), task_set, workers=workers, cpus=cpus, trace=trace).run(
        lambda: programs([partial(make_node, node) for node in declared['nodes']]))
    found = [(int(row[name]) - START, int(row['vertex']), int(row['job']))
             for row in open_recording(trace).executions for name in ('start', 'end')]
    assert sorted(each for each in found if each[0] < 1000 * MS) == sorted(
        (time, vertex, job) for time, kind, _, _, vertex, job in simulated
        if time < 1000 * MS and kind in (STARTS, ENDS))


def test_timers_fire_at_their_virtual_times(bag, graph):
    def fill(node):
        def tick():
            node.note('first')
            left, past = timer.time_until_next_call(), timer.time_since_last_call()
            assert (left, past) == (timer.timer_period_ns, 0)
            if len(node.seen) == 3:
                timer.timer_period_ns = 500 * MS
            elif len(node.seen) == 5:
                timer.cancel()
                assert timer.time_until_next_call() is None
                other.cancel()
                other.reset()  # its period begins again

        timer = node.create_timer(0.03, tick)
        other = node.create_timer(0.7, lambda: node.note('other'))

    seen, _ = run_filter(bag, graph, fill=fill)
    assert seen == [(time, 'first') for time in (30, 60, 90, 120, 620)] + [(1320, 'other')]


def test_a_timer_that_is_reset_while_its_callback_waits_does_not_run(bag, graph):
    def fill(node):
        def feed():
            node.note('feed')
            watchdog.reset()

        def bark():
            node.note('bark')
            watchdog.cancel()
            feeding.cancel()

        feeding = node.create_timer(0.03, feed)
        watchdog = node.create_timer(0.03, bark)
        node.create_timer(0.1, feeding.cancel)

    seen, _ = run_filter(bag, graph, fill=fill)
    assert seen == [(30, 'feed'), (60, 'feed'), (90, 'feed'), (120, 'bark')]


def draw():
    """Return random numbers from all that makes any."""
    numbers = [random.random(), random.Random().random(), numpy.random.default_rng().random(),
               numpy.random.RandomState().random_sample(), uuid.uuid4()]
    random.seed()
    return [*numbers, random.random()]


def test_random_numbers_are_those_of_the_seed(bag, graph):
    seen = []
    for seed in (1, 1, 2):
        run_filter(bag, graph, lambda node, number: seen.append(draw()), seed=seed)
    for first, again, other in zip(*(zip(*seen[i:i + 20]) for i in (0, 20, 40))):
        assert len({*first}) == 20 and first == again and not {*first} & {*other}
    assert not {*draw()} & {each for some in seen for each in some}  # it is as before


def test_nothing_happens_in_a_pause_of_the_recording(tmp_path, graph):
    """The machine got its time when the robot was running already, 300 days later."""
    later = 300 * 24 * 3600 * 1000
    bag = write_bag(tmp_path / 'in.mcap', [
        (ms, '/points', Header(frame_id=str(ms))) for ms in (0, 100, later + 7, later + 107)])

    def fill(node):
        def sleep():
            for _ in range(3):
                node.get_clock().sleep_for(Duration(seconds=4))
                node.note('woken')

        node.create_timer(0.03, lambda: node.note('tick'), callback_group=node.group)
        threading.Thread(target=sleep, daemon=True).start()

    seen, result = run_filter(bag, graph, fill=fill)
    # At once, and then in the phase of before: 300 days are a multiple of 30 ms.
    assert [time for time, what in seen if what == 'tick'] == [
        30, 60, 90, later + 7, later + 30, later + 60, later + 90]
    assert [time for time, what in seen if what == 'woken'] == [4000, 8000, later + 7]
    assert result.warnings == [
        f'{bag}: timers do not fire in 1 pause of over a minute without any message']


def test_no_wait_is_none_in_a_pause_either(tmp_path, graph):
    """A callback that begins late in a pause polls, and ends at once."""
    bag = write_bag(tmp_path / 'in.mcap', [
        (ms, '/points', Header(frame_id=str(ms))) for ms in (0, 200_000)])
    graph.write_text(GRAPH.replace('execution_time: 10ms', 'execution_time: 15s'))

    class Polls(Sink):

        def take(self, message):
            threading.Event().wait(0)
            super().take(message)

    result = rerun(bag, graph, [Filter, Polls])
    assert published(result, '/out')[0][0] == 15_005


def test_a_message_is_as_it_was_published(bag, graph):
    """
    Who publishes may change a message afterwards, and who receives it has one of his own.

    Late subscriptions get what is latched.
    """
    received = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

    def fill(node):
        node.names = node.create_publisher(String, '/names', 10)
        node.message = String()
        node.create_publisher(String, '/map', latched).publish(String(data='a map'))

    def take(node, number):
        node.message.data = str(number)
        node.names.publish(node.message)
        node.message.data = 'changed'
        if number == 3:
            node.create_subscription(String, '/map', lambda m: node.note(m.data), latched)
            node.create_subscription(String, '/map', lambda m: node.note('?'), 10)

    def other():
        def take(message):
            received.append(message.data)
            message.data = 'mine'

        node = rclpy.create_node('other')
        node.create_subscription(String, '/names', take, 10)
        node.create_subscription(String, '/names', take, 10)
        return node

    seen, _ = run_filter(bag, graph, take, other, fill=fill)
    assert received == [str(i) for i in range(20) for _ in range(2)]
    assert [what for _, what in seen] == ['a map']


def test_a_failed_run_leaves_the_files_of_before(bag, graph, tmp_path):
    files = {name: tmp_path / f'{name}.mcap' for name in ('output', 'trace')}
    run_filter(bag, graph, **files)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(CallbackFailed, match='it raised ZeroDivisionError: .* at 0.000000 s'):
        run_filter(bag, graph, lambda node, number: 1 / number, overwrite=True, **files)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def write_chunks(path, count):
    """Write a bag whose messages are in chunks of their own."""
    with open(path, 'wb') as file:
        writer = Writer(file, chunk_size=1)
        writer.start(profile='ros2')
        schema = writer.register_schema(
            'std_msgs/msg/Header', 'ros2msg', definition(Header).encode())
        channel = writer.register_channel('/points', 'cdr', schema)
        for i in range(count):
            at = START + i * 100 * MS
            writer.add_message(channel, at, serialize_message(Header(frame_id=str(i))), at)
        writer.finish()
    return str(path)


def test_a_trace_that_cannot_be_written_is_an_error(bag, graph, tmp_path):
    """It is written at the end: until then its events fill no chunk."""
    path, before = tmp_path / 'run.mcap', resource.getrlimit(resource.RLIMIT_FSIZE)

    def take(node, number):
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000, before[1]))

    try:
        with pytest.raises(TraceError, match=f'{path}: writing failed .File too large'):
            run_filter(bag, graph, take, trace=str(path))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not path.exists()


def test_damage_that_is_found_when_messages_are_loaded_is_said(tmp_path, graph):
    """The index of a bag does not show it, and messages are missing."""
    expected, path = (tmp_path / name for name in ('expected.mcap', 'drive.mcap'))
    write_chunks(path, 20)
    result = run_filter(path, graph, lambda node, i: node.publisher.publish(String()), fill=(
        lambda node: setattr(node, 'publisher', node.create_publisher(String, '/filtered', 10))),
        output=expected)[1]
    assert result.counts['/filtered'] == 20 and result.warnings == []
    for damaged in (path, expected):
        with open(damaged, 'rb') as file:
            chunks = make_reader(file).get_summary().chunk_indexes
        data = bytearray(damaged.read_bytes())
        chunk = chunks[len(chunks) // 2]
        data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0xFF
        damaged.write_bytes(data)
    seen, again = run_filter(path, graph, lambda node, i: node.note(i))
    assert 0 < len(seen) < 20
    assert [text for text in again.warnings if text.startswith(f'{path}: ') and 'chunk' in text]
    assert compare(result, expected)
    assert [text for text in result.warnings if text.startswith(f'{expected}: ')]


def test_a_topic_that_nodes_cannot_read_is_said_of_each_storage(tmp_path, graph):
    path = write(tmp_path / 'bag', {'/points': HEADER}, [
        ('/points', BEGIN + i * MS, header(BEGIN)) for i in range(3)], SQLITE) / 'bag.db3'
    with closing(sqlite3.connect(path)) as storage, storage:
        storage.execute("UPDATE topics SET serialization_format = 'json'")
    with pytest.raises(RerunError, match='/points is encoded as json, which ROS 2 nodes do not'):
        run_filter(path, graph)


def test_no_output_replaces_an_input(bag, graph):
    for name in ('output', 'trace'):
        with pytest.raises(UsageError, match=f'it cannot be both graph and {name}: name another'):
            rerun(bag, graph, [Filter], overwrite=True, **{name: graph})


def test_a_callback_that_awaits_asyncio_is_refused(bag, graph):
    async def sleep():
        await asyncio.sleep(0.01)

    with pytest.raises(CallbackFailed, match='a rerun does not run asyncio: leave this node out'):
        run_filter(bag, graph, fill=lambda node: node.create_timer(0.01, sleep))


def test_a_callback_destroys_its_node(bag, graph):
    def take(node, number):
        node.note(number)
        if number == 3:
            node.destroy_node()

    seen, _ = run_filter(bag, graph, take)
    assert [number for _, number in seen] == [0, 1, 2, 3]


def test_a_circle_that_takes_no_time(bag, graph, monkeypatch):
    monkeypatch.setattr('mddag_executor.rerun.loop.MOST_AT_ONCE', 500)

    def fill(node):
        node.round = node.create_publisher(Header, '/round', 10)
        node.create_subscription(Header, '/round', node.round.publish, 10)

    with pytest.raises(RerunError, match='virtual time does not advance after 0.010000 s'):
        run_filter(bag, graph, lambda node, number: node.round.publish(Header()), fill=fill)


# --- ordinary robots -------------------------------------------------------------------------

class Ticker(Node):
    """Publishes the number of the call, and the time, whenever its timer fires."""

    def __init__(self, name, topic, period):
        super().__init__(name)
        self.count = 0
        self.publisher = self.create_publisher(Header, topic, 10)
        self.create_timer(period, self.tick)

    def tick(self):
        self.publisher.publish(Header(
            stamp=self.get_clock().now().to_msg(), frame_id=str(self.count)))
        self.count += 1


class Sometimes(Filter):
    """Passes on only each so-manieth message."""

    def __init__(self, each):
        super().__init__()
        self.each = each

    def take(self, message):
        if int(message.frame_id) % self.each == 0:
            super().take(message)


def verdicts(result):
    return {name: (sink['completed'], sink['late'], sink['expired'], sink.get('not_due', 0))
            for dag in result['dags'].values() for name, sink in dag['sinks'].items()}


def test_what_is_published_sometimes_is_judged_when_it_is(tmp_path):
    """Also when the rerun publishes in other jobs than the recorded run did."""
    graph = loads(GRAPH.replace('publishes: [/filtered]', 'may_publish: [/filtered]'))
    driver, first, second = partial(Ticker, 'driver', '/points', 0.1), 'a.mcap', 'b.mcap'
    bag = write_bag(tmp_path / 'bag.mcap', [(ms, '/other', Header()) for ms in range(0, 2000, 50)])
    result = rerun(bag, graph, [driver, partial(Sometimes, 3), Sink],
                   trace=str(tmp_path / first)).result()
    completed, _, _, not_due = verdicts(result)['/sink:take']
    assert verdicts(result)['/sink:take'] == (completed, 0, 0, not_due)
    assert completed >= 6 and completed + not_due >= 19
    assert verdicts(replay(tmp_path / first).result()) == verdicts(result)
    result = rerun(str(tmp_path / first), graph, [driver, partial(Sometimes, 2), Sink],
                   trace=str(tmp_path / second)).result()
    assert verdicts(result)['/sink:take'][0] >= 9
    assert verdicts(result)['/sink:take'][1:3] == (0, 0)
    assert verdicts(replay(tmp_path / second).result()) == verdicts(result)


FUSED = """\
mddag: 1
workers: 2
nodes:
  - node: /driver
    callbacks:
      - {name: drive, timer: 100ms, publishes: [/points]}
  - node: /boxes
    callbacks:
      - {name: find, timer: 70ms, publishes: [/boxes], deadline: none}
  - node: /fusion
    callbacks:
      - name: fuse
        sync: {topics: [/points, /boxes], driven_by: /points}
        publishes: [/filtered]
        execution_time: 10ms
  - node: /sink
    callbacks:
      - {name: take, subscription: /filtered, execution_time: 5ms, deadline: 95ms}
"""


class Fusion(Node):
    """Fuses each scan with the next boxes."""

    def __init__(self):
        super().__init__('fusion')
        self.scan = None
        self.publisher = self.create_publisher(Header, '/filtered', 10)
        self.create_subscription(Header, '/points', self.take_points, 10)
        self.create_subscription(Header, '/boxes', self.take_boxes, 10)

    def take_points(self, scan):
        self.scan = scan

    def take_boxes(self, boxes):
        if self.scan is not None:
            self.publisher.publish(self.scan)
            self.scan = None


def test_a_sync_of_two_rates_answers_its_driving_messages(tmp_path):
    """Only the execution that fuses takes time; the wait for the boxes counts."""
    bag = write_bag(tmp_path / 'bag.mcap', [(ms, '/other', Header()) for ms in range(0, 2000, 50)])
    trace = tmp_path / 'a.mcap'
    result = rerun(
        bag, loads(FUSED), [partial(Ticker, 'driver', '/points', 0.1),
                            partial(Ticker, 'boxes', '/boxes', 0.07), Fusion, Sink],
        trace=str(trace)).result()
    sink = result['dags']['/driver']['sinks']['/sink:take']
    assert sink['completed'] >= 18
    assert (sink['late'], sink['expired']) == (0, 0)
    # the boxes come at most 70 ms after the scan
    assert 15 * MS < sink['response_ns']['max'] <= 85 * MS
    assert verdicts(replay(trace).result()) == verdicts(result)


def test_timers_of_a_recorded_run_do_not_fire_while_its_programs_started(tmp_path):
    """They did not in that run: those that were due by then fired once."""
    text = 'mddag: 1\nnodes: [{node: /n, callbacks: [{name: work, timer: 100ms, deadline: 90ms}]}]'
    trace = Written(tmp_path / 'run.mcap', text)
    trace.add('rcl_node_init', 1000, 1, 1, 'n', '/')
    trace.add('rcl_timer_init', 1005, 2, 100 * MS)
    for job in range(5):
        trace.release(0, job, 1090 + 100 * job)
        trace.run(0, 0, job, 1090 + 100 * job, 1091 + 100 * job)
    path, fired = trace.end(1500), {'work': [], 'other': []}

    class Worker(Node):
        def __init__(self):
            super().__init__('n')
            for name, period in ('work', 0.1), ('other', 0.02):
                self.create_timer(period, partial(self.note, name))

        def note(self, name):
            fired[name].append((self.get_clock().now().nanoseconds - ns(0)) // MS)

    rerun(path, loads(text), [Worker])
    assert fired == {'work': [1090 + 100 * job for job in range(5)],
                     'other': [1005, *range(1020, 1500, 20)]}
