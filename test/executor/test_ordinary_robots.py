# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What ordinary robots do: publish sometimes, store values, start once, wait for a button."""

from contextlib import contextmanager
from functools import partial
from itertools import count
from random import Random
import threading
import time

from mddag_executor import replay, reschedule
from mddag_executor.analysis.drafting import LEAST_COPIED, System
from mddag_executor.errors import InputError
from mddag_executor.executor import current_job
from mddag_executor.report.live_runs import live_lines
from mddag_executor.report.replays import summary
from mddag_executor.trace import TraceFile, TraceReader
from msg_graph import GraphError, loads
from msg_graph.draft import accept, declaration_of
import pytest
from std_msgs.msg import Header

from .conftest import is_idle, Spinning, wait_for
from .declared import Declared, graph

ROBOT = graph(
    camera='name: grab, timer: 20ms, publishes: [/image], dag: vision',
    detector="""
        name: detect, subscription: /image, publishes: [/seen], may_publish: [/alarm]
        name: start, timer: 30ms, once: true, dag: start, deadline: 5s""",
    planner='name: plan, subscription: /alarm, publishes: [/stop]',
    brake='name: stop, subscription: /stop, deadline: 5s',
    fuse='name: fuse, sync: [/seen, /alarm], deadline: 5s',
    store='name: store, subscription: /seen, deadline: none',
    panel='name: press, subscription: /button, period: 10ms, sporadic: true, deadline: 1s')
FINDS_IN = 3


def detect():
    """Find something in each third job."""
    return frozenset() if current_job().job % FINDS_IN == 0 else frozenset(['/alarm'])


def verdicts(result):
    return {name: (sink['completed'], sink.get('not_due', 0), sink['late'], sink['expired'])
            for dag in result['dags'].values() for name, sink in dag['sinks'].items()}


@contextmanager
def run_robot(make_executor, make_node, text, path, start=lambda: None):
    """
    Record 30 jobs of the robot; give it and its executor, which spins still and is idle.

    :param start: called by the callback that runs once, which cancels its timer then.
    """
    def start_once():
        start()
        robot.timers[1].cancel()

    robot = Declared(make_node, ROBOT, {'detect': detect, 'start': start_once})
    executor = make_executor(loads(text), num_workers=3, trace=str(path))
    with Spinning(executor):
        robot.start(executor)
        assert wait_for(lambda: len(robot.ran['detect']) >= 30)
        robot.cancel()
        assert wait_for(lambda: is_idle(executor))
        yield robot, executor
    executor.shutdown()


def test_results_that_nothing_was_published_for_are_not_due(make_executor, make_node, tmp_path):
    """They are not missed, live, as recorded or rescheduled; a silent job ends at once."""
    path = tmp_path / 'run.mcap'
    started = []
    with run_robot(make_executor, make_node, ROBOT, path, partial(started.append, 1)) as (
            robot, executor):
        ends = executor.statistics()['dags']['vision']['ends']
        # no job waits for a message that does not come
        assert sum(ends.values()) == executor.statistics()['dags']['vision']['jobs']
    statistics = executor.statistics()
    jobs = [job.job for job in robot.jobs('detect')]
    found = sum(job % FINDS_IN == 0 for job in jobs)
    assert (started, found > 5) == ([1], True)
    skipped = statistics['dags']['vision']['jobs'] - len(jobs)  # releases, on a busy machine
    live = verdicts(statistics)
    assert live == {
        '/brake:stop': (found, len(jobs) - found, 0, skipped),
        '/fuse:fuse': (found, len(jobs) - found, 0, skipped),
        '/detector:start': (1, 0, 0, 0), '/panel:press': (0, 0, 0, 0)}
    assert statistics['dags']['vision']['ends']['completed'] == len(jobs)
    assert statistics['unattributed'] == {'unknown': 0, 'doubtful': 0}
    assert len(robot.ran['store']) == len(jobs)
    # in a run of several processes jobs may end elsewhere: what is not due is not missing
    assert 'did not come' not in ''.join(
        live_lines({**statistics, 'measured': None, 'processes': []}))
    recorded = replay(path).result()
    assert verdicts(recorded) == live
    # of the jobs of a busy machine, dropped ones run in the rescheduled run, skipped ones do not
    again = verdicts(reschedule(path, workers=3).result())  # as many: all must end in time
    for name, (completed, not_due, late, expired) in again.items():
        assert (completed + expired, not_due, late) == (
            live[name][0] + live[name][3], *live[name][1:3]), name
        assert expired <= live[name][3], name


PLAIN = ROBOT.replace(
    'publishes: [/seen], may_publish: [/alarm]', 'publishes: [/seen, /alarm]').replace(
    'once: true, ', '')


@pytest.mark.parametrize('text', [ROBOT, PLAIN], ids=['declared so', 'declared plainly'])
def test_the_draft_of_a_recording_knows_what_is_published_sometimes(
        make_executor, make_node, tmp_path, text):
    """Its verdict on the same recording has no miss, and keys that were declared stay."""
    path = tmp_path / 'run.mcap'
    with run_robot(make_executor, make_node, text, path):
        pass
    drafted = loads(declaration_of(System(path).draft(), accepted=True))
    found = {callback.name: callback for callback in drafted.callbacks}
    assert found['detect'].publishes == ('/seen', '/alarm')
    assert found['detect'].may_publish == ('/alarm',)
    assert (found['start'].once, found['grab'].once) == (True, False)
    assert not found['store'].judged
    results = verdicts(replay(path, drafted).result())
    assert results['/brake:stop'][1] > 5
    # a release may have been skipped on a busy machine
    assert results['/brake:stop'][2:] == results['/fuse:fuse'][2:]


LATE = graph(
    camera='name: grab, timer: 40ms, publishes: [/image], dag: vision',
    detector='name: detect, subscription: /image, may_publish: [/alarm]',
    brake='name: stop, subscription: /alarm, deadline: 1ms')


def test_a_result_is_not_reported_as_missed_while_it_may_not_be_due(make_executor, make_node):
    """The detector runs past the deadline of the brake: only an alarm makes that a miss."""
    def detect_slowly():
        time.sleep(0.005)
        return detect()

    missed = []
    robot = Declared(make_node, LATE, {'detect': detect_slowly})
    executor = make_executor(loads(LATE), on_deadline_miss=missed.append)
    with Spinning(executor):
        robot.start(executor)
        assert wait_for(lambda: len(robot.ran['detect']) >= 8)
        robot.cancel()
        assert wait_for(lambda: is_idle(executor))
    executor.shutdown()
    jobs = [job.job for job in robot.jobs('detect')]
    assert sorted(miss.job for miss in missed if miss.kind != 'expired') == [
        job for job in sorted(jobs) if job % FINDS_IN == 0]


FUSED = """
mddag: 1
nodes:
  - node: /lidar
    callbacks: [{name: read, timer: 30ms, publishes: [/points], dag: lidar}]
  - node: /camera
    callbacks: [{name: grab, timer: 20ms, publishes: [/image], dag: camera}]
  - node: /detector
    callbacks: [{name: detect, subscription: /image, publishes: [/boxes], deadline: 5s}]
  - node: /fusion
    callbacks:
      - name: fuse
        sync: {topics: [/boxes, /points], driven_by: /points}
        publishes: [/obstacles]
        may_publish: [/alarm]
  - node: /brake
    callbacks:
      - {name: stop, subscription: /obstacles, deadline: 5s}
      - {name: warn, subscription: /alarm, deadline: 5s}
"""


class Fusion:
    """
    Nodes of ``FUSED``: of three scans one is fused at once, one with the next boxes, one never.

    Every sixth scan, which is fused at once, makes an alarm.
    """

    images = 1      # that the camera publishes each time

    def __init__(self, make_node):
        self.ran = {'obstacles': [], 'alarm': []}
        self.waiting = None
        self.nodes = {name: make_node(name) for name in (
            'lidar', 'camera', 'detector', 'fusion', 'brake')}
        self.topics = {
            topic: self.nodes[node].create_publisher(Header, topic, 100) for node, topic in (
                ('lidar', '/points'), ('camera', '/image'), ('detector', '/boxes'),
                ('fusion', '/obstacles'), ('fusion', '/alarm'))}
        self.numbers = count()
        for node, topic, function in (
                ('detector', '/image', lambda message: self.topics['/boxes'].publish(message)),
                ('fusion', '/points', self.on_points), ('fusion', '/boxes', self.on_boxes),
                ('brake', '/obstacles', partial(self.note, 'obstacles')),
                ('brake', '/alarm', partial(self.note, 'alarm'))):
            self.nodes[node].create_subscription(Header, topic, function, 100)
        # a watchdog that never fires
        self.nodes['brake'].create_timer(0.01, lambda: None, autostart=False)
        self.timers = [
            self.nodes['lidar'].create_timer(
                0.03, lambda: self.topics['/points'].publish(self.scan()), autostart=False),
            self.nodes['camera'].create_timer(0.02, self.grab, autostart=False)]

    def grab(self):
        for _ in range(self.images):
            self.topics['/image'].publish(Header())

    def scan(self):
        return Header(frame_id=str(next(self.numbers)))

    def on_points(self, message):
        number = int(message.frame_id)
        self.waiting = message if number % 3 == 1 else None
        if number % 3 == 0:
            self.fuse(message)

    def on_boxes(self, _):
        if self.waiting is not None:
            self.fuse(self.waiting)
            self.waiting = None

    def fuse(self, message):
        if int(message.frame_id) % 6 == 0:
            self.topics['/alarm'].publish(message)
        self.topics['/obstacles'].publish(message)

    def note(self, what, message):
        job = current_job()
        self.ran[what].append((int(message.frame_id), -1 if job is None else job.job))


class Leaving(Fusion):
    """A thread publishes what is fused, and the callback waits for it."""

    def fuse(self, message):
        thread = threading.Thread(target=super().fuse, args=(message,))
        thread.start()
        thread.join()


class Pairing(Fusion):
    """
    Fuses each fourth boxes with the last scan but one, though the last one waits too.

    That is what message_filters does if that scan is nearer in time.
    """

    stamps = True

    def __init__(self, make_node):
        super().__init__(make_node)
        self.scans, self.heard = [], 0

    def scan(self):
        message = super().scan()
        message.stamp.sec = 1 + int(message.frame_id) if self.stamps else 0
        return message

    def on_points(self, message):
        self.scans.append(message)

    def on_boxes(self, _):
        self.heard += 1
        if self.heard % 4 == 0 and len(self.scans) > 1:
            scan = self.scans[-2]
            del self.scans[:-1]
            self.fuse(scan)


class Unstamped(Pairing):
    """The same without header stamps."""

    stamps = False


def run_fusion(make_executor, make_node, graph, path, kind=Fusion):
    robot = kind(make_node)
    executor = make_executor(graph, num_workers=2, trace=str(path))
    for node in robot.nodes.values():
        executor.add_node(node)
    assert wait_for(lambda: all(each.get_subscription_count() for each in robot.topics.values()))
    for timer in robot.timers:
        timer.reset()
    with Spinning(executor):
        # on a busy machine few boxes come, and from few results a draft concludes nothing
        assert wait_for(lambda: len(robot.ran['obstacles']) > 2 * LEAST_COPIED and any(
            n >= 24 and (n % 3 == 0 or kind not in (Fusion, Leaving))
            for n, _ in robot.ran['obstacles']))
        for timer in robot.timers:
            timer.cancel()
        assert wait_for(lambda: is_idle(executor))
    executor.shutdown()
    return robot, executor.statistics()


@pytest.mark.parametrize('kind', [Fusion, Leaving])
def test_a_sync_of_two_rates(make_executor, make_node, tmp_path, kind):
    """A result belongs to the scan whichever topic's callback makes it, and is judged once."""
    path = tmp_path / 'run.mcap'
    robot, statistics = run_fusion(make_executor, make_node, loads(FUSED), path, kind)
    scans = statistics['dags']['lidar']['jobs']
    assert all(n == job for each in robot.ran.values() for n, job in each) or scans > max(
        n for n, _ in robot.ran['obstacles']) + 1     # a skipped release, on a busy machine
    live = verdicts(statistics)
    # scans that were never fused complete with the next one
    assert live['/brake:stop'][0] > len(robot.ran['obstacles']) >= 9
    assert statistics['unattributed'] == {'unknown': 0, 'doubtful': 0}
    assert not any(each['unattributed'] for each in statistics['callbacks'].values())
    assert live['/brake:warn'][0] + live['/brake:warn'][1] == live['/brake:stop'][0]
    assert live['/brake:warn'][1] > 0
    recorded = replay(path)
    assert recorded.warnings == []
    assert verdicts(recorded.result()) == live
    # a timer that was cancelled while it waited runs there
    completed, _, late, _ = verdicts(reschedule(path, workers=2).result())['/brake:stop']
    assert (completed >= live['/brake:stop'][0], late) == (True, 0)


def test_the_stamp_of_a_result_says_which_of_several_messages_was_used(
        make_executor, make_node, tmp_path):
    """Then no result is a guess, live, as recorded, and in a run without declaration."""
    path, undeclared = tmp_path / 'run.mcap', tmp_path / 'undeclared.mcap'
    robot, statistics = run_fusion(make_executor, make_node, loads(FUSED), path, Pairing)
    last = robot.ran['obstacles'][-1][0]
    if not statistics['callbacks']['/lidar:read']['skipped']:   # else jobs have other numbers
        assert all(number == job for each in robot.ran.values() for number, job in each)
    live = verdicts(statistics)
    # on a busy machine one scan may be lost
    assert last + 1 - live['/brake:stop'][0] in (0, 1)
    assert not any(each['guessed'] for each in statistics['callbacks'].values())
    assert verdicts(result := replay(path).result()) == live
    assert 'guessed' not in result
    robot, _ = run_fusion(make_executor, make_node, None, undeclared, Pairing)
    result = replay(undeclared, loads(FUSED)).result()
    assert robot.ran['obstacles'][-1][0] + 1 - verdicts(result)['/brake:stop'][0] in (0, 1)
    assert 'guessed' not in result


def test_results_that_may_belong_to_another_message_are_counted(
        make_executor, make_node, tmp_path):
    """Without header stamps they count for the newest one, live and as recorded, and are named."""
    path, undeclared = tmp_path / 'run.mcap', tmp_path / 'undeclared.mcap'
    robot, statistics = run_fusion(make_executor, make_node, loads(FUSED), path, Unstamped)
    guessed = {name: each['guessed'] for name, each in statistics['callbacks'].items()
               if each['guessed']}
    # on a busy machine one of them may be the only one that waits
    assert 5 < guessed['/fusion:fuse'] <= len(robot.ran['obstacles'])
    assert verdicts(statistics)['/brake:stop'][0] > robot.ran['obstacles'][-1][0] + 1
    result = replay(path).result()
    assert (verdicts(result), result['guessed']) == (verdicts(statistics), guessed)
    line = (f'{guessed["/fusion:fuse"]} results of a sync with driven_by counted for the newest '
            'of several messages that waited, as no header stamp says which one was used: '
            f'/fusion:fuse {guessed["/fusion:fuse"]}')
    assert line in [*summary(result)]
    assert line in [*live_lines({**statistics, 'measured': None})]
    robot, _ = run_fusion(make_executor, make_node, None, undeclared, Unstamped)
    result = replay(undeclared, loads(FUSED)).result()
    assert 5 < result['guessed']['/fusion:fuse'] <= len(robot.ran['obstacles'])


def test_a_sync_of_two_rates_in_a_run_without_declaration(make_executor, make_node, tmp_path):
    """The same rule finds its results by the messages."""
    path = tmp_path / 'run.mcap'
    robot, _ = run_fusion(make_executor, make_node, None, path)
    found = verdicts(replay(path, loads(FUSED)).result())
    completed, _, late, _ = found['/brake:stop']
    # each scan until the last one that was fused, also those that never were by themselves
    last = max(number for number, _ in robot.ran['obstacles'])
    assert (last + 1 - completed in (0, 1), late) == (True, 0)
    assert sum(found['/brake:warn'][:2]) == completed and found['/brake:warn'][1] > 0


class Stamped(Fusion):
    """Two of three scans are fused, and the results have their header stamps."""

    def scan(self):
        message = super().scan()
        message.stamp.sec = 1 + int(message.frame_id)
        return message


@pytest.mark.parametrize('kind', [Stamped, Pairing])
def test_a_draft_knows_by_header_stamps_which_topic_drives_a_sync(
        make_executor, make_node, tmp_path, kind):
    """By the numbers of messages neither does, or only the callback of the other publishes."""
    path = tmp_path / 'run.mcap'
    run_fusion(make_executor, make_node, None, path, kind)
    text = declaration_of(System(path).draft(), accepted=True)
    assert 'driven_by: /points}  # proposed: /obstacles has the header stamps of /points' in text
    assert text.count('it never fired') == 1    # of the watchdog
    result = replay(path, loads(text)).result()
    assert any(completed > 20 for name, (completed, *_) in verdicts(result).items()
               if name.startswith('/brake'))


def test_the_draft_of_a_run_without_declaration_knows_the_patterns(
        make_executor, make_node, tmp_path, monkeypatch):
    """Its verdict on the same recording has no false miss: only skipped releases expire."""
    def on_points(self, message):
        self.on_boxes(None)     # on a busy machine no boxes came since the last scan
        self.waiting = message
        if int(message.frame_id) % 3 == 0:
            self.on_boxes(None)

    monkeypatch.setattr(Fusion, 'on_points', on_points)
    # the rates differ as well on a busy machine, which skips releases
    monkeypatch.setattr(Fusion, 'images', 3)
    path = tmp_path / 'run.mcap'
    robot, statistics = run_fusion(make_executor, make_node, None, path)
    draft = System(path).draft()
    accept(draft)
    drafted = loads(declaration_of(draft, accepted=True).replace('deadline: ', 'deadline: 9s  # '))
    fuse, = [each for each in drafted.callbacks if each.node == '/fusion']
    assert (fuse.topics, fuse.driven_by) == (('/points', '/boxes'), '/points')
    assert (fuse.publishes, fuse.may_publish) == (('/obstacles', '/alarm'), ('/alarm',))
    skipped = sum(each['skipped'] for each in statistics['callbacks'].values())
    found = verdicts(replay(path, drafted).result())
    for name, (completed, _, late, expired) in found.items():
        assert (completed > 0, late, expired <= skipped) == (True, 0, True), name


class Stereo:
    """Pairs messages with equal stamps, and has timers that are reset, again and again or once."""

    def __init__(self, make_node):
        self.nodes = {name: make_node(name) for name in ('camera', 'matcher', 'dog')}
        camera, matcher, dog = self.nodes.values()
        self.sides = [camera.create_publisher(Header, f'/{side}', 10) for side in 'lr']
        self.cloud = matcher.create_publisher(Header, '/cloud', 10)
        self.waiting, self.pairs, self.barks = None, 0, 0
        for side in 'lr':
            matcher.create_subscription(Header, f'/{side}', self.match, 10)
        dog.create_subscription(Header, '/cloud', self.on_cloud, 10)
        self.dogs = [dog.create_timer(period, bark) for period, bark in (
            (0.025, self.bark), (1.0, self.late_bark))]
        self.timer = camera.create_timer(0.04, self.grab)
        self.numbers = count()

    def grab(self):
        stamp = Header(stamp=self.nodes['camera'].get_clock().now().to_msg())
        for side in self.sides[::(-1) ** next(self.numbers)]:
            side.publish(stamp)

    def match(self, message):
        if self.waiting != message:
            self.waiting = message
        else:
            self.cloud.publish(message)
            self.pairs += 1

    def on_cloud(self, _):
        for dog in self.dogs[:1 if self.pairs > 8 else 2]:
            dog.reset()

    def bark(self):
        self.barks += 1

    def late_bark(self):
        self.dogs[1].cancel()


def test_a_draft_knows_a_sync_of_one_rate_and_timers_that_are_reset(
        make_executor, make_node, tmp_path):
    path = tmp_path / 'run.mcap'
    robot = Stereo(make_node)
    executor = make_executor(None, num_workers=2, trace=str(path))
    for node in robot.nodes.values():
        executor.add_node(node)
    with Spinning(executor):
        assert wait_for(lambda: robot.barks > 30 and robot.dogs[1].is_canceled())
        robot.timer.cancel()
        assert wait_for(lambda: is_idle(executor))
    skipped = sum(each['skipped'] for each in executor.statistics()['callbacks'].values())
    executor.shutdown()
    text = declaration_of(System(path).draft(), accepted=True)
    assert 'sync: [/l, /r]  # proposed: /cloud has the header stamps of /l and /r' in text
    assert text.count('sporadic: true  # proposed: it was reset') == 2 and 'once' not in text, text
    found = replay(path, loads(text.replace('deadline: ', 'deadline: 9s  # '))).result()
    assert not found.get('drift')
    completed, not_due, late, expired = verdicts(found)['/dog:on_cloud']
    # the last pair may not have been complete, and a busy machine skips releases
    assert (robot.pairs - completed in (0, 1), not_due, late) == (True, 0, 0)
    assert expired <= 1 + skipped


MADE_AGAIN = graph(
    dock="""
        name: begin, timer: 50ms, deadline: 5s, dag: begin
        name: give_up, timer: 11ms, sporadic: true, deadline: 4s, dag: give_up
        name: retry, timer: 11ms, sporadic: true, deadline: 3s, dag: retry""")


class Dock:
    """Makes timers of one period in each step, each of which cancels itself or is destroyed."""

    def __init__(self, make_node):
        self.node = make_node('dock')
        self.fired = []
        self.step = self.made = 0
        self.node.create_timer(0.05, self.begin)

    def begin(self):
        if len(self.fired) < self.made:
            return  # on a busy machine; two timers at once would be two callbacks
        self.step += 1
        if self.step < 10:
            self.made += 1
            timers = []
            timers.append(self.node.create_timer(
                0.011, partial(self.retry if self.step % 3 else self.give_up, timers)))

    def give_up(self, timers):
        self.fired.append('give_up')
        timers[0].cancel()

    def retry(self, timers):
        self.fired.append('retry')
        timers[0].cancel()
        self.node.destroy_timer(timers[0])


@pytest.mark.parametrize('declared', [True, False], ids=['declared', 'undeclared'])
def test_a_timer_that_is_made_when_it_is_needed(make_executor, make_node, tmp_path, declared):
    """Each time that it fires is a job of its callback, live, as recorded, and in a draft."""
    path = tmp_path / 'run.mcap'
    robot = Dock(make_node)
    executor = make_executor(loads(MADE_AGAIN) if declared else None, trace=str(path))
    executor.add_node(robot.node)
    with Spinning(executor):
        assert wait_for(lambda: robot.step > 12, 30)
    expected = {name: robot.fired.count(name) for name in ('give_up', 'retry')}
    assert sum(expected.values()) > 5 and min(expected.values()) > 1
    draft = System(path).draft()
    accept(draft)
    text = declaration_of(draft, accepted=True)
    if not declared:
        rows = replay(path).result()['recorded_callbacks'].items()
        counts = [row['executions'] for name, row in rows if 'timer' in name]
        assert len(counts) == 3 and {*expected.values()} < {*counts}
    drafted = {callback.name: callback.sporadic for callback in loads(text).callbacks}
    assert drafted == {'begin': False, 'give_up': True, 'retry': True}
    results = [replay(path, loads(each)).result() for each in (
        MADE_AGAIN, text.replace('deadline: ', 'deadline: 9s  # '))]
    if declared:
        results.append(executor.statistics())
        assert not results[-1]['not_found']
    for result in results:
        # on a busy machine some are late
        assert {name.rpartition(':')[2]: found for name, (*found, _, _) in verdicts(result).items()
                if 'begin' not in name} == {name: [n, 0] for name, n in expected.items()}


def cut_anywhere(path, cut, seed):
    """Write a part of a recording: to some event, and without the begins of some entities."""
    random = Random(seed)
    events = [*TraceReader(path).events()]
    gone = {event[4] for event in events if event[0] == 'ros2:rcl_node_init'
            and random.random() < 0.15}
    first = next(i for i, event in enumerate(events) if event[0] == 'ros2:callback_start')
    until = random.randrange(20, first + 60 if seed % 2 else len(events))
    with TraceFile(cut, overwrite=True) as file:
        for name, time_, pid, tid, *fields in events[:until]:
            if name not in ('ros2:rcl_node_init', 'ros2:rclcpp_timer_link_node') or not (
                    gone.intersection(fields)):
                file.add(name, time_, pid, tid, *fields)


@pytest.mark.parametrize('declared', [True, False], ids=['declared', 'undeclared'])
def test_a_draft_of_a_part_of_a_recording_is_valid(make_executor, make_node, tmp_path, declared):
    """Also of a cut one, and of one that began after some nodes."""
    path, cut = tmp_path / 'run.mcap', tmp_path / 'cut.mcap'
    run_fusion(make_executor, make_node, loads(READS) if declared else None, path, Reading)
    n_valid = 0
    for seed in range(60):
        cut_anywhere(path, cut, seed)
        try:
            draft = System(cut).draft()
        except InputError:      # no entities are left
            continue
        assert 'unknown' not in ''.join(declaration_errors(declaration_of(draft)))
        accept(draft)
        if draft.nodes:
            found = loads(declaration_of(draft, accepted=True))
            n_valid += 1
            if declared:
                wanted = {callback.key for callback in loads(READS).callbacks}
                # another timer of the brake, which never fires, is not declared
                assert {callback.key for callback in found.callbacks
                        if ':callback_' not in callback.key} <= wanted
    assert n_valid > 10


class Reading(Fusion):
    """A timer of the detector reads what its subscription stores, and the obstacles."""

    def __init__(self, make_node):
        super().__init__(make_node)
        self.nodes['detector'].create_timer(0.01, lambda: None)


READS = FUSED.replace('deadline: 5s}]\n  - node: /fusion', """deadline: 5s},
                {name: watch, timer: 10ms, reads: [detect, /obstacles], deadline: none}]
  - node: /fusion""") + """
paths:
  - {name: seen, callbacks: ['/camera:grab', '/detector:detect', '/detector:watch'], age: 9s}
"""


def declaration_errors(text):
    """Return the errors of a drafted declaration, but for its blanks."""
    try:
        loads(text.replace('FILL IN', 'fill in'))
    except GraphError as error:
        return [str(each) for each in error.errors]
    return []
