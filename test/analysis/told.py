# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Recordings that are written callback by callback, for a declaration."""

from mddag_executor import open_recording
from mddag_executor.analysis.paths import Paths
from msg_graph import loads

from ..sources.helpers import MS
from ..sources.recorded import BEGIN, Recorded
from .flows import flows


class Told(Recorded):
    """A recording of the nodes of a declaration; times are ms, messages known by their time."""

    def __init__(self, path, text):
        super().__init__(path)
        self.task_set = loads(text, 'graph.yaml')
        nodes = list(dict.fromkeys(each.node for each in self.task_set.callbacks))
        self.callbacks, self.publishers = {}, {}
        for number, node in enumerate(nodes):
            self.node(1 + number, node)
        for number, each in enumerate(self.task_set.callbacks):
            node = 1 + nodes.index(each.node)
            if each.timer_period_ns:
                self.timer(100 + 10 * number, node, each.timer_period_ns)
            for place, topic in enumerate(each.topics or (None,)):
                self.callbacks[each.key, topic] = number = 100 + 10 * number + place
                if topic is not None:
                    self.subscription(number, node, topic)
            for topic in each.publishes:
                self.publishers[each.key, topic] = 1000 + len(self.publishers)
                self.publisher(self.publishers[each.key, topic], node, topic)

    def ran(self, key, start, end, message=None, topic=None, sends=()):
        """Run a callback on a thread of its own, for the message of some time."""
        number = self.callbacks[key, topic]
        tid = 1 + len(self._events)
        if message is None:
            self.run(number, tid, start * MS, end * MS)
        else:
            self.receive(number, tid, start * MS, end * MS, message * MS)
        self.sent(key, tid, *sends)
        return tid

    def sent(self, key, tid, *sends):
        """Publish at times on topics, each perhaps with a header stamp."""
        for time, topic, *header in sends:
            self.publish(self.publishers[key, topic], tid, time * MS, stamp=time * MS,
                         header=header[0] * MS if header else 0)

    def paths(self):
        return Paths(open_recording(self.write(), self.task_set))

    def starts(self):
        """Return for each flow its first publication and the start of each later callback."""
        return [[time and (time - BEGIN) / MS for time in (
            flow.columns[0][0], *(column[1] for column in flow.columns[1:]))]
            for flow in flows(self.paths())]
