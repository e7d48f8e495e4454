# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What one measurement is made of; imports nothing of ROS."""

from __future__ import annotations

from dataclasses import asdict, dataclass
import json
from typing import Any

from mddag_executor.core import policy as find_policy
from mddag_executor.errors import MddagError, UsageError

OURS = {'rad-events': 'events', 'rad-waitset': 'waitset'}
"""The names of this executor, by intake."""

PEERS = ('single', 'multi', 'events')
"""rclpy's SingleThreadedExecutor, MultiThreadedExecutor and EventsExecutor."""

NONE = 'none'
"""No executor: what the nodes of a declared load cost by themselves (see ``executors``)."""

EXECUTORS = (*OURS, *PEERS)
ROBOT = 'robot'
"""The load that is the ordinary nodes of an example."""
LOADS = ('autoware', 'topics', 'entities', 'reference-system', ROBOT)
DECLARED = {
    'autoware': 'config/autoware.yaml', 'reference-system': 'config/reference_system.yaml'}
"""The loads that are synthetic nodes, and the declarations that ship for them."""
ROBOT_GRAPH = 'examples/robot/graph.yaml'
PHASES = ('drawn', 'together')
"""When the topics of a message load are published: each at a phase of its own, or all in a row."""


class BenchError(MddagError):
    """A measurement that cannot be made."""


@dataclass(frozen=True)
class Spec:
    """
    One measurement: an executor and a load.

    :ivar executor: one of ``EXECUTORS``.
    :ivar policy: of this executor; rclpy's have none.
    :ivar seconds: length of the measured window, after ``warm_up_s``.
    :ivar seed: of the execution times, or of the phases of the published topics.
    :ivar graph: path of the declaration, for declared loads.
    :ivar utilisation: what its execution times are scaled to; None takes them as drawn.
    :ivar bodies: how these execute, as ``execution.Mode``.
    :ivar topics: how many topics are published, each with one subscription.
    :ivar rate_hz: how often each is.
    :ivar idle: how many subscriptions there are besides, whose topics nobody publishes.
    :ivar phases: when the topics are published, one of ``PHASES``.
    :ivar scale: of how much the robot's nodes compute.
    :ivar process: which of the declared processes it is of; None: of all that there are.
    """

    load: str
    executor: str
    policy: str = 'rad'
    workers: int = 7
    seconds: float = 10.0
    seed: int = 0
    warm_up_s: float = 1.0
    graph: str | None = None
    utilisation: float | None = None
    bodies: str = 'sleep'
    topics: int = 1
    rate_hz: float = 100.0
    idle: int = 0
    phases: str = 'drawn'
    scale: float = 1.0
    process: str | None = None

    @property
    def name(self) -> str:
        """Return the executor's name, with the policy unless that is rad."""
        return self.executor if self.policy == 'rad' else f'{self.executor}:{self.policy}'

    def to_json(self) -> str:
        """Return the measurement as text."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Spec:
        """Return the measurement that ``to_json`` wrote."""
        fields: dict[str, Any] = json.loads(text)
        return cls(**fields)


def parse_executors(text: str, policies: str | None = None) -> list[tuple[str, str]]:
    """
    Return executors and policies that a comma separated list names.

    :param text: as ``rad-events,rad-events:fifo,multi``.
    :param policies: comma separated; ours without a policy of its own runs with each of them.
    :raises UsageError: on an unknown name, and one that stands there twice.
    """
    default = ['rad'] if policies is None else [name.strip() for name in policies.split(',')]
    for name in default:
        find_policy(name)
    found: list[tuple[str, str]] = []
    for item in text.split(','):
        name, colon, policy = item.strip().partition(':')
        if name not in (*EXECUTORS, NONE):
            raise UsageError(
                f"--executors: '{name}' is unknown: give some of {', '.join((*EXECUTORS, NONE))}")
        if colon and name not in OURS:
            raise UsageError(
                f"--executors: '{item.strip()}': only this executor knows policies: leave it out")
        if colon:
            find_policy(policy)
        for each in [policy] if colon else default if name in OURS else ['rad']:
            if (name, each) in found:
                raise UsageError(f"--executors: '{item.strip()}' stands there twice: name it once")
            found.append((name, each))
    if policies is not None and not any(name in OURS for name, _ in found):
        raise UsageError(
            '--policies: they are those of this executor: name rad-events or rad-waitset')
    return found
