# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Messages that the middleware dropped are counted by the gaps in their numbers."""

from mddag_executor import replay
from mddag_executor.executor import gaps
from mddag_executor.executor.gaps import Gaps
from msg_graph import loads
import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int32

from .conftest import Spinning, wait_for
from .declared import graph
from .inside import pool_of


class Topic:
    """What a subscription knows of the publishers of its topic."""

    def __init__(self, *ids):
        self.ids = ids
        self.gaps = Gaps(lambda: None if self.ids is None else frozenset(self.ids),
                         lambda: len(self.ids or ()))

    def take(self, *numbers):
        """Return how many messages were found missing before each number."""
        found = []
        for number in numbers:
            if number == self.gaps.expected:
                self.gaps.expected += 1
                found.append(0)
            else:
                found.append(self.gaps.missing(number))
        return found


@pytest.fixture(autouse=True)
def always_compared(monkeypatch):
    monkeypatch.setattr(gaps, '_KNOWN_NS', 0)


def test_gaps_of_one_publisher_count_from_its_first_message_on():
    topic = Topic(b'a')
    assert topic.take(3, 4, 6, 7, 10) == [0, 0, 1, 0, 2]
    assert topic.take(1, 2, 4) == [0, 0, 1]         # it was restarted
    topic.ids = (b'b',)
    assert topic.take(9, 10, 12) == [0, 0, 1]       # another one
    topic.ids = ()
    assert topic.take(20, 30) == [0, 0]


@pytest.mark.parametrize('ids', [None, (b'a', b'b'), ()])
def test_nothing_counts_unless_there_is_one_publisher(ids):
    topic = Topic(b'a')
    assert topic.take(1, 3) == [0, 1]
    topic.ids = ids
    assert topic.take(5, 9, None, None, 20, 2, 4) == [0] * 7
    topic.ids = (b'a',)
    assert topic.take(9, 11) == [0, 1]


@pytest.mark.parametrize('declared', [True, False])
def test_messages_that_an_overfull_reader_lost(declared, make_executor, make_node, tmp_path):
    """A queue of one message is full while nothing is taken: four of five are overwritten."""
    text = graph(reader='name: use, subscription: /numbers, period: 1s, deadline: 1s')
    path, got = tmp_path / 'lost.mcap', []
    reader, writer = make_node('reader'), make_node('writer')
    qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    reader.create_subscription(Int32, '/numbers', lambda m: got.append(m.data), qos)
    publisher = writer.create_publisher(Int32, '/numbers', 10)

    executor = make_executor(
        loads(text, 'g.yaml') if declared else None, num_workers=2, trace=str(path),
        nodes=[reader])
    with Spinning(executor):
        assert wait_for(publisher.get_subscription_count)
        publisher.publish(Int32(data=0))
        assert wait_for(lambda: got == [0])
        with pool_of(executor).lock:       # under which messages are taken
            for number in range(1, 6):
                publisher.publish(Int32(data=number))
        assert wait_for(lambda: got == [0, 5])
        name, counts = next((name, each) for name, each in executor.statistics()[
            'callbacks'].items() if name.startswith('/reader') and each['ran'])
        assert (counts['lost'], counts['dropped']) == (4, 0)
    result = replay(path).result() if declared else replay(path, loads(text, 'g.yaml')).result()
    assert list(result['messages_lost'].values()) == [4]
    if declared:
        assert result['messages_lost'] == {'/reader:use': 4} == {name: 4}
