# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verdicts of a replay for CI systems: JUnit XML, and annotations of GitHub Actions.

A sink within the tolerance passes; otherwise it fails, with the reason. A sink without due jobs is
skipped in JUnit XML, and a warning in GitHub's summary. There is one test case per sink; its time
is the longest response time, in seconds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any
from xml.etree import ElementTree

from mddag_executor.core.tally import counts
from mddag_executor.report.text import format_ns, printable

_NEVER_DUE = 'no job of it was due'

Sinks = Mapping[tuple[str, str], str]
"""By DAG and sink why a sink failed."""


def junit(result: Mapping[str, Any], broken: Sinks, name: str) -> bytes:
    """Return JUnit XML of a result of ``replay --json``; ``name`` is that of the recording."""
    cases = []
    skipped = 0
    for dag_name, dag in result['dags'].items():
        for sink_name, sink in dag['sinks'].items():
            response, why = sink['response_ns'], broken.get((dag_name, sink_name))
            case = ElementTree.Element('testcase', {
                'classname': _text(dag_name), 'name': _text(sink_name),
                'time': f'{response["max"] / 1e9 if response else 0:.9f}'})
            if why is not None:
                ElementTree.SubElement(
                    case, 'failure', {'message': _text(why), 'type': 'DeadlineMiss'})
            elif not counts(sink).due:
                skipped += 1
                ElementTree.SubElement(case, 'skipped', {'message': _NEVER_DUE})
            ElementTree.SubElement(case, 'system-out').text = _text(_facts(sink))
            cases.append(case)
    figures = {
        'name': _text(f'mddag replay {name}'), 'tests': str(len(cases)),
        'failures': str(len(broken)), 'errors': '0', 'time': f'{result["duration_ns"] / 1e9:.9f}'}
    root = ElementTree.Element('testsuites', figures)
    suite = ElementTree.SubElement(root, 'testsuite', figures, skipped=str(skipped))
    suite.extend(cases)
    ElementTree.indent(root)
    xml: bytes = ElementTree.tostring(root, encoding='utf-8', xml_declaration=True)
    return xml + b'\n'


def _facts(sink: Mapping[str, Any]) -> str:
    verdicts, response = counts(sink), sink['response_ns']
    text = (f'deadline {format_ns(sink["relative_deadline_ns"])}: {verdicts.in_time} of '
            f'{verdicts.due} in time')
    if response:
        text += ', response time ' + ', '.join(
            f'{key} {format_ns(response[key], 3)}' for key in ('median', 'p99', 'max'))
    return text


def _text(text: str) -> str:
    """Return a text for XML, which does not allow most control characters."""
    return ''.join(c if c.isprintable() else printable(c) for c in text)


def annotation_lines(dags: Mapping[str, Any], broken: Sinks, file: str | None) -> Iterator[str]:
    """Yield the lines that GitHub Actions shows in its summary; ``file`` is the declaration."""
    for dag_name, dag in dags.items():
        for sink_name, sink in dag['sinks'].items():
            why = broken.get((dag_name, sink_name))
            if why is not None or not counts(sink).due:
                properties = {} if file is None else {'file': file}
                properties['title'] = f'Deadline of {sink_name}'
                given = ','.join(
                    f'{name}={_escaped(text, ":,")}' for name, text in properties.items())
                level = 'warning' if why is None else 'error'
                yield f'::{level} {given}::{_escaped(_NEVER_DUE if why is None else why)}'


def _escaped(text: str, more: str = '') -> str:
    """Return a text that cannot end the line or, in a property, the property."""
    text = printable(text).replace('%', '%25')
    for character in more:
        text = text.replace(character, f'%{ord(character):02X}')
    return text
