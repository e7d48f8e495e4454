# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Messages on topics of declared callbacks that none of these has published.

Theory of operation
-------------------
1.  A message belongs to a job if an execution of the job published it, or code that works on its
    behalf (``starters``).  A message that a thread, a task or an undeclared callback publishes
    otherwise belongs to no job.  The job is judged as if the node had not published it.
2.  Such messages are counted by publisher, and by the code that publishes.  Drift reports them at
    the end of the run (``msg_graph.drift``, rule 6), and a recorded run has them.
3.  If a callback may publish the topic (``may_publish``), results are not due without the message,
    and are not judged.  Nothing else shows this during a run, so it is also logged, once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
import threading
from typing import Any
import weakref

from mddag_executor.executor.attribution import PublisherState
from msg_graph import TaskSet
from msg_graph.drift import outside_text
from rclpy.exceptions import InvalidHandle
from rclpy.logging import get_logger

Outsiders = tuple[tuple[str, str, str, int], ...]
"""Node, topic, callback or task (empty: none), and the number of its messages."""


def _log(text: str) -> None:
    get_logger('mddag_executor').warning(text)


class _Sent:
    """
    The messages of a publisher that are counted.

    :ivar node: the full name of the publisher's node; empty: it is not known yet.
    :ivar counts: their number by callback or task.  Once the node is known, all of its publishers
        of the topic have the same counts.
    """

    __slots__ = ('node', 'counts')

    def __init__(self) -> None:
        self.node = ''
        self.counts: Counter[str] = Counter()


class Outside:
    """
    Counts these messages, from any thread.

    :param nodes: returns the nodes of the executor.
    :param warn: receives a warning.
    """

    def __init__(
        self, task_set: TaskSet, nodes: Callable[[], Iterable[Any] | None],
        warn: Callable[[str], object] = _log,
    ) -> None:
        self._warn = warn
        self._task_set = task_set
        self._nodes_now = nodes
        self._lock = threading.RLock()  # a signal handler may publish inside
        # as long as the publisher exists: a program may make one for each message
        self._sent: weakref.WeakKeyDictionary[PublisherState, _Sent] = (
            weakref.WeakKeyDictionary())
        # by node and topic, if a declared callback of the node starts another one with the topic
        self._counts: dict[tuple[str, str], Counter[str]] = {}
        self._has_warned: set[tuple[str, str]] = set()

    def note(
        self, publisher: Any, state: PublisherState, by: str, may_warn: bool
    ) -> None:
        """
        Count a message.

        :param by: the undeclared callback, or the task; empty: the thread runs none.
        :param may_warn: whether jobs are judged now.
        """
        with self._lock:
            sent = self._sent.get(state)
            if sent is None:
                sent = self._sent[state] = _Sent()
            sent.counts[by] += 1
            number = sent.counts[by]
        if not sent.node and number & (number - 1) == 0:  # it may have been added to the executor
            self._find_node(publisher, state.topic, sent)
        key = sent.node, state.topic
        if may_warn and key in self._counts and key not in self._has_warned:
            self._has_warned.add(key)
            text = outside_text(self._task_set, *key, {by: sent.counts[by]}, only_silent=True)
            if text is not None:
                self._warn(text)

    def _find_node(self, publisher: Any, topic: str, sent: _Sent) -> None:
        """Find the node of a publisher, and count its messages with those of the node."""
        node = self._node_of(publisher)
        if not node:
            return
        starts = outside_text(self._task_set, node, topic, sent.counts.copy()) is not None
        with self._lock:
            if not sent.node:  # else another thread has found it
                counts = self._counts.setdefault((node, topic), Counter()) if starts else Counter()
                counts.update(sent.counts)
                sent.node, sent.counts = node, counts

    def _node_of(self, publisher: Any) -> str:
        for node in self._nodes_now() or ():
            try:
                if publisher in list(node.publishers):
                    return str(node.get_fully_qualified_name())
            except InvalidHandle:
                pass  # it was destroyed meanwhile
        return ''

    def counts(self) -> Outsiders:
        """Return the counts so far of publishers whose nodes are known."""
        with self._lock:
            return tuple((*key, by, count) for key, counts in self._counts.items()
                         for by, count in counts.items())


def since(now: Outsiders, before: Outsiders) -> Outsiders:
    """Return counts without those of before."""
    known = {tuple(key): count for *key, count in before}
    rest = ((node, topic, by, count - known.get((node, topic, by), 0))
            for node, topic, by, count in now)
    return tuple(each for each in rest if each[-1] > 0)
