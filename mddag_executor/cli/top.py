# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `top`: the states of executors on `/diagnostics`, live in a terminal.

It only listens, so it watches processes on any machine that ROS reaches, and costs them nothing.
Statuses of others on the topic are left out. On a terminal the picture is renewed in place (with
rich, the extra `top`); elsewhere, or with `--once`, it is printed as plain tables.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
import os
import sys
import time

from mddag_executor.cli import common, options
from mddag_executor.errors import MddagError, UsageError
from mddag_executor.report.board import Board, KEYS, picture, plain

EXAMPLE = """\
mddag top
mddag top --once --json - | jq '.statuses[] | select(.level != "OK")'"""

TOPIC = '/diagnostics'
INTERVAL_S = 1.0
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
    if live:
        _check_rich()
    board = Board()
    seconds = None if args.duration is None else args.duration / 1e9
    with _listening(board) as spin:
        try:
            if args.once:
                _wait(spin, board, args.timeout / 1e9)
            elif live:
                _show_live(_ticks(spin, board, seconds, args.timeout / 1e9), board, seconds)
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
        print(plain(board.statuses()), end='')
    return 0


def _check_rich() -> None:
    try:
        import rich  # noqa: F401
    except ImportError:
        raise UsageError(
            'top: it shows live pictures with rich, which is not installed: pip install '
            "'mddag_executor[top]', or use --once") from None


def _wait(spin: Callable[[float], None], board: Board, seconds: float) -> None:
    end = time.monotonic() + seconds
    while not board.statuses() and time.monotonic() < end:
        spin(0.1)
    # what other processes publish within the same second is shown, too
    end = min(end, time.monotonic() + INTERVAL_S)
    while time.monotonic() < end:
        spin(0.1)


def _show_live(ticks: Iterator[None], board: Board, seconds: float | None) -> None:
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text
    console = Console()
    waiting = Text(
        'waiting for an executor to publish its state: mddag run does, and a program with '
        f'diagnostics_period ({KEYS})')
    with _keys() as pressed, Live(
            waiting, console=console, auto_refresh=False, screen=seconds is None) as screen:
        for _ in ticks:
            statuses = board.statuses()
            screen.update(
                picture(statuses, console.width) if statuses else waiting, refresh=True)
            if 'q' in pressed():
                return


@contextmanager
def _keys() -> Iterator[Callable[[], str]]:
    """Give a function that returns what was typed since; nothing if there is no terminal."""
    if not sys.stdin.isatty():
        yield str
        return
    import select
    import termios
    import tty
    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    tty.setcbreak(number)

    def typed() -> str:
        ready = select.select([number], [], [], 0)[0]
        return os.read(number, 1024).decode('utf-8', 'replace') if ready else ''

    try:
        yield typed
    finally:
        termios.tcsetattr(number, termios.TCSADRAIN, before)


def _print_now_and_then(ticks: Iterator[None], board: Board, tables: bool) -> None:
    for _ in ticks:
        statuses = board.statuses()
        if statuses and tables:
            print(plain(statuses), flush=True)


def _ticks(
    spin: Callable[[float], None], board: Board, seconds: float | None, patience_s: float
) -> Iterator[None]:
    """Listen; yield once an interval until the time is over, or nothing has arrived in time."""
    begin = time.monotonic()
    due = begin + INTERVAL_S
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
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node
    from rclpy.parameter import Parameter
    from rclpy.signals import SignalHandlerOptions
    context = Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = Node(
            'mddag_top', context=context, enable_rosout=False, start_parameter_services=False,
            parameter_overrides=[Parameter('start_type_description_service', value=False)])
        node.create_subscription(DiagnosticArray, TOPIC, board.take, 10)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        yield lambda seconds: executor.spin_once(seconds)
        executor.shutdown(1.0)
    finally:
        context.try_shutdown()
