# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verbs of `mddag`: what each does, and the module that does it."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

# Each verb and its one-line help, by task. `graph check` is the module `graph_check`.
TASKS = {
    'Run': {
        'run': 'run rclpy nodes, or nodes made from the declaration, and record them',
        'rerun': 'run real nodes again from a recording, in virtual time',
        'top': 'show the deadlines and workers of running executors, live',
        'demo': 'run, record and replay the Autoware workload, and compare with rclpy'},
    'Judge': {
        'replay': 'check a recorded run against its deadlines, or reschedule it',
        'explain': 'say why each deadline of a recorded run was missed',
        'slack': 'find how much longer callbacks can take before a deadline is missed',
        'diff': 'compare two recorded runs sink by sink',
        'export': 'turn a recording into files for Perfetto or for data frames',
        'import ctf': 'turn a CARET or ros2_tracing recording (LTTng) into a trace'},
    'Declare': {
        'graph check': 'validate a declaration, show its DAGs and whether the deadlines can hold',
        'graph draw': 'draw the DAGs of a declaration (SVG, PNG, PDF, DOT, Mermaid)',
        'graph from-trace': 'draft a declaration from a recorded run',
        'graph from-caret': 'draft a declaration from an architecture file of CARET',
        'graph place': 'pack the nodes into processes that need Python evenly',
        'graph schema': 'print the JSON Schema of declarations, for editors'},
    'Laboratory': {
        'simulate': 'run a declaration once, in virtual time',
        'evaluate': 'measure acceptance ratios over many simulated runs',
        'generate': 'make random declarations, with several deadlines and rates',
        'graph assign-deadlines': 'give the sinks deadlines, by critical paths and requirements'},
}
VERBS = {verb: summary for verbs in TASKS.values() for verb, summary in verbs.items()}
# What to do instead of a verb that earlier versions had.
REMOVED = {
    'graph analyse': "'mddag graph check' tests whether the deadlines can hold",
    'graph from-ros': "record the nodes with 'mddag run --node SPEC --trace RUN.mcap' or "
                      "'ros2 trace', and give the recording to 'mddag graph from-trace'",
}


def load(verb: str) -> ModuleType:
    """Import the module of a verb."""
    return import_module(f'mddag_executor.cli.{verb.replace(" ", "_").replace("-", "_")}')
