# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Nodes that destroy their timer after its first execution."""

from rclpy.node import Node


def make(name):
    node = Node(name, start_parameter_services=False, enable_rosout=False)
    timer = node.create_timer(0.009, lambda: node.destroy_timer(timer))
    return node


def a():
    return make('a')


def b():
    return make('b')
