# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Traces of the processes of one run, written event by event."""

from mddag_executor.trace import TraceFile

MS = 1_000_000
BASE = 10 ** 18
GRAPH = """
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: tick, timer: 10ms, publishes: [/x], dag: chain}]}
  - {node: /b, callbacks: [{name: take, subscription: /x, deadline: 8ms}]}
processes: {up: [/a], down: [/b]}
"""
STAMPED = GRAPH.replace('dag: chain', 'dag: chain, release_from: header_stamp')
ADDRESS = 0x7F00_0000_0010


class Trace:
    """The trace of a process that runs one vertex; its clock is late by some ns."""

    def __init__(self, folder, name, vertex, late=0, graph=GRAPH, judges_from=0, dag=0, boot='',
                 begin=0, pid=None, workers=2):
        self.path = str(folder / f'run.{name}.mcap')
        self.file = TraceFile(self.path, overwrite=True)
        self.vertex, self.late, self.job = vertex, late, 0
        self.pid = 100 + vertex + dag if pid is None else pid
        self.dag = dag
        self.add('task_set', begin, graph, 'graph.yaml', 'rad', workers, 100 * MS, 64, False, 2)
        self.add('caret_init', begin, BASE - late, 'jazzy')
        if boot:
            self.add('host', begin, f'computer of {name}', boot)
        self.add('rclcpp_callback_register', begin, ADDRESS, f'callback of {name}')
        self.add('hosted', begin, dag, str(vertex))
        self.add('judge_from', begin, BASE + judges_from - late)

    def add(self, name, at, *fields):
        self.file.add(name, BASE + at - self.late, self.pid, self.pid, *fields)

    def runs(self, release, start, took=MS, completes=True, ready=None):
        """Run its vertex for the next job; times in ns since the base."""
        t = BASE - self.late
        ready = start if ready is None else ready
        self.add('job_release', ready, self.dag, self.job, t + release)
        self.add('dispatch', start, ADDRESS, self.dag, self.vertex, self.job, 0, t + ready,
                 t + release + 8 * MS)
        self.add('callback_start', start, ADDRESS, False)
        if completes:
            end = start + took
            self.add('callback_end', end, ADDRESS)
            self.add('complete', end, ADDRESS, self.dag, self.vertex, self.job, True, t + end, 0,
                     took, True)
        self.job += 1

    def runs_another(self, start, end):
        """Run an undeclared callback; times in ns since the base."""
        self.add('dispatch', start, ADDRESS + 1, -1, -1, -1, 1, BASE - self.late + start, 0)
        self.add('callback_start', start, ADDRESS + 1, False)
        self.add('callback_end', end, ADDRESS + 1)

    def knows(self, topic, handle):
        for kind in ('publisher', 'subscription'):
            self.add(f'rcl_{kind}_init', 0, handle, 1, handle, topic, 10)

    def sends(self, other, handle, sent, transport):
        self.add('rclcpp_publish', sent, handle, 1, 0)
        other.add('rmw_take', sent + transport, handle, 1, BASE + sent - self.late, True)

    def end(self, at):
        if at is not None:
            self.add('shutdown', at, BASE + at - self.late)
        self.file.finish()
        return self.path


TWO = """
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: t, timer: 12ms, deadline: 8ms}]}
  - {node: /b, callbacks: [{name: t, timer: 12ms, deadline: 8ms}]}
"""
