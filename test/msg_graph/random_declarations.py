# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Random declarations, as texts and as what they mean."""

from hypothesis import strategies as st

from .brute import Spec

TOPICS = [f'/t{i}' for i in range(4)]


@st.composite
def declarations(draw):
    """
    Draw a declaration that is right more often than not.

    Callbacks subscribe to what those drawn before them publish and get deadlines where they
    belong; then a few entries may be spoilt, and the order of the file is shuffled.
    """
    specs = []
    for i in range(draw(st.integers(1, 7))):
        published = sorted({topic for spec in specs for topic in spec.publishes})
        starts = ['timer', 'outside', 'service'] if i == 0 else ['timer', 'outside']
        starts += ['subscription'] * (9 if published else 0) + ['sync'] * 8 * (len(published) > 1)
        start = draw(st.sampled_from(starts))
        topics = []
        if start == 'subscription':
            topics = [draw(st.sampled_from(published))]
        elif start == 'sync':
            topics = draw(st.lists(
                st.sampled_from(published), min_size=2, max_size=3, unique=True))
        elif start == 'outside':
            topics = ['/outside']
        # Only topics of higher numbers than those that start it: no cycle, unless spoilt.
        free = TOPICS[max((TOPICS.index(t) + 1 for t in topics if t in TOPICS), default=0):]
        publishes = draw(st.lists(
            st.sampled_from(free), min_size=int(i < 4), max_size=2, unique=True)) if free else []
        node = draw(st.sampled_from(['/a', '/b/c']))
        dag = draw(st.sampled_from([None, 'd', *[f'd{i}'] * 5])) if start in (
            'timer', 'outside', 'service') else None
        specs.append(Spec(node, f'c{i}', start, topics, publishes, [], False, dag))
    for spec in specs:
        started = {t for s in specs if s.start in ('subscription', 'sync') for t in s.topics}
        spec.deadline = not started.intersection(spec.publishes)
        published = sorted({topic for s in specs for topic in s.publishes})
        known = published + [s.name for s in specs if s.node == spec.node]
        spec.reads = draw(st.lists(st.sampled_from(known), max_size=2, unique=True))
    if draw(st.booleans()):
        _spoil(draw, draw(st.sampled_from(specs)))
    return draw(st.permutations(specs))


def _spoil(draw, spec):
    what = draw(st.sampled_from([
        'deadline', 'publish', 'loop', 'loop', 'subscribe', 'reads', 'silent', 'outside']))
    topic = draw(st.sampled_from(TOPICS))
    if what == 'deadline':
        spec.deadline = not spec.deadline
    elif what == 'publish' and topic not in spec.publishes:
        spec.publishes.append(topic)
    elif what == 'loop' and spec.topics and spec.topics[0] not in spec.publishes:
        spec.publishes.append(spec.topics[0])
    elif what == 'subscribe' and topic not in spec.topics and spec.topics:
        spec.topics[0] = topic
    elif what == 'reads':
        spec.reads = [draw(st.sampled_from([topic, 'c0', 'nobody']))]
    elif what == 'silent':
        spec.publishes = []
    elif what == 'outside' and spec.start == 'subscription':
        spec.start = 'outside'
