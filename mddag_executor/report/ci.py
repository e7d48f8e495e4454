# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verdicts of a replay for CI systems: JUnit XML, and annotations of GitHub Actions.

A sink within the tolerance passes; otherwise it fails, with the reason. A sink without due jobs is
skipped in JUnit XML, and a warning in GitHub's summary. There is one test case per sink, and one
per requirement of a path; its time is the longest response time, in seconds.
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


def junit(
    result: Mapping[str, Any], broken: Sinks, late: Sinks, name: str
) -> bytes:
    """
    Return JUnit XML of a result of ``replay --json``.

    :param late: by path and requirement why it is not met.
    :param name: that of the recording.
    """
    cases = []
    skipped = 0
    for group, each, found, why in _judged(result, broken, late):
        response = found['response_ns']
        case = ElementTree.Element('testcase', {
            'classname': _text(group), 'name': _text(each),
            'time': f'{response["max"] / 1e9 if response else 0:.9f}'})
        if why is not None:
            ElementTree.SubElement(
                case, 'failure', {'message': _text(why), 'type': 'DeadlineMiss'})
        elif not counts(found).due:
            skipped += 1
            ElementTree.SubElement(case, 'skipped', {'message': _NEVER_DUE})
        ElementTree.SubElement(case, 'system-out').text = _text(
            _facts(found, 'deadline' if group in result['dags'] else 'required'))
        cases.append(case)
    figures = {
        'name': _text(f'mddag replay {name}'), 'tests': str(len(cases)),
        'failures': str(len(broken) + len(late)), 'errors': '0',
        'time': f'{result["duration_ns"] / 1e9:.9f}'}
    root = ElementTree.Element('testsuites', figures)
    suite = ElementTree.SubElement(root, 'testsuite', figures, skipped=str(skipped))
    suite.extend(cases)
    ElementTree.indent(root)
    xml: bytes = ElementTree.tostring(root, encoding='utf-8', xml_declaration=True)
    return xml + b'\n'


def _judged(
    result: Mapping[str, Any], broken: Sinks, late: Sinks
) -> Iterator[tuple[str, str, Mapping[str, Any], str | None]]:
    """Yield sinks and requirements of paths: group, name, result, and why it failed."""
    for dag_name, dag in result['dags'].items():
        for sink_name, sink in dag['sinks'].items():
            yield dag_name, sink_name, sink, broken.get((dag_name, sink_name))
    for path, required in result.get('requirements', {}).items():
        for what, found in required.items():
            yield f'path {path}', what, found, late.get((path, what))


def _facts(sink: Mapping[str, Any], what: str) -> str:
    verdicts, response = counts(sink), sink['response_ns']
    text = (f'{what} {format_ns(sink["relative_deadline_ns"])}: {verdicts.in_time} of '
            f'{verdicts.due} in time')
    if response:
        text += ', response time ' + ', '.join(
            f'{key} {format_ns(response[key], 3)}' for key in ('median', 'p99', 'max'))
    return text


def _text(text: str) -> str:
    """Return a text for XML, which does not allow most control characters."""
    return ''.join(c if c.isprintable() else printable(c) for c in text)


def annotation_lines(
    result: Mapping[str, Any], broken: Sinks, late: Sinks, file: str | None
) -> Iterator[str]:
    """Yield the lines that GitHub Actions shows in its summary; ``file`` is the declaration."""
    for group, each, found, why in _judged(result, broken, late):
        if why is not None or not counts(found).due:
            properties = {} if file is None else {'file': file}
            properties['title'] = (
                f'Deadline of {each}' if group in result['dags'] else f'{group}: {each}')
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
