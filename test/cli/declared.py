# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A declaration with a sink that is in time and one that cannot be."""

GRAPH = """\
mddag: 1
nodes:
  - node: /sensor
    callbacks:
      - {name: tick, timer: 20ms, dag: main, publishes: [/data], execution_time: 2ms,
         on_late: continue, max_active_jobs: 900, holds_interpreter: false}
  - node: /quick
    callbacks:
      - {name: cb, subscription: /data, deadline: 500ms, execution_time: 1ms}
  - node: /slow
    callbacks:
      - {name: cb, subscription: /data, deadline: 10ms, execution_time: 15ms}
paths: [{name: p, callbacks: ['/sensor:tick', '/quick:cb']}]
"""
