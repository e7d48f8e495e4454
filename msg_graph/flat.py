# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
One text for a declaration that was put together from several files.

It gives an equal task set (only lines differ), so that a trace that holds it needs no other file.
"""

from __future__ import annotations

from collections.abc import Iterator

from msg_graph.declaration import Declaration
from msg_graph.duration import exact_duration
from msg_graph.errors import printable
from msg_graph.model import Callback, ExecutionTime
from msg_graph.yamltext import plain_scalar


def flat_text(declaration: Declaration) -> str:
    """Return the YAML text of a declaration, all in one."""
    return '\n'.join(_lines(declaration)) + '\n'


def _lines(declaration: Declaration) -> Iterator[str]:
    yield f'# put together from {printable(declaration.file)} and what it includes'
    yield 'mddag: 1'
    if declaration.workers is not None:
        yield f'workers: {declaration.workers}'
    yield 'nodes:'
    node = None
    for entry in declaration.entries:
        if entry.callback.node != node:
            node = entry.callback.node
            yield f'  - node: {plain_scalar(node)}'
            yield '    callbacks:'
        yield from _callback(entry.callback)
    if declaration.paths:
        yield 'paths:'
    for path in declaration.paths:
        yield f'  - name: {plain_scalar(path.path.name)}'
        yield '    callbacks:'
        yield from (f"      - '{key}'" for key in path.path.callbacks)


def _callback(callback: Callback) -> Iterator[str]:
    yield f'      - name: {plain_scalar(callback.name)}'
    for key, value in (
        ('timer', _time(callback.timer_period_ns)),
        ('subscription', callback.topics[0] if callback.kind == 'subscription' else None),
        ('sync', _list(callback.topics) if callback.kind == 'sync' else None),
        ('service', callback.service),
        ('period', None if callback.kind == 'timer' else _time(callback.period_ns)),
        ('publishes', _list(callback.publishes)),
        ('reads', _list(callback.reads)),
        ('deadline', _time(callback.deadline_ns)),
        ('release_from', callback.release_from if callback.release_from != 'arrival' else None),
        ('group', _name(callback.group)),
        ('dag', _name(callback.dag)),
        ('on_miss', callback.on_miss if callback.on_miss != 'continue' else None),
        ('max_active_jobs', callback.max_active_jobs),
        ('execution_time', _execution_time(callback.execution_time)),
        ('holds_interpreter', None if callback.holds_interpreter is None
         else str(callback.holds_interpreter).lower()),
    ):
        if value is not None:
            yield f'        {key}: {value}'


def _time(nanoseconds: int | None) -> str | None:
    return None if nanoseconds is None else exact_duration(nanoseconds)


def _name(text: str | None) -> str | None:
    return None if text is None else plain_scalar(text)


def _list(texts: tuple[str, ...]) -> str | None:
    return f'[{", ".join(map(plain_scalar, texts))}]' if texts else None


def _execution_time(time: ExecutionTime | None) -> str | None:
    if time is None:
        return None
    if len(time.quantiles_ns) == 1:
        return exact_duration(time.quantiles_ns[0])
    return quantiles_text(time)


def quantiles_text(time: ExecutionTime) -> str:
    """Return quantiles and the shares that they belong to, as a mapping in one line."""
    quantiles = ', '.join(f'{ns / 1000:.3f}'.rstrip('0').rstrip('.') for ns in time.quantiles_ns)
    percent = ', '.join(repr(share).removesuffix('.0') for share in time.percent)
    return f'{{quantiles_us: [{quantiles}], percent: [{percent}]}}'
