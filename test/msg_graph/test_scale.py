# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Large graphs: the work grows with what is declared, not with its square."""

from __future__ import annotations

from collections.abc import Callable
import sys
from typing import Any

from msg_graph import loads
import pytest

HEAD = 'mddag: 1\nnodes:\n- node: /n\n  callbacks:\n'


def chain(size: int) -> str:
    """One DAG as deep as it can be."""
    text = HEAD + '  - {name: c0, timer: 10ms, publishes: [/t0]}\n'
    for i in range(1, size - 1):
        text += f'  - {{name: c{i}, subscription: /t{i - 1}, publishes: [/t{i}]}}\n'
    return text + f'  - {{name: end, subscription: /t{size - 2}, deadline: 1s}}\n'


def star(size: int) -> str:
    """One topic that starts everything, and a sync of everything; queue edges all over."""
    text = HEAD + '  - {name: t, timer: 10ms, publishes: [/a]}\n'
    for i in range(size - 2):
        text += f'  - {{name: c{i}, subscription: /a, publishes: [/b], reads: [/a, t]}}\n'
    return text + '  - {name: s, sync: [/a, /b], deadline: 1s}\n'


def many(size: int) -> str:
    """Many small DAGs that share a callback, so that it has a vertex in each."""
    text = HEAD
    for i in range(size // 2):
        text += f'  - {{name: c{i}, timer: 10ms, publishes: [/a], dag: d{i}}}\n'
    return text + '  - {name: s, subscription: /a, deadline: 1s}\n'


def square(size: int) -> str:
    """One topic with many publishers, beside many sinks, and queue edges from one variable."""
    text = HEAD + '  - {name: t, timer: 10ms, publishes: [/a]}\n'
    for i in range(size // 2):
        text += f'  - {{name: p{i}, subscription: /a, publishes: [/b], reads: [p0]}}\n'
    for i in range(size // 2 - 2):
        text += f'  - {{name: r{i}, subscription: /a, deadline: 1s}}\n'
    return text + '  - {name: s, sync: [/a, /b], deadline: 1s}\n'


SHAPES: dict[str, Callable[[int], str]] = {
    shape.__name__: shape for shape in (chain, star, many, square)}


def calls(work: Callable[[], Any]) -> int:
    """Return how many functions a piece of work calls, C functions included."""
    count = 0

    def profile(frame: object, event: str, argument: object) -> None:
        nonlocal count
        count += event in ('call', 'c_call')

    previous = sys.getprofile()
    sys.setprofile(profile)
    try:
        work()
    finally:
        sys.setprofile(previous)
    return count


@pytest.mark.parametrize('shape', SHAPES)
def test_work_is_linear(shape: str) -> None:
    small, large = SHAPES[shape](400), SHAPES[shape](1_600)
    loads(small)
    ratio = calls(lambda: loads(large)) / calls(lambda: loads(small))
    assert 3 < ratio < 4.5
