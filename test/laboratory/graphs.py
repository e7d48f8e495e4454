# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Declarations that several tests of the laboratory use."""

GRAPH = """\
mddag: 1
workers: 1
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 20ms, publishes: [/a, /b], dag: one, execution_time: 1ms}
      - {name: x, subscription: /a, deadline: 5ms, execution_time: 1ms}
      - name: y
        subscription: /b
        deadline: 50ms
        execution_time: {quantiles_us: [1000, 3000, 9000], percent: [0, 50, 100]}
      - {name: z, timer: 10ms, deadline: 10ms, dag: two, execution_time: 1ms}
"""
#: /n:s is a sink of both DAGs.
SHARED = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: a, timer: 20ms, publishes: [/a], dag: one, execution_time: 3ms}
      - {name: b, timer: 40ms, publishes: [/a], dag: two, execution_time: 1ms}
      - {name: s, subscription: /a, deadline: 5ms, execution_time: 1ms}
"""
