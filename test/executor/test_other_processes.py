# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Which publication a message comes from, and which job: within a process, and over several."""

from contextlib import ExitStack
import time

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.executor.announcements import _ENTRY
from mddag_executor.executor.attribution import (
    Announced,
    Attribution,
    header_stamp,
    Origin,
    Publication,
    PublisherNumbers,
    PublisherState,
    ROUNDING_NS,
)
from mddag_executor.executor.silences import _ENTRY as _SILENCE
from mddag_executor.executor.silences import Silences
from mddag_executor.executor.work import Work
from msg_graph import loads
import pytest
from std_msgs.msg import Header, UInt8MultiArray

from .conftest import is_idle, matched, Spinning, wait_for
from .declared import Declared, graph
from .inside import engine_of, pool_of, registry_of

MS = 1_000_000


def run_in(make_executor, make_node, text, processes, named=True, bodies=None):
    """Run 20 jobs or more over several executors, as in processes; return nodes and executors."""
    nodes = Declared(make_node, text, bodies, reentrant=False)
    if named:
        text += 'processes:\n' + ''.join(
            f'  {name}: [{", ".join("/" + node for node in here.split())}]\n'
            for name, here in processes.items())
    executors = []
    for name, here in processes.items():
        executors.append(make_executor(
            loads(text), nodes=[nodes.nodes[node] for node in here.split()],
            **({'process': name} if named else {})))
    legs = 2 if named else 1
    with ExitStack() as stack:
        for executor in executors:
            stack.enter_context(Spinning(executor))
        assert wait_for(lambda: nodes.connected() and not any(e.unmatched() for e in executors))
        nodes.start(*executors)
        assert wait_for(lambda: len(nodes.ran['sink']) >= legs * 20)
        nodes.cancel()
        assert wait_for(lambda: len(nodes.ran['sink']) == legs * len(nodes.ran['tick'])
                        and all(map(is_idle, executors)))
    for executor in executors:
        assert executor.statistics()['undeclared'] == 0
    return nodes, executors


# --- by stamps -----------------------------------------------------------------------------------

CHAIN = graph(
    sensor='name: tick, timer: 20ms, publishes: [/raw], dag: chain, release_from: header_stamp',
    first='name: first, subscription: /raw, publishes: [/half]',
    second='name: second, subscription: /half, publishes: [/whole]',
    last='name: sink, subscription: /whole, deadline: 60s')


class Thing:
    """A message of an odd kind."""

    def __init__(self, **fields):
        self.__dict__.update(fields)


@pytest.mark.parametrize('message', [
    b'raw', Thing(), Thing(header=None), Thing(stamp=3.5), Thing(header=Thing(stamp='x')),
    Header(), Thing(stamp=Thing(sec=None, nanosec=1))])
def test_no_stamp(message):
    assert header_stamp(message) == -1


def stamped(nanoseconds):
    message = Header()
    message.stamp.sec, message.stamp.nanosec = divmod(nanoseconds, 1_000_000_000)
    return message


def test_stamps_of_a_header_and_of_a_message_that_has_one():
    header = stamped(3_000_000_007)
    assert header_stamp(header) == header_stamp(Thing(header=header)) == 3_000_000_007


def ends(executor):
    return executor.statistics()['dags']['chain']['ends']


def test_a_job_goes_on_in_another_executor_with_its_stamp_as_release(make_executor, make_node):
    nodes, (up, down) = run_in(
        make_executor, make_node, CHAIN, {'up': 'sensor first', 'down': 'second last'}, False,
        {'first': lambda: time.sleep(0.005)})   # messages arrive later than their stamps
    n = len(nodes.ran['tick'])
    for name in ('second', 'sink'):
        assert [each.job.job for each in nodes.ran[name]] == list(range(n))
        for each in nodes.ran[name]:
            assert abs(each.job.release_ns - each.stamp) < 2 * MS
    assert nodes.jobs_of_numbers('first') == nodes.jobs_of_numbers('tick')
    tick = up.statistics()['callbacks']['/sensor:tick']
    for executor, expired in ((up, tick['skipped'] + tick['dropped']), (down, 0)):  # if busy
        assert executor.statistics()['never_ran'] == []
        assert ends(executor) == {
            'completed': n, 'late': 0, 'expired': expired, 'failed': 0, 'dropped': 0}
    assert up.statistics()['dags']['chain']['sinks'] == {}
    sink = down.statistics()['dags']['chain']['sinks']['/last:sink']
    assert (sink['completed'], sink['late']) == (n, 0)
    assert not up.statistics()['deadline_missed']


def test_without_a_stamp_a_message_of_another_executor_has_no_job(make_executor, make_node):
    """Also in the same process: the jobs of the two are not the same."""
    text = CHAIN.replace(', release_from: header_stamp', '')
    nodes = Declared(make_node, text)
    here, there = (make_executor(loads(text), nodes=[nodes.nodes[n] for n in names.split()])
                   for names in ('sensor first', 'second last'))
    with Spinning(here), Spinning(there):
        nodes.start(here, there)
        assert wait_for(lambda: len(nodes.ran['second']) >= 5)
    assert None not in nodes.jobs('first') and {*nodes.jobs('second')} == {None}


def test_a_dag_leaves_and_comes_back_to_the_same_job(make_executor, make_node):
    nodes, (outer, inner) = run_in(
        make_executor, make_node, CHAIN, {'outer': 'sensor first last', 'inner': 'second'}, False)
    n = len(nodes.ran['tick'])
    # at home the release is the timer's due time, not the stamp
    assert nodes.jobs('sink') == nodes.jobs('first')
    assert {(b.release_ns - a.release_ns) % (20 * MS) for a, b in zip(
        nodes.jobs('sink')[1:], nodes.jobs('sink')[2:])} == {0}
    tick = outer.statistics()['callbacks']['/sensor:tick']
    assert outer.statistics()['dags']['chain']['jobs'] == (
        n + tick['skipped'] + tick['dropped'])  # if the machine is busy
    assert ends(outer)['completed'] == ends(inner)['completed'] == n


def test_messages_without_a_stamp_for_a_second_time_and_of_the_future(make_executor, make_node):
    nodes = Declared(make_node, CHAIN)
    executor = make_executor(
        loads(CHAIN), nodes=[nodes.nodes[name] for name in ('second', 'last')])
    half = make_node('elsewhere').create_publisher(Header, '/half', 50)

    def publish(message):
        """Return the jobs for which both callbacks run then."""
        count = len(nodes.ran['sink']) + 1
        half.publish(message)
        assert wait_for(lambda: len(nodes.ran['sink']) == count and is_idle(executor))
        return nodes.jobs('second')[-1], nodes.jobs('sink')[-1]

    with Spinning(executor):
        matched(half)
        assert wait_for(nodes.connected)
        assert publish(Header()) == (None, None)
        assert executor.statistics()['callbacks']['/second:second']['unattributed'] == 1
        stamp = time.time_ns()
        assert None not in publish(stamped(stamp))
        assert publish(stamped(stamp))[0] is None  # its job has ended
        assert executor.statistics()['dags']['chain']['jobs'] == 1
        # a stamp of the future cannot be a release
        before = time.time_ns()
        _, job = publish(stamped(before + 10_000 * MS))
        assert abs(job.release_ns - before) < 1000 * MS


def test_a_source_that_repeats_its_stamp_leaves_nothing_behind(make_executor, make_node):
    """As in simulated time that stands still: only the last job has the stamp."""
    text = CHAIN.replace('timer: 20ms', 'subscription: /echo, period: 20ms')
    nodes = Declared(make_node, text)
    executor = make_executor(loads(text), nodes=[nodes.nodes['sensor']])
    echo = make_node('elsewhere').create_publisher(Header, '/echo', 50)
    stamp = time.time_ns()
    with Spinning(executor):
        matched(echo)
        for count in range(1, 6):
            echo.publish(stamped(stamp))
            assert wait_for(lambda count=count: len(nodes.ran['tick']) == count)
    assert len({job.job for job in nodes.jobs('tick')}) == 5
    assert [*engine_of(executor).other_processes._stamps.values()] == [stamp]


# --- by announcements ----------------------------------------------------------------------------

GRAPH = graph(
    one='name: tick, timer: 20ms, publishes: [/left, /right], dag: main',
    two='name: two, subscription: /left, publishes: [/join_left]',
    three='name: three, subscription: /right, publishes: [/join_right]',
    four="""
        name: take, subscription: /join_left, publishes: [/end]
        name: take_too, subscription: /join_right, publishes: [/end]""",
    five='name: sink, subscription: /end, deadline: 60s')


def test_every_job_is_found_by_its_number(make_executor, make_node):
    """One leg leaves and comes back, one is here; the rest is elsewhere."""
    nodes, executors = run_in(
        make_executor, make_node, GRAPH, {'p1': 'one two four', 'p2': 'three', 'p3': 'five'})
    releases = {number: job.release_ns for number, job in nodes.jobs_of_numbers('tick').items()}
    for name, ran in nodes.ran.items():
        for each in ran:
            assert each.job is not None, (name, each)
            # each process has a trace clock of its own
            assert abs(each.job.release_ns - releases[each.number]) < 10 * MS, (name, each)
    for executor in executors:
        assert executor.statistics()['unattributed'] == {'unknown': 0, 'doubtful': 0}
    last = executors[-1].statistics()['dags']['main']
    assert sum(sink['completed'] for sink in last['sinks'].values()) == 2 * len(releases)


SOMETIMES = graph(
    camera='name: tick, timer: 20ms, publishes: [/image], dag: main',
    detector="""
        name: detect, subscription: /image, publishes: [/boxes], may_publish: [/alarm, /person]""",
    brake="""
        name: stop, subscription: /alarm, deadline: 60s
        name: greet, subscription: /person, deadline: 60s
        name: map, subscription: /boxes, deadline: 60s""")


def detected_sometimes(make_node, text, **bodies):
    """Return nodes; the detector publishes an alarm for one image of three, a person of two."""
    def left_out():
        n = len(nodes.ran['detect'])
        return frozenset(['/alarm'] * (n % 3 > 0) + ['/person'] * (n % 2))

    nodes = Declared(make_node, text, {'detect': left_out, **bodies}, reentrant=False)
    return nodes


def last_job(nodes, executors):
    """Let no timer start a job any more; return how many there are when the last one has run."""
    nodes.cancel()
    assert wait_for(lambda: len(nodes.ran['detect']) == len(nodes.ran['tick'])
                    and all(map(is_idle, executors)))
    return len(nodes.ran['detect'])


def check_not_due(executor, nodes, n):
    """Check that all of n jobs completed, and that what did not run was not due."""
    dag = executor.statistics()['dags']['main']
    for name in ('stop', 'greet'):
        sink, n_ran = dag['sinks'][f'/brake:{name}'], len(nodes.ran[name])
        assert (sink['completed'], sink['not_due']) == (n_ran, n - n_ran)
    assert dag['sinks']['/brake:map']['completed'] == n
    assert dag['ends']['completed'] == n


def test_a_result_that_another_process_did_not_ask_for_is_not_due(make_executor, make_node):
    """The detector is elsewhere: its jobs end where the brake is, and do not wait to expire."""
    nodes = detected_sometimes(make_node, SOMETIMES)
    text = loads(SOMETIMES + 'processes: {p1: [/camera, /detector], p2: [/brake]}')
    executors = [make_executor(text, process=process, nodes=[nodes.nodes[n] for n in here.split()])
                 for process, here in (('p1', 'camera detector'), ('p2', 'brake'))]
    with Spinning(executors[0]), Spinning(executors[1]):
        assert wait_for(lambda: nodes.connected() and not any(e.unmatched() for e in executors))
        nodes.start(*executors)
        assert wait_for(lambda: len(nodes.ran['stop']) >= 5)
        n = last_job(nodes, executors)
        # on a busy machine some wait when the timer is cancelled, and expire in both processes
        assert wait_for(lambda: executors[1].statistics()[
            'dags']['main']['ends']['completed'] == n)
    check_not_due(executors[1], nodes, n)


TWO = graph(
    one='name: tick, timer: 20ms, publishes: [/left], dag: main',
    two='name: two, subscription: /left, deadline: 60s')


def test_a_silence_about_a_job_that_has_nothing_here_opens_no_job(make_executor, make_node):
    text = SOMETIMES + """
  - node: /clock
    callbacks: [{name: tock, timer: 20ms, deadline: 60s, dag: other}]
processes: {p1: [/camera, /detector], p2: [/brake], p3: [/clock]}
"""
    nodes = Declared(make_node, text)
    executor = make_executor(loads(text), process='p3', nodes=[nodes.nodes['clock']])
    executor.unmatched()    # it notices which callbacks are here
    engine, now = engine_of(executor), time.time_ns()
    with pool_of(executor).lock:
        engine.hear_silent(Announced((1, 2), 0, 1, now), '/alarm', now)
    assert executor.statistics()['dags']['main']['jobs'] == 0


def test_jobs_that_expired_in_another_process_are_missed(make_executor, make_node):
    """A timer's release that is skipped where the timer is has no result in any process."""
    nodes = Declared(make_node, TWO, {'tick': lambda: len(nodes.ran['tick']) % 5 or time.sleep(
        0.2)}, reentrant=False)
    text = loads(TWO + 'processes: {p1: [/one], p2: [/two]}')
    up, down = (make_executor(text, process=process, nodes=[nodes.nodes[name]], max_active_jobs=8)
                for process, name in (('p1', 'one'), ('p2', 'two')))

    def dags():
        return [each.statistics()['dags']['main'] for each in (up, down)]

    with Spinning(up), Spinning(down):
        assert wait_for(lambda: nodes.connected() and not any(e.unmatched() for e in (up, down)))
        nodes.start(up, down)
        assert wait_for(lambda: dags()[0]['ends']['expired'] >= 3)
        nodes.cancel()
        assert wait_for(lambda: all(map(is_idle, (up, down))) and (
            dags()[0]['jobs'] == dags()[1]['jobs'] == sum(dags()[1]['ends'].values())))
    (here, there), n = dags(), len(nodes.ran['tick'])
    sink = there['sinks']['/two:two']
    assert sink['completed'] == len(nodes.ran['two']) == n
    assert sink['expired'] == here['ends']['expired'] == here['jobs'] - n
    assert down.statistics()['deadline_missed']


def test_messages_that_wait_for_their_announcements_are_checked_together(
        make_executor, make_node):
    """Even if each is announced soon, so that none waits when the next one comes."""
    nodes = Declared(make_node, TWO)
    executor = make_executor(
        loads(TWO + 'processes: {p1: [/one], p2: [/two]}'), process='p2',
        nodes=[nodes.nodes['two']])
    executor.unmatched()    # it notices which callbacks are here
    entity, = (each for each in registry_of(executor).by_id.values() if each.awaits)
    announcements, pool = executor._announcements, pool_of(executor)
    before = pool.agenda._appointments
    for _ in range(5):
        with pool.lock:
            announcements.receive(
                Work(entity, print), {'source_timestamp': time.time_ns()}, pool.tick())
            announcements._waiting.clear()
    assert pool.agenda._appointments == before + 1


def test_a_message_that_is_lost_on_its_way_to_another_process_is_missed(make_executor, make_node):
    text = TWO.replace('60s', '20ms')
    nodes = Declared(make_node, text)
    executor = make_executor(
        loads(text + 'processes: {p1: [/one], p2: [/two]}'), process='p2',
        nodes=[nodes.nodes['two']])
    with Spinning(executor):
        executor.unmatched()    # it notices which callbacks are here
        executor._announcements._hear(forged(executor, vertex=0))
        assert wait_for(lambda: executor.statistics()['deadline_missed'])
    executor.shutdown()     # it judges what is open
    dag = executor.statistics()['dags']['main']
    assert (dag['jobs'], dag['sinks']['/two:two']['overdue']) == (1, 1)


STAMPED = SOMETIMES.replace('dag: main', 'dag: main, release_from: header_stamp')
ANNOUNCED_TOO = STAMPED + """
  - node: /clock
    callbacks:
      - {name: tock, timer: 20ms, may_publish: [/tock], dag: other}
  - node: /hand
    callbacks:
      - {name: strike, subscription: /tock, deadline: 60s}
processes: {p1: [/camera, /detector, /clock], p2: [/brake, /hand]}
"""


@pytest.mark.parametrize('processes', [None, ('p1', 'p2')], ids=['machines', 'processes too'])
def test_a_result_that_another_machine_did_not_ask_for_is_not_due(
        make_executor, make_node, processes):
    """Jobs that are identified by the stamps of messages end without a message as well."""
    text = ANNOUNCED_TOO if processes else STAMPED
    nodes = detected_sometimes(make_node, text, tock=lambda: frozenset(['/tock']))
    here = [[n for n in names.split() if n in nodes.nodes]
            for names in ('camera detector clock', 'brake hand')]
    executors = [make_executor(loads(text), nodes=[nodes.nodes[n] for n in names], **(
        {'process': processes[i]} if processes else {})) for i, names in enumerate(here)]
    with Spinning(executors[0]), Spinning(executors[1]):
        assert wait_for(lambda: nodes.connected() and not any(e.unmatched() for e in executors))
        matched(*(silences._publisher for e in executors for silences in e._ending.announcements
                  if isinstance(silences, Silences)), count=2)
        nodes.start(*executors)
        assert wait_for(lambda: len(nodes.ran['stop']) >= 5)
        n = last_job(nodes, executors)
        assert wait_for(lambda: sum(
            executors[1].statistics()['dags']['main']['ends'].values()) == n)
    assert executors[1].statistics()['dags']['main']['jobs'] == n
    check_not_due(executors[1], nodes, n)
    # what the executors publish themselves is not published by the callback that runs next
    assert not [topic for e in executors for topics in e._registry.bindings.published().values()
                for topic in topics if topic.startswith('/mddag/')]


def test_a_result_is_due_if_another_machine_says_nothing(make_executor, make_node):
    """The machine with the detector may be dead: the results that it owes are missed."""
    text = STAMPED.replace('stop, subscription: /alarm, deadline: 60s',
                           'stop, subscription: /alarm, deadline: 20ms')
    nodes = Declared(make_node, text)
    executor = make_executor(loads(text), nodes=[nodes.nodes['brake']])
    boxes = make_node('elsewhere').create_publisher(Header, '/boxes', 10)
    with Spinning(executor):
        matched(boxes)
        stamp = time.time_ns()
        boxes.publish(stamped(stamp))
        assert wait_for(lambda: nodes.ran['map'] and time.time_ns() > stamp + 30 * MS)
    executor.shutdown()  # it judges what is open
    sinks = executor.statistics()['dags']['main']['sinks']
    assert sinks['/brake:map']['completed'] == 1
    assert (sinks['/brake:stop']['completed'], sinks['/brake:stop']['overdue']) == (0, 1)
    assert 'not_due' not in sinks['/brake:stop']


def test_forged_silences_are_ignored(make_executor, make_node):
    nodes = Declared(make_node, STAMPED)
    executor = make_executor(loads(STAMPED), nodes=[nodes.nodes['brake']])
    silences, = executor._ending.announcements
    executor.unmatched()  # it notices which callbacks are here
    now = time.time_ns()
    for stamp, dag, vertex, topic in (
            (now - 10**15, 0, 1, 0), (now + 10**15, 0, 1, 0), (now, 1, 1, 0), (now, -1, 1, 0),
            (now, 0, 99, 0), (now, 0, -1, 0), (now, 0, 1, 2), (now, 0, 0, 0)):
        silences._hear(UInt8MultiArray(data=_SILENCE.pack(stamp, dag, vertex, topic)))
    silences._hear(UInt8MultiArray(data=b'x' * 3))
    assert executor.statistics()['dags']['main']['jobs'] == 0
    silences._hear(UInt8MultiArray(data=_SILENCE.pack(now, 0, 1, 0)))
    assert executor.statistics()['dags']['main']['jobs'] == 1


def test_messages_without_announcement_wait_for_a_while_and_are_counted(make_executor, make_node):
    """Those of a stranger; and those on a topic on which two processes publish are a doubt."""
    text = GRAPH.replace('publishes: [/join_right]', 'publishes: [/join_left]').replace(
        '      - {name: take_too, subscription: /join_right, publishes: [/end]}\n', '')
    nodes = Declared(make_node, text)
    text += 'processes: {p1: [/one], p2: [/two, /four, /five], p3: [/three]}'
    executor = make_executor(
        loads(text), process='p2', nodes=[nodes.nodes[name] for name in ('two', 'four', 'five')])
    other = make_node('stranger')
    stranger, doubt = (other.create_publisher(Header, t, 10) for t in ('/left', '/join_left'))
    noise = other.create_publisher(
        UInt8MultiArray, executor._announcements.subscriptions[0].topic_name, 10)
    with Spinning(executor):
        matched(stranger, doubt, noise)
        for rubbish in (b'', b'x' * 3, b'\xff' * 80, b'\0' * 80):
            noise.publish(UInt8MultiArray(data=rubbish))
        doubt.publish(Header(frame_id='2'))
        assert wait_for(lambda: nodes.ran['take'])
        assert executor.statistics()['unattributed'] == {'unknown': 0, 'doubtful': 1}
        heard = []
        executor._announcements._note = lambda *entry: heard.append(entry)
        for wrong in FORGED:
            noise.publish(forged(executor, **wrong))
        noise.publish(forged(executor))
        assert wait_for(lambda: heard)
        assert len(heard) == 1  # they come in order
        stranger.publish(Header(frame_id='1'))
        assert wait_for(lambda: nodes.ran['two'])
    assert nodes.jobs_of_numbers('take')[2] is None
    assert nodes.jobs_of_numbers('two') == {1: None}
    statistics = executor.statistics()
    assert statistics['callbacks']['/two:two']['unattributed'] == 1
    assert statistics['unattributed']['unknown'] == 1


def forged(executor, count=1, topic='/left', back=0, dag=0, vertex=1):
    """Make an announcement as another process sends it, but with a release so long ago."""
    announcements = executor._announcements
    number = announcements._number.get(topic, 99)
    return UInt8MultiArray(data=_ENTRY.pack(
        7, 9, 1, time.time_ns() - 10**9, time.time_ns() + 10**10, 7, 1, time.monotonic_ns() - back,
        dag, vertex, number) * count)


# The release before the boot of the machine, and others that no executor sends.
FORGED = (
    {'back': 10**15}, {'back': -10**15}, {'back': 2**61}, {'vertex': -1}, {'vertex': 99},
    {'dag': 1}, {'topic': 'another'}, {'count': 257})


def test_a_flood_of_announcements_gets_a_small_part_of_the_time(make_executor, make_node):
    text = GRAPH + 'processes: {p1: [/one], p2: [/two, /three, /four, /five]}'
    executor = make_executor(loads(text), process='p2')
    announcements, heard = executor._announcements, []
    note, announcements._note = announcements._note, lambda *entry: heard.append(note(*entry))
    message = forged(executor, 256)
    for _ in range(2000):
        announcements._hear(message)
    assert 0 < len(heard) < 2000 * 256 // 2
    calls = pool_of(executor).unlocked_calls
    assert 'announcements of jobs are ignored' in calls.popleft().args[0] and not calls
    before = len(heard)
    assert wait_for(lambda: announcements._hear(message) or len(heard) > before)


# --- the windows of publications, and the numbers of publishers ----------------------------------

TOPIC = '/topic'
ONE_TOPIC = graph(
    n="""
        name: tick, timer: 10ms, publishes: [/topic]
        name: end, subscription: /topic, deadline: 5ms""")


class Bench:
    """Attribution 1, 2, … whose publications are given: begin, end, and one of two publishers."""

    def __init__(self, *publications):
        self.attribution = Attribution(loads(ONE_TOPIC))
        self.topic = self.attribution.topics[TOPIC]
        self.publishers = [PublisherState(TOPIC), PublisherState(TOPIC)]
        for job, publication in enumerate(publications, 1):
            self.published(job, *publication)

    def published(self, job, begin, end, publisher=0):
        state = self.publishers[publisher]
        state.count += 1
        publication = Publication(begin, state.numbers, Origin(0, 0, job, publisher), state.count)
        self.topic.publications.append(publication)
        publication.end = end

    def job(self, stamp, sequence=None):
        origin = self.attribution.find(TOPIC, stamp, sequence)
        return None if origin is None else origin.job


def test_the_sequence_number_decides_between_publishers():
    bench = Bench((0, 10), (1000, 1010, 1), (2000, 2010, 1), (3000, 3100), (3050, 3150, 1))
    assert [bench.job(3080, number) for number in (None, 2, 3, 9)] == [None, 4, 5, None]
    assert bench.attribution.doubtful == 2


def test_publications_before_the_count_began_are_learnt():
    """The middleware counts 100 more than we do for publisher 0; two messages in a row show it."""
    bench = Bench((0, 10))
    assert [bench.job(5, 101), bench.job(5, 101)] == [None, None]  # the same one
    bench.published(2, 20, 30)
    assert bench.job(25, 102) == 2
    bench.published(3, 100, 200)
    bench.published(4, 110, 210, publisher=1)
    assert [bench.job(150, 103), bench.job(150, 1)] == [3, 4]


def test_a_shift_of_known_numbers_is_learnt_of_four_messages_in_a_row():
    """Two or three that differ alike may be of another publisher."""
    bench = Bench((0, 10))
    assert bench.job(5, 1) == 1
    for job in range(2, 7):
        bench.published(job, job * 100, job * 100 + 10)
    assert [bench.job(job * 100 + 5, job + 7) for job in range(2, 6)] == [None, None, None, 5]
    assert [bench.job(605, number) for number in (6, 13)] == [None, 6]


def test_messages_that_come_after_that_of_their_publication_teach_nothing():
    bench = Bench(*((job * 100, job * 100 + 10) for job in range(6)))
    assert [bench.job(job * 100, job + 1) for job in range(6)] == [*range(1, 7)]
    assert [bench.job(job * 100 + 5, job + 8) for job in range(6)] == 6 * [None]


def test_numbers_are_known_as_well_of_a_message_that_fits_two_publications():
    bench = Bench((0, 10), (5, 15, 1), (100, 110), (200, 210))
    assert bench.job(7, 1) is None  # of which of both?
    assert [bench.job(105, 2), bench.job(205, 3)] == [3, 4]
    bench = Bench((0, 10), (5, 15, 1), (100, 110), (200, 210), (300, 310))
    bench.publishers[1].numbers.confirm(1, 9)
    assert bench.job(7, 1) == 1
    assert [bench.job(105, 12), bench.job(205, 13), bench.job(205, 3)] == [None, None, 4]


def test_messages_of_a_stranger_in_the_window_belong_to_no_job():
    """Whatever its numbers are, and however often they differ alike."""
    bench = Bench()
    for job in range(1, 100):
        bench.published(job, job * 1000, job * 1000 + 10)
        for number in (job + 7, 3 * job + 1):  # as fast, and faster
            assert bench.job(job * 1000 + 5, number) is None
        assert bench.job(job * 1000 + 6, job) == job
        assert bench.job(job * 1000 + 7, job + 7) is None, 'two within two publications'
    assert bench.attribution.unknown == 297


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
        bench.published(job, now, now + length, job % 2)
    stamp = data.draw(st.integers(0, now + 60))
    holds = [job for job, (begin, end) in enumerate(windows)
             if begin - ROUNDING_NS <= stamp <= end + ROUNDING_NS]
    assert bench.job(stamp) == (holds[0] if len(holds) == 1 else None)


def announced(bench, begin, end, number, sequence, publisher):
    bench.attribution.note_announced(TOPIC, Publication(
        begin, publisher, Announced((1, number), 0, 0, 0), sequence, end))


def number(bench, stamp, sequence=None):
    found = bench.attribution.find(TOPIC, stamp, sequence, counted=False)
    return found.name[1] if isinstance(found, Announced) else None


def test_a_publication_here_and_one_elsewhere_at_once_are_a_doubt_if_their_numbers_agree():
    bench, other = Bench((0, 10)), PublisherNumbers()
    announced(bench, 5, 15, 1, 9, other)
    assert bench.job(7, 1) == 1 and number(bench, 7, 9) == 1
    announced(bench, 5, 15, 1, 1, PublisherNumbers())
    assert bench.attribution.find(TOPIC, 7, 1) is None and bench.attribution.doubtful == 1


def test_publications_that_overlap_are_announced_together_when_all_have_returned():
    bench = Bench()
    announced_to = []
    bench.attribution.announce = lambda send, topic, several: announced_to.append(
        [each.origin.job for each in several])
    bench.attribution.announce_on({TOPIC})

    def publish(job, publisher, send=lambda: None):
        bench.attribution.publish(lambda *_: send(), None, None, bench.publishers[publisher],
                           bench.topic, Origin(0, 0, job, publisher))

    publish(1, 0)
    publish(2, 0, lambda: publish(3, 1))
    bench.attribution.announce_on(set())
    publish(4, 0)
    assert announced_to == [[1], [3, 2]]
