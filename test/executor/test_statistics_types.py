# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What type checkers and editors know of the executor is what it does."""

from __future__ import annotations

import os
from pathlib import Path
import time
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints, is_typeddict, Union

from mddag_executor import MultiDeadlineExecutor
from mddag_executor.executor.statistics_types import Statistics
from msg_graph import loads

from .conftest import Spinning, wait_for

GRAPH = """\
mddag: 1
nodes:
  - {node: /n, callbacks: [{name: t, timer: 20ms, deadline: 1us}]}
"""


def check(value: Any, hint: Any, place: str) -> None:
    """Find out whether a value has the type that is declared, no key missing or more."""
    if is_typeddict(hint):
        hints = get_type_hints(hint)
        assert isinstance(value, dict), place
        assert hint.__required_keys__ <= set(value) <= set(hints), place
        for key, inner in value.items():
            check(inner, hints[key], f'{place}.{key}')
    elif get_origin(hint) in (Union, UnionType):
        kinds = [each for each in get_args(hint) if each is not NoneType]
        if value is not None:
            check(value, kinds[0], place)
    elif get_origin(hint) is dict:
        for key, inner in value.items():
            assert isinstance(key, str), place
            check(inner, get_args(hint)[1], f'{place}[{key}]')
    elif get_origin(hint) is list:
        for inner in value:
            check(inner, get_args(hint)[0], place)
    else:
        assert isinstance(value, hint), f'{place}: {value!r}'


def test_statistics_have_the_declared_types(
    ros_context: Any, make_node: Any, tmp_path: Path
) -> None:
    trace = tmp_path / 'run.mcap'
    with MultiDeadlineExecutor(
            loads(GRAPH), context=ros_context, trace=trace,
            worker_cpus=list(os.sched_getaffinity(0))) as executor:
        assert isinstance(executor, MultiDeadlineExecutor)
        check(executor.statistics(), Statistics, 'statistics')
        node = make_node('n')
        node.create_timer(0.02, lambda: time.sleep(0.001))
        node.create_timer(0.01, lambda: None)
        executor.add_node(node)
        with Spinning(executor):
            assert wait_for(lambda: executor.statistics()['first_miss'] is not None)
        found = executor.statistics()
    check(found, Statistics, 'statistics')
    assert found['trace'] == {'path': str(trace), 'lost': 0, 'error': None}
    assert found['dags']['/n']['sinks']['/n:t']['response_ns'] is not None
    assert {'/n:t'} < set(found['callbacks'])
