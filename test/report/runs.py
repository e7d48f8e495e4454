# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Runs for the tests of reports: a small trace written by hand, and simulated ones."""

from pathlib import Path

from mddag_executor.simulate import (
    draw_execution_times,
    periodic_workload,
    scale_execution_times,
    Settings,
    simulate,
)
from mddag_executor.trace import TraceFile
import msg_graph

CONFIG = Path(__file__).resolve().parents[2] / 'config'
START = 1_732_166_766_000_000_000
MS = 1_000_000
HOSTILE = '</script><img src=x onerror="window.hacked=1">=cmd()\x1b[31m&amp;{{7*7}}'

GRAPH = """\
mddag: 1
nodes:
  - node: /driver
    callbacks:
      - {name: tick, timer: 10ms, publishes: [/data]}
  - node: /filter
    callbacks:
      - {name: run, subscription: /data, deadline: 8ms}
paths:
  - {name: whole, callbacks: ['/driver:tick', '/filter:run']}
"""


def by_hand(path, hostile=False, finished=True, undeclared=True, extra_ms=0, took=(1, 2, 6)):
    """
    Write a trace of three jobs; the third is 2 ms late; then an undeclared callback runs.

    :param extra_ms: how much longer the last callback takes.
    :param took: how long the first callback takes in each job, ms; with more than 4 it is late.
    """
    with TraceFile(path, overwrite=True) as file:
        def add(name, ms, *fields):
            file.add(name, START + ms * MS, 1, 9, *fields)

        def run(vertex, job, ready, start, end):
            add('dispatch', start, vertex + 1, 0, vertex, job, vertex, START + ready * MS, 0)
            add('callback_start', start, vertex + 1, False)
            add('callback_end', end, vertex + 1)
            add('complete', end, vertex + 1, 0, vertex, job, True, START + end * MS, 0)

        add('task_set', 0, GRAPH, HOSTILE if hostile else 'graph.yaml', 'rad', 2, 100 * MS, 64,
            False)
        if undeclared:
            add('rclcpp_callback_register', 0, 77, HOSTILE if hostile else 'extra')
        for job, first in enumerate(took):
            at = 10 + 10 * job
            end = at + first + 4 + extra_ms
            add('job_release', at, 0, job, START + at * MS)
            run(0, job, at, at, at + first)
            run(1, job, at + first, at + first + 1, end)
            if end > at + 8:
                add('deadline', end, 0, 1, job, START + (at + 8) * MS, START + end * MS)
        if undeclared:
            add('dispatch', at + 11, 77, -1, -1, -1, -1, START + (at + 11) * MS, 0)
            add('callback_start', at + 11, 77, False)
            add('callback_end', at + 13, 77)
        if finished:
            add('shutdown', at + 20, START + (at + 20) * MS)
    return path


def autoware(name='autoware_multi'):
    return msg_graph.load(CONFIG / f'{name}.yaml')


def simulated(task_set, *, utilisation=0.95, workers=5, ms=300, seed=0, **settings):
    """Simulate with a log."""
    times = scale_execution_times(
        task_set, draw_execution_times(task_set, seed), workers, utilisation)
    load = periodic_workload(task_set, times, ms * MS)
    return load, simulate(
        task_set, load, Settings(pools=(workers,), duration_ns=ms * MS, **settings), log=True)
