# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Which publication a message comes from: within a process, and over several."""

from contextlib import ExitStack

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.executor.jobs import (
    Announced,
    Jobs,
    Origin,
    Publication,
    PublisherNumbers,
    PublisherState,
    ROUNDING_NS,
)
import msg_graph
from msg_graph import loads
import pytest
from std_msgs.msg import Header, UInt8MultiArray

from .conftest import is_idle, Spinning, wait_for
from .declared import Declared

PERIOD_NS = 20_000_000
JOBS = 30
GRAPH = """
mddag: 1
nodes:
  - node: /one
    callbacks: [{name: tick, timer: 20ms, publishes: [/left, /right], dag: main}]
  - node: /two
    callbacks: [{name: two, subscription: /left, publishes: [/join_left]}]
  - node: /three
    callbacks: [{name: three, subscription: /right, publishes: [/join_right]}]
  - node: /four
    callbacks:
      - {name: take, subscription: /join_left, publishes: [/end]}
      - {name: take_too, subscription: /join_right, publishes: [/end]}
  - node: /five
    callbacks: [{name: sink, subscription: /end, deadline: 60s}]
"""


def split(make_executor, make_node, **processes):
    """Run JOBS jobs or more over several executors; return nodes and executors by process."""
    text = GRAPH + 'processes:\n' + ''.join(
        f'  {name}: [{", ".join("/" + node for node in nodes.split())}]\n'
        for name, nodes in processes.items())
    nodes = Declared(make_node, GRAPH, reentrant=False)
    executors = {name: make_executor(loads(text), process=name) for name in processes}
    for name, here in processes.items():
        for node in here.split():
            executors[name].add_node(nodes.nodes[node])
    with ExitStack() as stack:
        for executor in executors.values():
            stack.enter_context(Spinning(executor))
        assert wait_for(lambda: nodes.connected()
                        and not any(e.unmatched() for e in executors.values()))
        nodes.start(*executors.values())
        assert wait_for(lambda: len(nodes.ran['sink']) >= 2 * JOBS)
        nodes.cancel()
        assert wait_for(lambda: len(nodes.ran['sink']) == 2 * len(nodes.ran['tick'])
                        and all(map(is_idle, executors.values())))
    return nodes, executors


@pytest.mark.parametrize('processes', [
    {'p1': 'one four', 'p2': 'two three', 'p3': 'five'},  # it leaves and comes back
    {'p1': 'one two', 'p2': 'three four five'},  # one leg is here, and one is not
])
def test_every_job_is_found_by_its_number(make_executor, make_node, processes):
    nodes, executors = split(make_executor, make_node, **processes)
    releases = {number: job.release_ns for number, job in nodes.jobs_of_numbers('tick').items()}
    for name, ran in nodes.ran.items():
        for each in ran:
            assert each.job is not None, (name, each)
            # each process has a trace clock of its own
            assert abs(each.job.release_ns - releases[each.number]) < PERIOD_NS / 2, (name, each)
    for executor in executors.values():
        statistics = executor.statistics()
        assert statistics['undeclared'] == 0
        assert statistics['unattributed'] == {'unknown': 0, 'doubtful': 0}
    last = executors[list(processes)[-1]].statistics()['dags']['main']
    assert sum(sink['completed'] for sink in last['sinks'].values()) == 2 * len(releases)


def test_messages_without_announcement_wait_for_a_while_and_are_counted(make_executor, make_node):
    text = GRAPH + 'processes: {p1: [/one], p2: [/two, /three, /four, /five]}'
    nodes = Declared(make_node, GRAPH)
    executor = make_executor(loads(text), process='p2', nodes=[nodes.nodes['two']])
    stranger = make_node('stranger').create_publisher(Header, '/left', 10)
    noise = make_node('noise').create_publisher(
        UInt8MultiArray, executor._announcements.subscriptions[0].topic_name, 10)
    with Spinning(executor):
        assert wait_for(lambda: stranger.get_subscription_count() == 1)
        assert wait_for(lambda: noise.get_subscription_count() == 1)
        for rubbish in (b'', b'x' * 3, b'\xff' * 80, b'\0' * 80):
            noise.publish(UInt8MultiArray(data=rubbish))
        stranger.publish(Header(frame_id='1'))
        assert wait_for(lambda: nodes.ran['two'])
    assert nodes.jobs_of_numbers('two') == {1: None}
    statistics = executor.statistics()
    assert statistics['callbacks']['/two:two']['unattributed'] == 1
    assert statistics['unattributed']['unknown'] == 1


def test_what_several_processes_publish_on_one_topic_is_a_doubt(make_executor, make_node):
    text = GRAPH.replace('publishes: [/join_right]', 'publishes: [/join_left]').replace(
        '      - {name: take_too, subscription: /join_right, publishes: [/end]}\n', '')
    text += 'processes: {p1: [/one, /two], p2: [/three, /four, /five]}'
    nodes = Declared(make_node, text)
    executor = make_executor(
        loads(text), process='p2', nodes=[nodes.nodes[name] for name in ('three', 'four', 'five')])
    publisher = make_node('p').create_publisher(Header, '/join_left', 10)
    with Spinning(executor):
        assert wait_for(lambda: publisher.get_subscription_count() == 1)
        publisher.publish(Header(frame_id='1'))
        assert wait_for(lambda: nodes.ran['take'])
    assert nodes.jobs_of_numbers('take') == {1: None}
    assert executor.statistics()['unattributed'] == {'unknown': 0, 'doubtful': 1}


TOPIC = '/topic'
ONE_TOPIC = """
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: tick, timer: 10ms, publishes: [/topic]}
      - {name: end, subscription: /topic, deadline: 5ms}
"""


class Bench:
    """Jobs whose publications are given, with a publisher or two."""

    def __init__(self):
        self.jobs = Jobs(msg_graph.loads(ONE_TOPIC, 'g.yaml'))
        self.topic = self.jobs.topics[TOPIC]
        self.publishers = [PublisherState(TOPIC), PublisherState(TOPIC)]

    def published(self, begin, end, job, publisher=0):
        state = self.publishers[publisher]
        state.count += 1
        publication = Publication(begin, state.numbers, Origin(0, 0, job, publisher), state.count)
        self.topic.publications.append(publication)
        if end is not None:
            publication.end = end

    def job(self, stamp, sequence=None):
        origin = self.jobs.find(TOPIC, stamp, sequence)
        return None if origin is None else origin.job


def test_the_sequence_number_decides_between_publishers():
    bench = Bench()
    bench.published(0, 10, 1, publisher=0)
    bench.published(1000, 1010, 2, publisher=1)
    bench.published(2000, 2010, 3, publisher=1)
    bench.published(3000, 3100, 4, publisher=0)
    bench.published(3050, 3150, 5, publisher=1)
    assert bench.job(3080) is None, 'without a number the job is unknown'
    assert bench.jobs.doubtful == 1
    assert bench.job(3080, 2) == 4
    assert bench.job(3080, 3) == 5
    assert bench.job(3080, 9) is None
    assert bench.jobs.doubtful == 2


def test_publications_before_the_count_began_are_learnt():
    """The middleware counts 100 more than we do for publisher 0; two messages in a row show it."""
    bench = Bench()
    bench.published(0, 10, 1, publisher=0)
    assert bench.job(5, 101) is None
    assert bench.job(5, 101) is None, 'the same one'
    bench.published(20, 30, 2, publisher=0)
    assert bench.job(25, 102) == 2
    bench.published(100, 200, 3, publisher=0)
    bench.published(110, 210, 4, publisher=1)
    assert bench.job(150, 103) == 3
    assert bench.job(150, 1) == 4


def test_messages_of_a_stranger_in_the_window_belong_to_no_job():
    """Whatever its numbers are, and however often they differ alike."""
    bench = Bench()
    for job in range(1, 100):
        bench.published(job * 1000, job * 1000 + 10, job)
        for number in (job + 7, 3 * job + 1):  # as fast, and faster
            assert bench.job(job * 1000 + 5, number) is None
        assert bench.job(job * 1000 + 6, job) == job
        assert bench.job(job * 1000 + 7, job + 7) is None, 'two within two publications'
    assert bench.jobs.unknown == 297


@given(st.lists(st.tuples(st.integers(1, 50), st.integers(0, 40)), min_size=1, max_size=60),
       st.data())
def test_it_never_guesses(steps, data):
    """Against the definition: the answer is the only window with the stamp, or none."""
    bench = Bench()
    windows = []
    now = 0
    for job, (gap, length) in enumerate(steps):
        now += gap
        windows.append((now, now + length))
        bench.published(now, now + length, job, publisher=job % 2)
    stamp = data.draw(st.integers(0, now + 60))
    holds = [job for job, (begin, end) in enumerate(windows)
             if begin - ROUNDING_NS <= stamp <= end + ROUNDING_NS]
    assert bench.job(stamp) == (holds[0] if len(holds) == 1 else None)


# --- publications of other processes -------------------------------------------------------------


def announced(bench, begin, end, number, sequence, publisher):
    bench.jobs.take_in(TOPIC, Publication(
        begin, publisher, Announced((1, number), 0, 0, 0), sequence, end))


def number(bench, stamp, sequence=None):
    found = bench.jobs.find(TOPIC, stamp, sequence, counted=False)
    return found.name[1] if isinstance(found, Announced) else None


def test_a_publication_here_and_one_elsewhere_at_once_are_a_doubt_if_their_numbers_agree():
    bench, other = Bench(), PublisherNumbers()
    bench.published(0, 10, 5)
    announced(bench, 5, 15, 1, 9, other)
    assert bench.job(7, 1) == 5 and number(bench, 7, 9) == 1
    announced(bench, 5, 15, 1, 1, PublisherNumbers())
    assert bench.jobs.find(TOPIC, 7, 1) is None and bench.jobs.doubtful == 1


def test_publications_that_overlap_are_announced_together_when_all_have_returned():
    bench = Bench()
    announced_to = []
    bench.jobs.announce = lambda send, topic, several: announced_to.append(
        [each.origin.job for each in several])
    bench.jobs.announce_on({TOPIC})

    def publish(job, publisher, send=lambda: None):
        bench.jobs.publish(lambda *_: send(), None, None, bench.publishers[publisher],
                           bench.topic, Origin(0, 0, job, publisher))

    publish(1, 0)
    publish(2, 0, lambda: publish(3, 1))
    bench.jobs.announce_on(set())
    publish(4, 0)
    assert announced_to == [[1], [3, 2]]
