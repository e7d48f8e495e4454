# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Nodes without the services and topics that every node has."""

from __future__ import annotations

from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter


def quiet_node(
    full_name: str, context: Context | None = None, is_remapped: bool = False, **parameters: bool
) -> Node:
    """
    Make a node without services and topics of its own.

    :param is_remapped: whether the process' arguments remap its topics; they never rename it.
    """
    namespace, _, name = full_name.rpartition('/')
    # A node's own arguments precede those of the process.
    own_name = ['--ros-args', '-r', f'__node:={name}']
    return Node(
        name, namespace=namespace or '/', context=context, enable_rosout=False,
        start_parameter_services=False, use_global_arguments=is_remapped,
        cli_args=own_name if is_remapped else None,
        parameter_overrides=[Parameter(key, value=value) for key, value in {
            'start_type_description_service': False, **parameters}.items()])
