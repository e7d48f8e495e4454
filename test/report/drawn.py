# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A declaration with every kind of callback and edge."""

GRAPH = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 10ms, publishes: [/a], dag: one, execution_time: 2ms}
      - {name: x, subscription: /a, publishes: [/b]}
      - {name: y, subscription: /a, publishes: [/c], reads: [x]}
  - node: /m
    callbacks:
      - {name: z, sync: [/b, /c], deadline: 50ms}
      - {name: q, subscription: /a, deadline: 5ms}
      - {name: s, service: /serve, period: 1s, deadline: 1s, dag: two, reads: [/c]}
"""
