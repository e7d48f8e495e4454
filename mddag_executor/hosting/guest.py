# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A program that is hosted: its thread, its nodes, and how it ends."""

from __future__ import annotations

from dataclasses import dataclass, field
import threading
from typing import Any

from mddag_executor.hosting.loading import Program
from rclpy.exceptions import ROSInterruptException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

CONTEXT_HAS_ENDED = (ExternalShutdownException, ROSInterruptException)
"""What spins and ``Rate.sleep`` raise in a program whose context another one has shut down."""


@dataclass(eq=False)
class Guest:
    """
    A running program.

    :ivar nodes: its nodes on the executor.
    :ivar has_begun: whether its main has begun, so that a signal reaches it.
    :ivar is_complete: whether ``nodes`` holds all initial nodes, or the program has ended.
    :ivar ended: whether its nodes run no more callbacks; it may initialise rclpy again.
    :ivar finished: whether its main has ended.
    :ivar returned: whether its main has returned nodes.
    :ivar uses_ros: whether it has initialised rclpy.
    :ivar error: the exception that has ended its main.
    :ivar done: is set when all that follows its main is also done.
    :ivar signals: those that rclpy handles for it, with the Python handler of each at that time,
        which rclpy's calls.
    :ivar interrupted: whether a SIGINT has come that its next spin, or ``rclpy.ok()``, raises.
    :ivar waited_ns: how long its callbacks have waited for others of it, in groups that it has
        closed.
    """

    program: Program
    thread: threading.Thread = field(init=False)
    nodes: list[Node] = field(default_factory=list)
    has_begun: bool = False
    is_complete: bool = False
    ended: bool = False
    finished: bool = False
    returned: bool = False
    uses_ros: bool = False
    error: BaseException | None = None
    done: threading.Event = field(default_factory=threading.Event)
    signals: dict[int, Any] = field(default_factory=dict)
    interrupted: bool = False
    waited_ns: int = 0
    global_executor: Any = None
