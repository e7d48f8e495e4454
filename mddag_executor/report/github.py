# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Verdicts as annotations of GitHub Actions: output lines that a workflow shows in its summary.

A sink that is not within the tolerance is an error; a sink without due jobs is a warning.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from mddag_executor.core.tally import counts
from mddag_executor.report.text import printable


def annotation_lines(
    dags: Mapping[str, Any], broken: Mapping[tuple[str, str], str], file: str | None
) -> Iterator[str]:
    """
    Yield the lines.

    :param dags: of a result of ``replay --json``
    :param broken: by DAG and sink why it failed
    :param file: the declaration
    """
    for dag_name, dag in dags.items():
        for sink_name, sink in dag['sinks'].items():
            why = broken.get((dag_name, sink_name))
            if why is not None:
                yield _line('error', file, f'Deadline of {sink_name}', why)
            elif not counts(sink).due:
                yield _line('warning', file, f'Deadline of {sink_name}', 'no job of it was due')


def _line(level: str, file: str | None, title: str, message: str) -> str:
    properties = {'title': title} if file is None else {'file': file, 'title': title}
    given = ','.join(f'{name}={_escaped(text, ":,")}' for name, text in properties.items())
    return f'::{level} {given}::{_escaped(message)}'


def _escaped(text: str, more: str = '') -> str:
    """Return a text that cannot end the line or, in a property, the property."""
    text = printable(text).replace('%', '%25')
    for character in more:
        text = text.replace(character, f'%{ord(character):02X}')
    return text
