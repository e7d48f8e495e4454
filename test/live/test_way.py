# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The way of a message is as short as ``docs/layout.md`` says: held against a profile of one."""

from __future__ import annotations

from pathlib import Path
import re
import subprocess
import sys

import pytest

ROOT = Path(__file__).parents[2]
MOST_BEFORE, MOST_AFTER, MOST_FILES = 15, 6, 8

PROGRAM = """
import sys, threading, time
from mddag_executor import MultiDeadlineExecutor
from mddag_executor.live import entity, pool
from msg_graph import loads
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import Header

GRAPH = '''
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: tick, timer: 20ms, publishes: [/a], dag: d, holds_interpreter: false}
      - {name: middle, subscription: /a, publishes: [/b], holds_interpreter: false}
      - {name: sink, subscription: /b, deadline: 15ms, holds_interpreter: false}
'''
entity.SOON_NS = entity.BRIEF_NS = pool.BRIEF_NS = 10 ** 9  # also under the profile
calls, noted = [], threading.Event()


def profile(frame, event, argument):
    if event == 'call' and noted.is_set():
        calls.append((
            threading.get_ident(), frame.f_code.co_filename, frame.f_code.co_qualname))


threading.setprofile(profile)
rclpy.init()
node = rclpy.create_node('n')
group = ReentrantCallbackGroup()
publishers = [node.create_publisher(Header, topic, 10) for topic in ('/a', '/b')]


def tick():
    publishers[0].publish(Header())


def middle(message):
    publishers[1].publish(Header())


def sink(message):
    pass


node.create_timer(0.02, tick, group)
node.create_subscription(Header, '/a', middle, 10, callback_group=group)
node.create_subscription(Header, '/b', sink, 10, callback_group=group)
executor = MultiDeadlineExecutor(loads(GRAPH, 'g.yaml'), num_workers=2)
executor.add_node(node)
thread = threading.Thread(target=executor.spin)
thread.start()
time.sleep(3.0)  # until the callbacks are known well
noted.set()
time.sleep(1.0)
noted.clear()
executor.shutdown()
thread.join()
for call in calls:
    print(*call)
"""


Way = list[tuple[str, str]]


def ways() -> list[tuple[Way, Way]]:
    """
    Return, for runs of ``middle``, file and function of what leads to it, and of what ends it.

    A worker goes on with what its callback has published.  So the way of a message is that from
    its receiver to the wait for a worker, and from when the worker takes it to the callback.
    """
    output = subprocess.run(
        [sys.executable, '-c', PROGRAM], capture_output=True, text=True, timeout=120, check=True)
    calls = [line.split(maxsplit=2) for line in output.stdout.splitlines()]
    worker = next(thread for thread, _, name in calls if name == 'middle')
    mine = [(file.rpartition('mddag_executor/')[2], name) for thread, file, name in calls
            if thread == worker and ('mddag_executor/' in file or name in ('middle', 'sink'))]
    names = [name for _, name in mine]
    found = []
    for place in [i for i, name in enumerate(names) if name == 'middle']:
        try:
            taken_in = last(names, 'Receiver.take', place)
            waits = names.index('key_rad', taken_in, place)
            taken = last(names, 'Engine.dispatch', place)
            published = names.index('key_rad', place)
            ended = names.index('Engine.dispatch', published)
        except ValueError:
            continue  # another worker ran a part of it
        if 'sink' not in names[place:ended]:
            found.append((
                mine[taken_in:waits + 1] + mine[taken:place], mine[published + 1:ended + 1]))
    return found


def last(names: list[str], name: str, end: int) -> int:
    """Return the last place of a name before another."""
    return end - 1 - names[:end][::-1].index(name)


@pytest.mark.skipif(sys.version_info < (3, 11), reason='code has no qualified name before 3.11')
def test_a_message_takes_the_way_that_the_page_names() -> None:
    page = (ROOT / 'docs' / 'layout.md').read_text(encoding='utf-8')
    named = set(re.findall(r'`((?:live|core)/[\w/]+\.py)`', page))
    found = ways()
    assert len(found) >= 5
    before, after = min(found, key=lambda way: len(way[0]) + len(way[1]))
    assert len(before) <= MOST_BEFORE, before
    assert len(after) <= MOST_AFTER, after
    files = {file for file, _ in before}
    assert len(files) <= MOST_FILES and files <= named, before
    for _, name in before + after:
        assert name.rpartition('.')[2] in page, name
