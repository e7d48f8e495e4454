# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verdicts of a replay as JUnit XML for CI systems: one test case per sink.

A sink within the tolerance passes; otherwise it fails, with the reason; a sink without due jobs is
skipped. The time of a test case is the longest response time, in seconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from xml.etree import ElementTree

from mddag_executor.core.tally import counts
from mddag_executor.report.text import format_ns, printable


def junit(
    result: Mapping[str, Any], broken: Mapping[tuple[str, str], str], name: str
) -> bytes:
    """
    Return the XML.

    :param result: a result of ``replay --json``.
    :param broken: by DAG and sink why it failed.
    :param name: name of the replayed recording.
    """
    cases = []
    failures = skipped = 0
    for dag_name, dag in result['dags'].items():
        for sink_name, sink in dag['sinks'].items():
            verdicts = counts(sink)
            response = sink['response_ns']
            case = ElementTree.Element('testcase', {
                'classname': _text(dag_name), 'name': _text(sink_name),
                'time': f'{response["max"] / 1e9 if response else 0:.9f}'})
            why = broken.get((dag_name, sink_name))
            if why is not None:
                failures += 1
                ElementTree.SubElement(
                    case, 'failure', {'message': _text(why), 'type': 'DeadlineMiss'})
            elif verdicts.due == 0:
                skipped += 1
                ElementTree.SubElement(case, 'skipped', {'message': 'no job of it was due'})
            out = ElementTree.SubElement(case, 'system-out')
            out.text = _text(_facts(sink, verdicts.due, verdicts.in_time))
            cases.append(case)
    figures = {
        'name': _text(f'mddag replay {name}'), 'tests': str(len(cases)),
        'failures': str(failures), 'errors': '0', 'skipped': str(skipped),
        'time': f'{result["duration_ns"] / 1e9:.9f}'}
    root = ElementTree.Element(
        'testsuites', {key: text for key, text in figures.items() if key != 'skipped'})
    suite = ElementTree.SubElement(root, 'testsuite', figures)
    properties = ElementTree.SubElement(suite, 'properties')
    for key in ('policy', 'workers', 'preemptive', 'rescheduled'):
        ElementTree.SubElement(
            properties, 'property', {'name': key, 'value': _text(str(result[key]))})
    suite.extend(cases)
    if result['warnings']:
        ElementTree.SubElement(suite, 'system-err').text = '\n'.join(
            _text(warning) for warning in result['warnings'])
    ElementTree.indent(root)
    xml: bytes = ElementTree.tostring(root, encoding='utf-8', xml_declaration=True)
    return xml + b'\n'


def _facts(sink: Mapping[str, Any], due: int, in_time: int) -> str:
    text = (f'deadline {format_ns(sink["relative_deadline_ns"])}: {in_time} of {due} in time, '
            f'longest burst of misses {sink["longest_burst"]}')
    response = sink['response_ns']
    if response:
        text += ', response time ' + ', '.join(
            f'{key} {format_ns(response[key])}' for key in ('median', 'p99', 'max'))
    return text


def _text(text: str) -> str:
    """Return a text for XML, which does not allow most control characters."""
    return ''.join(c if c.isprintable() else printable(c) for c in text)
