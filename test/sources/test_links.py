# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Links of imported recordings, rule by rule, and lost events that never go unsaid."""

from mddag_executor.analysis.drafting import System
from mddag_executor.sources.open import open_recording
from mddag_executor.trace.errors import TraceError
import numpy as np
import pytest

from .recorded import BEGIN, MS, Recorded, STYLES, US

CAMERA, DETECT = 11, 12         # callbacks
IMAGE = 100                     # publisher


class Links:
    """The executions of a recording, what they ran for, and its publications; ns since `BEGIN`."""

    def __init__(self, found):
        table, sent = found.executions, found.publications
        names = [found.names.name(number) for number in table['callback'].tolist()]
        start, end = ((table[name] - BEGIN).tolist() for name in ('start', 'end'))
        ended = np.flatnonzero(table['end'] >= 0)
        ended = ended[np.argsort(table['end'][ended], kind='stable')].tolist()
        self.runs = [(names[i], start[i], end[i]) for i in ended]
        self.links = [
            (name, at, None if message < 0 else int(sent['time'][message]) - BEGIN)
            for name, at, message in zip(names, start, table['message'].tolist())]
        publishers = found.names.publishers
        self.published_at = [
            (publishers[number].topic if number in publishers else '', time - BEGIN)
            for number, time in zip(sent['publisher'].tolist(), sent['time'].tolist())]


def linked(path):
    recording = open_recording(path)
    return Links(recording), [line.removeprefix(f'{path}: ') for line in recording.missing.lines()]


@pytest.fixture
def recorded(tmp_path):
    recorded = Recorded(tmp_path / 'recorded.mcap')
    recorded.node(1, '/camera')
    recorded.node(2, '/detector')
    recorded.timer(CAMERA, 1, 100 * MS)
    recorded.publisher(IMAGE, 1, '/image')
    recorded.subscription(DETECT, 2, '/image')
    return recorded


@pytest.mark.parametrize('publish, receive', [
    ('caret', 'caret'), *((style, 'take') for style in STYLES)])
def test_messages_between_threads(recorded, publish, receive):
    for k in range(3):
        at = (k + 1) * 100 * MS
        recorded.run(CAMERA, 1, at, at + 3 * MS)
        stamp = recorded.publish(IMAGE, 1, at + 1 * MS, style=publish)
        recorded.receive(DETECT, 2, at + 2 * MS, at + 9 * MS, stamp, style=receive)
    got, warnings = linked(recorded.write())
    assert warnings == []
    sent = 1 * MS if publish != 'rclpy' else 1 * MS + 5 * US
    assert [link for link in got.links if link[0].startswith('/detector')] == [
        ('/detector subscription /image', at + 2 * MS, at + sent)
        for at in (100 * MS, 200 * MS, 300 * MS)]
    assert got.runs[:2] == [
        ('/camera timer 100ms', 100 * MS, 103 * MS),
        ('/detector subscription /image', 102 * MS, 109 * MS)]
    assert len(got.runs) == 6
    assert got.published_at[0] == ('/image', 100 * MS + sent)


def test_the_subscriber_may_be_faster_than_the_tracer(recorded):
    recorded.run(CAMERA, 1, 100 * MS, 103 * MS)
    stamp = recorded.publish(IMAGE, 1, 101 * MS)
    # before the stamp is recorded, 20 us after the publication
    recorded.receive(DETECT, 2, 101 * MS + 15 * US, 101 * MS + 18 * US, stamp)
    got, warnings = linked(recorded.write())
    assert got.links[-1] == ('/detector subscription /image', 101 * MS + 15 * US, 101 * MS)
    assert warnings == []


@pytest.mark.parametrize('event', [
    ('ros2_hook:dds_write', 7), ('ros2_hook:take_type_erased', BEGIN, 7), ('dds:write_pre', 7, 8)])
def test_a_recording_from_before_humble_is_refused_in_one_line(recorded, event):
    recorded.run(CAMERA, 1, 100 * MS, 103 * MS)
    recorded.add(event[0], 101 * MS, 1, *event[1:])
    with pytest.raises(TraceError, match=r'd\.mcap: it was recorded before ROS 2 Humble, .*: '
                       'record'):
        linked(recorded.write())


def test_messages_within_a_process_by_address(recorded):
    recorded.subscription(13, 2, '/image', within=14)
    for at, original in ((100 * MS, 0x500), (200 * MS, 0x500)):     # the address is used again
        recorded.run(CAMERA, 1, at, at + 3 * MS)
        recorded.add('ros2:rclcpp_intra_publish', at + MS, 1, IMAGE, original)
        recorded.add('ros2:message_construct', at + MS + 1, 1, original, 0x600)
        recorded.add('ros2:dispatch_intra_process_subscription_callback', at + 2 * MS, 2, 0x600,
                     14, 0)
        recorded.run(14, 2, at + 2 * MS + 1, at + 5 * MS, within=True)
    got, warnings = linked(recorded.write())
    assert warnings == []
    label = '/detector subscription /image #2'      # both callbacks of the subscription are one
    assert [link for link in got.links if link[0] == label] == [
        (label, at + 2 * MS + 1, at + MS) for at in (100 * MS, 200 * MS)]


def test_messages_within_a_process_by_buffer_and_index(recorded):
    label = '/detector subscription /image'
    for k in range(4):
        at = (k + 1) * 100 * MS
        recorded.run(CAMERA, 1, at, at + 3 * MS)
        recorded.add('ros2:rclcpp_intra_publish', at + MS, 1, IMAGE, 0x500)
        recorded.add('ros2:rclcpp_ring_buffer_enqueue', at + MS + 1, 1, 0xB, k % 2, 1, 0)
        # and to other processes: the same publication
        recorded.add('ros2:rclcpp_publish', at + MS + 2, 1, IMAGE, 0x500, 0)
    for k in range(2):      # two wait at a time: the first two are taken after the second
        at = 200 * MS + (k + 2) * MS
        recorded.add('ros2:rclcpp_ring_buffer_dequeue', at, 2, 0xB, k, 1)
        recorded.run(DETECT, 2, at + 1, at + 2, within=True)
    got, warnings = linked(recorded.write())
    assert [link for link in got.links if link[0] == label] == [
        (label, 202 * MS + 1, 101 * MS), (label, 203 * MS + 1, 201 * MS)]
    assert len(got.published_at) == 4
    assert warnings == []


def test_overwritten_messages_are_said(recorded):
    for at, overwritten in ((100 * MS, 0), (200 * MS, 1)):
        recorded.run(CAMERA, 1, at, at + 3 * MS)
        recorded.add('ros2:rclcpp_intra_publish', at + MS, 1, IMAGE, 0x500)
        recorded.add('ros2:rclcpp_ring_buffer_enqueue', at + MS + 1, 1, 0xB, 0, 1, overwritten)
    recorded.add('ros2:rclcpp_ring_buffer_dequeue', 204 * MS, 2, 0xB, 0, 0)
    recorded.run(DETECT, 2, 205 * MS, 206 * MS, within=True)
    got, warnings = linked(recorded.write())
    assert got.links[-1][2] == 201 * MS
    assert warnings == ['1 message overwritten in a ring buffer, never taken: /image (1)']


def test_a_callback_inside_another(recorded):
    recorded.timer(13, 2, 10 * MS)
    recorded.run(CAMERA, 1, 100 * MS, 130 * MS)
    recorded.run(13, 1, 110 * MS, 120 * MS)
    recorded.publish(IMAGE, 1, 125 * MS)
    got, warnings = linked(recorded.write())
    assert sorted(run[1:] for run in got.runs) == [
        (100 * MS, 130 * MS), (110 * MS, 120 * MS)]
    assert warnings == []


def test_addresses_are_used_again(recorded):
    recorded.node(3, '/late', time=400 * MS)
    recorded.timer(DETECT, 3, 20 * MS, time=401 * MS)       # the address of the detector's
    recorded.run(DETECT, 1, 300 * MS, 301 * MS)
    recorded.run(DETECT, 1, 421 * MS, 422 * MS)
    # and of the publisher's: another topic
    recorded.publisher(IMAGE, 3, '/other', time=402 * MS)
    recorded.publish(IMAGE, 1, 300 * MS + 1)
    recorded.publish(IMAGE, 1, 421 * MS + 1)
    got, _ = linked(recorded.write())
    assert [run[0] for run in got.runs] == ['/detector subscription /image', '/late timer 20ms']
    assert [each[0] for each in got.published_at] == ['/image', '/other']


def test_processes_have_addresses_of_their_own(recorded):
    recorded.node(1, '/other', pid=2)
    recorded.subscription(CAMERA, 1, '/image', pid=2)       # the camera's address
    recorded.run(CAMERA, 1, 100 * MS, 103 * MS)
    stamp = recorded.publish(IMAGE, 1, 101 * MS)
    recorded.receive(CAMERA, 1, 105 * MS, 106 * MS, stamp, pid=2)
    got, warnings = linked(recorded.write())
    assert got.links == [('/camera timer 100ms', 100 * MS, None),
                         ('/other subscription /image', 105 * MS, 101 * MS)]
    assert warnings == []


def test_same_stamps_on_other_topics_and_on_the_same(recorded):
    recorded.publisher(101, 1, '/other')
    recorded.run(CAMERA, 1, 100 * MS, 103 * MS)
    recorded.publish(IMAGE, 1, 101 * MS, stamp=50)
    recorded.publish(101, 1, 102 * MS, stamp=50)
    recorded.receive(DETECT, 2, 105 * MS, 106 * MS, 50)
    got, warnings = linked(recorded.write())
    assert (got.links[-1][2], warnings) == (101 * MS, [])
    recorded.publish(IMAGE, 3, 102 * MS, stamp=50)
    got, warnings = linked(recorded.write())
    assert got.links[-1][2] is None
    assert warnings == ['1 execution for a message whose publication is not known: of no job and '
                        'no path: /detector subscription /image (1)']


def test_what_was_initialised_before_the_recording(tmp_path):
    recorded = Recorded(tmp_path / 'late.mcap')
    recorded.node(1, '/camera')
    # CARET repeats it, with the time on the monotonic clock, which is 7 s behind
    recorded.add('ros2_caret:caret_init', 90 * MS, 1, BEGIN + 90 * MS - 7_000 * MS, 'jazzy')
    recorded.add('ros2_caret:rcl_timer_init', 91 * MS, 1, 10_011, 100 * MS,
                 BEGIN + 30 * MS - 7_000 * MS)
    recorded.add('ros2:rclcpp_timer_callback_added', 92 * MS, 1, 10_011, CAMERA)
    recorded.add('ros2:rclcpp_timer_link_node', 93 * MS, 1, 10_011, 1)
    recorded.run(CAMERA, 1, 131 * MS, 132 * MS)
    recording = open_recording(recorded.write())
    assert [(c.label, c.grid) for c in recording.names.callbacks] == [
        ('/camera timer 100ms', BEGIN + 30 * MS)]
    drafted, = System(recorded.path).draft().callbacks()
    assert (drafted.node, drafted.period_ns) == ('/camera', 100 * MS)


def test_any_lost_event_is_said_or_changes_nothing(recorded):
    for k in range(3):
        at = (k + 1) * 100 * MS
        recorded.run(CAMERA, 1, at, at + 3 * MS)
        stamp = recorded.publish(IMAGE, 1, at + 1 * MS)
        recorded.receive(DETECT, 2, at + 2 * MS, at + 9 * MS, stamp)
    whole, nothing = linked(recorded.write())
    assert nothing == []
    seen = set()
    names = recorded.names()
    for place, name in enumerate(names):
        if not any(part in name for part in ('callback_start', 'callback_end', 'bind', 'publish',
                                             'dds_write', 'dispatch')) or name.endswith('init'):
            continue
        if place > len(names) - 10:
            break       # at the end it may be cut off, or still run
        got, warnings = linked(recorded.write(but=[place]))
        assert set(got.runs) <= set(whole.runs)
        if (got.links, got.runs) != (whole.links, whole.runs):
            assert warnings, (place, name)
            seen.add(name.partition(':')[2])
    assert seen == {'callback_start', 'callback_end', 'dds_bind_addr_to_stamp', 'rclcpp_publish',
                    'dispatch_subscription_callback'}
