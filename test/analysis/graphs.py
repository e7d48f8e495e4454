# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Declarations that several files of tests use."""

TWO_RATES = """\
mddag: 1
nodes:
  - {node: /lidar, callbacks: [{name: read, timer: 100ms, publishes: [/points]}]}
  - {node: /boxes, callbacks: [{name: find, timer: 70ms, publishes: [/boxes], deadline: 1s}]}
  - node: /fusion
    callbacks:
      - name: fuse
        sync: {topics: [/points, /boxes], driven_by: /points}
        publishes: [/fused]
  - {node: /brake, callbacks: [{name: stop, subscription: /fused, deadline: 150ms}]}
"""
"""A sync of two topics with different rates: a scan is fused with the boxes that are there."""
