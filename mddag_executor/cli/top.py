# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `top`: the states of executors on `/diagnostics`, live in a terminal.

It only listens, so it watches processes on any machine that ROS reaches, and costs them nothing.
Statuses of others on the topic are left out. On a terminal the tables are renewed in place;
elsewhere, or with `--once`, they are printed as a whole.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
import shutil
import sys
import time

from mddag_executor.cli import common, options
from mddag_executor.errors import MddagError
from mddag_executor.report.board import Board, tables

EXAMPLE = """\
mddag top
mddag top --once --json - | jq '.statuses[] | select(.level != "OK")'"""

TOPIC = '/diagnostics'
INTERVAL_S = 1.0
# ECMA-48 and xterm: another screen, no cursor, long lines cut; and back; to the first line; clear
_ENTER, _LEAVE = '\x1b[?1049h\x1b[?25l\x1b[?7l', '\x1b[?7h\x1b[?25h\x1b[?1049l'
_HOME, _TO_END, _BELOW = '\x1b[H', '\x1b[K', '\x1b[J'
_WAITING = """\
waiting for an executor to publish its state: mddag run does, and a program with
diagnostics_period (Ctrl-C ends)"""
PATIENCE_NS = 10_000_000_000


class NothingHeard(MddagError):
    """No executor publishes its state."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add('--once', action='store_true', help='print the state once, as soon as it has arrived')
    add('--duration', type=options.duration, metavar='TIME',
        help='end after this time, for instance 20s (default: run until Ctrl-C)')
    add('--timeout', type=options.duration, default=PATIENCE_NS, metavar='TIME',
        help='with --once or --duration: give up if nothing has arrived by then (default: 10s)')
    options.add(parser, '--json')


def main(args: argparse.Namespace) -> int:
    """Listen and show."""
    live = sys.stdout.isatty() and not args.once and common.wants_tables(args)
    board = Board()
    seconds = None if args.duration is None else args.duration / 1e9
    with _listening(board) as spin:
        try:
            if args.once:
                _wait(spin, board, args.timeout / 1e9)
            elif live:
                _show_live(_ticks(spin, board, seconds, args.timeout / 1e9), board)
            else:
                _print_now_and_then(
                    _ticks(spin, board, seconds, args.timeout / 1e9), board,
                    common.wants_tables(args))
        except KeyboardInterrupt:
            pass  # how one leaves it
    if (args.once or args.duration is not None) and not board.statuses():
        raise NothingHeard(
            f'{TOPIC}: no executor has published its state here: start one with '
            'mddag run, or with diagnostics_period, and check ROS_DOMAIN_ID')
    if common.write_result(args, board.result()) and args.once:
        print(tables(board.statuses()), end='')
    return 0


def _wait(spin: Callable[[float], None], board: Board, seconds: float) -> None:
    end = time.monotonic() + seconds
    while not board.statuses() and time.monotonic() < end:
        spin(0.1)
    # what other processes publish within the same second is shown, too
    end = min(end, time.monotonic() + INTERVAL_S)
    while time.monotonic() < end:
        spin(0.1)


def _show_live(ticks: Iterator[None], board: Board) -> None:
    print(_ENTER, end='')
    try:
        for _ in ticks:
            columns, lines = shutil.get_terminal_size()
            statuses = board.statuses()
            text = tables(statuses, columns) if statuses else _WAITING
            shown = ''.join(f'{line}{_TO_END}\n' for line in text.splitlines()[:lines - 1])
            print(f'{_HOME}{shown}{_BELOW}', end='', flush=True)
    finally:
        print(_LEAVE, end='', flush=True)


def _print_now_and_then(ticks: Iterator[None], board: Board, wanted: bool) -> None:
    for _ in ticks:
        statuses = board.statuses()
        if statuses and wanted:
            print(tables(statuses), flush=True)


def _ticks(
    spin: Callable[[float], None], board: Board, seconds: float | None, patience_s: float
) -> Iterator[None]:
    """Listen; yield once an interval until the time is over, or nothing has arrived in time."""
    begin = time.monotonic()
    due = begin
    while seconds is None or (passed := time.monotonic() - begin) < seconds:
        spin(0.1)
        if seconds is not None and passed > patience_s and not board.statuses():
            return
        if time.monotonic() >= due:
            due += INTERVAL_S
            yield


@contextmanager
def _listening(board: Board) -> Iterator[Callable[[float], None]]:
    """Subscribe; give a function that collects what comes within a time."""
    from diagnostic_msgs.msg import DiagnosticArray
    from mddag_executor.executor.quiet_nodes import quiet_node
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions
    context = Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = quiet_node('mddag_top', context)
        node.create_subscription(DiagnosticArray, TOPIC, board.take, 10)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        yield lambda seconds: executor.spin_once(seconds)
        executor.shutdown(1.0)
    finally:
        context.try_shutdown()
