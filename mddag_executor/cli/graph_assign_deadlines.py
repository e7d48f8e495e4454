# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph assign-deadlines`: relative deadlines for the sinks of a declaration."""

from __future__ import annotations

import argparse
import sys

from mddag_executor import defaults
from mddag_executor.cli import common, options
from mddag_executor.cli.text import Cell, format_ns, is_quiet, table

EXAMPLE = """\
mddag graph assign-deadlines graph.yaml -o assigned.yaml
mddag evaluate assigned.yaml --runs 1000"""
DESCRIPTION = """\
Give each sink a relative deadline; comments, order and all else of the declaration stay, and sinks
without a deadline are accepted. The deadlines are in proportion to the critical paths: the sink of
a DAG with the longest path gets the DAG's period, the others less. 'mddag evaluate' finds how
often they hold."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    options.add(parser, 'graph', '--output', '--json')
    parser.add_argument(
        '--budget', choices=defaults.BUDGETS, default='p99',
        help='which value of each execution time makes the critical path (default: %(default)s)')


def main(args: argparse.Namespace) -> int:
    """Assign deadlines."""
    from mddag_executor.laboratory.assign_deadlines import proportional
    from msg_graph.edit import deadlines_in_text, load_with_or_without_deadlines
    name, text = common.read_text(args.graph)
    task_set, _ = load_with_or_without_deadlines(text, name)
    deadlines = proportional(task_set, args.budget)
    common.write_text(args.output, deadlines_in_text(task_set, text, deadlines))
    common.write_result(args, {'budget': args.budget, 'deadlines_ns': deadlines})
    if args.json != '-' and not is_quiet():
        rows: list[list[Cell]] = [
            [dag.name if i == 0 else '', dag.vertices[sink].name, format_ns(dag.period_ns),
             format_ns(deadlines[dag.vertices[sink].callback.key])]
            for dag in task_set.dags for i, sink in enumerate(dag.sinks)]
        print(table(['DAG', 'sink', 'period', 'deadline'], rows),
              file=sys.stderr if args.output == '-' else sys.stdout)
    return 0
