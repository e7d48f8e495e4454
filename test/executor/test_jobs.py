# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Which publication a message comes from, and when nobody can say."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

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

TOPIC = '/topic'
GRAPH = """
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: tick, timer: 10ms, publishes: [/topic]}
      - {name: end, subscription: /topic, deadline: 5ms}
"""


class Bench:
    """Jobs whose publications are given, with a publisher or two."""

    def __init__(self) -> None:
        self.jobs = Jobs(msg_graph.loads(GRAPH, 'g.yaml'))
        self.topic = self.jobs.topics[TOPIC]
        self.publishers = [PublisherState(TOPIC), PublisherState(TOPIC)]

    def published(self, begin: int, end: int | None, job: int, publisher: int = 0) -> None:
        state = self.publishers[publisher]
        state.count += 1
        publication = Publication(begin, state.numbers, Origin(0, 0, job, publisher), state.count)
        self.topic.publications.append(publication)
        if end is not None:
            publication.end = end

    def job(self, stamp: int, sequence: int | None = None) -> Any:
        origin = self.jobs.find(TOPIC, stamp, sequence)
        return None if origin is None else origin.job


def test_the_sequence_number_decides_between_publishers():
    bench = Bench()
    bench.published(0, 10, 1, publisher=0)
    bench.published(1000, 1010, 2, publisher=1)
    bench.published(2000, 2010, 3, publisher=1)
    bench.published(3000, 3100, 4, publisher=0)
    bench.published(3050, 3150, 5, publisher=1)
    assert bench.job(3080) is None, 'without a number nobody knows'
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


def test_messages_of_a_stranger_in_the_window_are_nobody_s():
    """Whatever its numbers are, and however often they differ alike."""
    bench = Bench()
    for job in range(1, 100):
        bench.published(job * 1000, job * 1000 + 10, job)
        for number in (3 * job + 1, job + 7):  # faster, and as fast
            assert bench.job(job * 1000 + 5, number) is None
        assert bench.job(job * 1000 + 6, job) == job
    assert bench.jobs.unknown == 198


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


def announced(bench: Bench, begin: int, end: int, number: int, sequence: int,
              publisher: PublisherNumbers) -> None:
    bench.jobs.take_in(TOPIC, Publication(
        begin, publisher, Announced((1, number), 0, 0, 0), sequence, end))


def number(bench: Bench, stamp: int, sequence: int | None = None) -> int | None:
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
    announced_to: list[list[int]] = []
    bench.jobs.announce = lambda send, topic, several: announced_to.append(
        [each.origin.job for each in several])  # type: ignore[union-attr]
    bench.jobs.announce_on({TOPIC})

    def publish(job: int, publisher: int, send: Callable[[], None] = lambda: None) -> None:
        bench.jobs.publish(lambda *_: send(), None, None, bench.publishers[publisher],
                           bench.topic, Origin(0, 0, job, publisher))

    publish(1, 0)
    publish(2, 0, lambda: publish(3, 1))
    bench.jobs.announce_on(set())
    publish(4, 0)
    assert announced_to == [[1], [3, 2]]
