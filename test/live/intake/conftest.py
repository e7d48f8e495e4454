# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the tests of the intakes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from mddag_executor.live.intake.waitset import WaitSetIntake
import pytest
from rclpy.context import Context
from rclpy.node import Node

from .helpers import INTAKES, make_intake, make_node, Recorder


@pytest.fixture
def recorder() -> Recorder:
    return Recorder()


@pytest.fixture(params=INTAKES)
def intake(request: pytest.FixtureRequest, ros_context: Context, recorder: Recorder
           ) -> Iterator[Any]:
    made = make_intake(request.param, ros_context, recorder)
    yield made
    made.stop()


@pytest.fixture
def node(ros_context: Context) -> Iterator[Node]:
    made = make_node(ros_context)
    yield made
    made.destroy_node()


@pytest.fixture
def other(ros_context: Context) -> Iterator[Node]:
    """Give a node that no intake looks after."""
    made = make_node(ros_context)
    yield made
    made.destroy_node()


@pytest.fixture
def bare_node(ros_context: Context) -> Iterator[Node]:
    """Give a node that has nothing but what the test makes."""
    made = make_node(ros_context, start_parameter_services=False, enable_rosout=False)
    yield made
    made.destroy_node()


@pytest.fixture
def timer_intake(ros_context: Context, recorder: Recorder) -> Iterator[WaitSetIntake]:
    """Give an intake of timers only, which is what EventsIntake has for them."""
    made = WaitSetIntake(ros_context, recorder, kinds={'timers'})
    yield made
    made.stop()
    assert not recorder.errors
