# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A path from a sensor to wheels over a variable, with requirements."""


def imu_to_wheels(reaction, age):
    """Return the declaration; the times are texts."""
    return f"""\
mddag: 1
workers: 2
nodes:
  - node: /imu
    callbacks:
      - {{name: sample, timer: 10ms, publishes: [/imu], execution_time: 1ms}}
  - node: /fuse
    callbacks:
      - {{name: on_imu, subscription: /imu, deadline: 10ms, execution_time: 1ms}}
      - {{name: estimate, timer: 20ms, reads: [on_imu], publishes: [/pose], execution_time: 2ms}}
  - node: /wheels
    callbacks:
      - {{name: drive, subscription: /pose, deadline: 20ms, execution_time: 1ms}}
paths:
  - name: imu_to_wheels
    callbacks: ['/imu:sample', '/fuse:on_imu', '/fuse:estimate', '/wheels:drive']
    reaction: {reaction}
    age: {age}
"""
