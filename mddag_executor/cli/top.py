# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `top`: the states of sinks and workers on `/diagnostics`, live in a terminal.

It only listens, so it watches processes on any machine that ROS reaches, and costs them nothing.
Statuses of other programs on the topic are left out. On a terminal the tables are renewed in
place; elsewhere, or with `--once`, they are printed as a whole.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
import math
import shutil
import sys
import time

from mddag_executor.cli import common, options
from mddag_executor.errors import MddagError
from mddag_executor.report.board import Board, tables

EXAMPLE = """\
mddag top
mddag top --once --json - | jq '.sinks[] | select(.level != "OK")'"""

TOPIC = '/diagnostics'
INTERVAL_S = 1.0
_CLEAR = '\x1b[H\x1b[J'  # ECMA-48: to the first line, and erase from there
_WAITING = """\
waiting for an executor to publish its state: mddag run does, and a program with
diagnostics_period (Ctrl-C ends)"""
PATIENCE_NS = 10_000_000_000


class NothingHeard(MddagError):
    """No executor publishes its state."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('--once', action='store_true', help='print the state once, as soon as it has arrived')
    add('--duration', type=options.duration, metavar='TIME',
        help='end after this time, for instance 20s (default: run until Ctrl-C)')
    add('--timeout', type=options.duration, default=PATIENCE_NS, metavar='TIME',
        help='with --once or --duration: give up if nothing has arrived by then (default: 10s)')
    options.add(parser, '--json')


def main(args: argparse.Namespace) -> int:
    board, wanted = Board(), common.wants_tables(args)
    live = sys.stdout.isatty() and not args.once and wanted
    # Ctrl-C is how one leaves it
    with _listening(board) as spin, suppress(KeyboardInterrupt):
        for _ in _ticks(spin, board, args.duration, args.timeout, args.once):
            statuses = board.statuses()
            if live:
                columns, lines = shutil.get_terminal_size()
                text = tables(statuses, columns) if statuses else _WAITING
                print(_CLEAR + '\n'.join(text.splitlines()[:lines - 1]), flush=True)
            elif statuses and wanted and not args.once:
                print(tables(statuses), flush=True)
        if (args.once or args.duration is not None) and not board.statuses():
            raise NothingHeard(
                f'{TOPIC}: no executor has published its state here: start one with '
                'mddag run, or with diagnostics_period, and check ROS_DOMAIN_ID')
    if common.write_result(args, board.result()) and args.once:
        print(tables(board.statuses()), end='')
    return 0


def _ticks(
    spin: Callable[[float], None], board: Board, duration_ns: int | None, patience_ns: int,
    once: bool = False,
) -> Iterator[None]:
    """
    Listen; yield once an interval until the time is over, or nothing has arrived in time.

    :param once: what other processes publish within an interval of the first status is the end.
    """
    begin = due = time.monotonic()
    end = math.inf if duration_ns is None or once else begin + duration_ns / 1e9
    while (now := time.monotonic()) < end:
        spin(0.1)
        if board.statuses():
            end = min(end, now + INTERVAL_S) if once else end
        elif (once or duration_ns is not None) and now - begin > patience_ns / 1e9:
            return
        if now >= due:
            due += INTERVAL_S
            yield


@contextmanager
def _listening(board: Board) -> Iterator[Callable[[float], None]]:
    """Subscribe; give a function that collects what comes within a time."""
    from diagnostic_msgs.msg import DiagnosticArray
    from mddag_executor.executor.quiet_nodes import quiet_node
    from mddag_executor.hosting.initialised import initialised
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    with initialised(None, Context()) as context:
        node = quiet_node('mddag_top', context)
        node.create_subscription(DiagnosticArray, TOPIC, board.take, 10)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        yield lambda seconds: executor.spin_once(seconds)
        executor.shutdown(1.0)
