# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The jobs that await an answer of a driven sync, with several threads that publish."""

import sys
import threading
from typing import NamedTuple

from mddag_executor.core.driven import Awaiting, MOST_AWAITING
import msg_graph
import pytest

GRAPH = """
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: tick, timer: 10ms, publishes: [/a]}
      - {name: join, sync: {topics: [/a, /b], driven_by: /a}, publishes: [/out], deadline: 10ms}
"""
THREADS, ROUNDS = 4, 20


class Job(NamedTuple):
    vertex: int
    number: int


@pytest.fixture
def threads_switch_often():
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


def test_callbacks_publish_in_parallel_while_old_jobs_are_forgotten(threads_switch_often):
    awaiting, found, errors = Awaiting(msg_graph.loads(GRAPH).callbacks[1]), [], []

    def publish(numbers):
        try:
            found.extend(awaiting.named('/out', number, None).number for number in numbers)
        except BaseException as error:
            errors.append(error)

    expected = list(range(1, ROUNDS * MOST_AWAITING + 1))
    for first in expected[::MOST_AWAITING]:
        numbers = range(first, first + MOST_AWAITING)
        for number in numbers:
            awaiting.receive(Job(0, number), number)
        several = [threading.Thread(target=publish, args=(numbers[each::THREADS],))
                   for each in range(THREADS)]
        for thread in several:
            thread.start()
        for thread in several:
            thread.join()
    assert not errors and sorted(found) == expected
