# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
The verb `top`: what executors tell on `/diagnostics`, live in a terminal.

It only listens, so it watches processes on any machine that ROS reaches, and costs them nothing.
Statuses of others on the topic are left out. On a terminal the picture is renewed in place (with
rich, the extra `top`); elsewhere, or with `--once`, it is printed as plain tables.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
import sys
import time
from typing import Any

from mddag_executor.cli import common
from mddag_executor.cli.text import printable, table
from mddag_executor.errors import MddagError, UsageError

NAME = 'top'
HELP = 'show live what running executors say of their deadlines and workers'
EXAMPLE = """\
mddag top
mddag top --once --json - | jq '.statuses[] | select(.level != "OK")'"""

LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')
GONE = 'GONE'
GONE_AFTER_S = 5.0
INTERVAL_S = 1.0
PATIENCE_NS = 10_000_000_000
MOST_STATUSES = 1000
_STYLES = {'OK': 'green', 'WARN': 'yellow', 'ERROR': 'bold red', 'STALE': 'magenta', GONE: 'dim'}

_DAG_TITLES = ('process', 'DAG', 'state', 'period ms', 'jobs', 'lately', 'missed', 'p50 ms',
               'p99 ms', 'max ms', 'of deadline', 'message')
_DAG_KEYS = ('period_ms', 'jobs', 'window_results', 'window_missed', 'response_p50_ms',
             'response_p99_ms', 'response_max_ms', 'deadline_used_max')
_POOL_TITLES = ('process', 'workers of', 'state', 'idle', 'queue', 'per s', 'busy', 'CPU',
                'us each', 'dropped', 'skipped', 'no job', 'message')
_POOL_KEYS = ('idle_workers', 'queue', 'callbacks_per_s', 'busy_ratio', 'cpu_ratio',
              'cpu_us_per_callback', 'dropped', 'skipped', 'unattributed')


class NothingHeard(MddagError):
    """Nobody publishes what is to be shown."""


@dataclass(frozen=True)
class Status:
    """A status as it came: whose it is, name, level, message, values, and when it came (s)."""

    process: str
    name: str
    level: str
    message: str
    values: dict[str, str]
    came: float

    @property
    def is_pool(self) -> bool:
        """Tell whether it is about the workers, not a DAG."""
        return 'idle_workers' in self.values

    @property
    def is_ours(self) -> bool:
        """Tell whether an executor of this kind has sent it."""
        return self.is_pool or 'window_missed_ratio' in self.values


class Board:
    """The newest statuses of all processes, of a thousand at most."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._statuses: dict[tuple[str, str], Status] = {}

    def take(self, message: Any) -> None:
        """Take in a ``DiagnosticArray``."""
        now = self._clock()
        for each in message.status:
            level = each.level[0] if isinstance(each.level, bytes) else int(each.level)
            status = Status(
                each.hardware_id, each.name, LEVELS[level] if level < len(LEVELS) else str(level),
                each.message, {pair.key: pair.value for pair in each.values}, now)
            if status.is_ours:
                # At the end, so that the first one is the one that was silent for longest.
                self._statuses.pop((status.process, status.name), None)
                self._statuses[(status.process, status.name)] = status
                if len(self._statuses) > MOST_STATUSES:
                    del self._statuses[next(iter(self._statuses))]

    def statuses(self) -> list[Status]:
        """Return them by process and name; of a process that tells nothing more, as GONE."""
        now = self._clock()
        found = []
        for _, s in sorted(self._statuses.items()):
            if now - s.came > GONE_AFTER_S:
                s = Status(s.process, s.name, GONE, f'nothing heard for {now - s.came:.0f} s',
                           s.values, s.came)
            found.append(s)
        return found

    def result(self) -> dict[str, Any]:
        """Return what there is for machines."""
        return {'statuses': [
            {'process': s.process, 'name': s.name, 'level': s.level, 'message': s.message,
             'values': s.values} for s in self.statuses()]}


def dag_rows(statuses: list[Status]) -> list[list[str]]:
    """Return the rows of the table of DAGs."""
    return [_row(s, _DAG_KEYS) for s in statuses if not s.is_pool]


def pool_rows(statuses: list[Status]) -> list[list[str]]:
    """Return the rows of the table of workers."""
    return [_row(s, _POOL_KEYS) for s in statuses if s.is_pool]


def _row(status: Status, keys: tuple[str, ...]) -> list[str]:
    name = status.name
    if status.is_pool:
        name = name.rpartition(': ')[0] or name
    cells = (status.process, name, status.level, *(status.values.get(k) or '-' for k in keys),
             status.message)
    return [printable(cell) for cell in cells]


def plain(statuses: list[Status]) -> str:
    """Return both tables as text."""
    return (table(_DAG_TITLES, dag_rows(statuses)) + '\n'
            + table(_POOL_TITLES, pool_rows(statuses)))


def picture(statuses: list[Status]) -> Any:
    """Return both tables for rich; nothing in them is taken for markup."""
    from rich.console import Group
    tables = (_rich(_DAG_TITLES, dag_rows(statuses)), _rich(_POOL_TITLES, pool_rows(statuses)))
    return Group(*tables)


def _rich(titles: tuple[str, ...], rows: list[list[str]]) -> Any:
    from rich.table import Table
    from rich.text import Text
    made = Table(box=None, pad_edge=False, header_style='bold')
    for i, title in enumerate(titles):
        words = i < 3 or i == len(titles) - 1
        made.add_column(Text(title), justify='left' if words else 'right', no_wrap=i != 1,
                        overflow='fold' if i == 1 else 'ellipsis')
    for row in rows:
        style = _STYLES.get(row[2], '')
        made.add_row(*(Text(cell, style=style if i == 2 else '') for i, cell in enumerate(row)))
    return made


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add('--topic', default='/diagnostics', help='where to listen (default: /diagnostics)')
    add('--once', action='store_true', help='print what is there once, as soon as it has come')
    add('--duration', type=common.duration, metavar='TIME',
        help='end after this time, as 20s (default: with Ctrl-C)')
    add('--timeout', type=common.duration, default=PATIENCE_NS, metavar='TIME',
        help='with --once or --duration: give up when nothing has come by then (default: 10s)')
    common.add_json(parser)


def main(args: argparse.Namespace) -> int:
    """
    Listen and show.

    :raises mddag_executor.errors.MddagError: when nothing is to be heard, or shown
    """
    common.check_output(args.json)
    live = sys.stdout.isatty() and not args.once and common.wants_tables(args)
    if live:
        _check_rich()
    board = Board()
    seconds = None if args.duration is None else args.duration / 1e9
    with _listening(args.topic, board) as spin:
        try:
            if args.once:
                _wait(spin, board, args.timeout / 1e9)
            elif live:
                _show_live(spin, board, seconds)
            else:
                _print_now_and_then(spin, board, seconds, common.wants_tables(args))
        except KeyboardInterrupt:
            pass  # how one leaves it
    if (args.once or args.duration is not None) and not board.statuses():
        raise NothingHeard(
            f'{printable(args.topic)}: no executor has published its state here: start one with '
            'mddag run, or with diagnostics_period, and check ROS_DOMAIN_ID')
    if args.once and common.wants_tables(args):
        print(plain(board.statuses()), end='')
    if args.json is not None:
        common.write_json(args.json, board.result())
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
    # what other processes tell within the same second belongs to the picture
    end = min(end, time.monotonic() + INTERVAL_S)
    while time.monotonic() < end:
        spin(0.1)


def _show_live(spin: Callable[[float], None], board: Board, seconds: float | None) -> None:
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text
    console = Console()
    waiting = Text('waiting for an executor to publish its state (Ctrl-C ends this)')
    with Live(waiting, console=console, auto_refresh=False, screen=seconds is None) as screen:
        for _ in _ticks(spin, seconds):
            statuses = board.statuses()
            screen.update(picture(statuses) if statuses else waiting, refresh=True)


def _print_now_and_then(
    spin: Callable[[float], None], board: Board, seconds: float | None, tables: bool
) -> None:
    for _ in _ticks(spin, seconds):
        statuses = board.statuses()
        if statuses and tables:
            print(plain(statuses), flush=True)


def _ticks(spin: Callable[[float], None], seconds: float | None) -> Iterator[None]:
    """Listen; yield once an interval until the time is over."""
    begin = time.monotonic()
    due = begin + INTERVAL_S
    while seconds is None or time.monotonic() - begin < seconds:
        spin(0.1)
        if time.monotonic() >= due:
            due += INTERVAL_S
            yield


@contextmanager
def _listening(topic: str, board: Board) -> Iterator[Callable[[float], None]]:
    """Subscribe; give a function that takes in what comes within a time."""
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
        try:
            node.create_subscription(DiagnosticArray, topic, board.take, 10)
        except Exception as error:
            raise UsageError(
                f'--topic {printable(topic)}: {str(error).splitlines()[0]}: give the name of a '
                'topic') from None
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        yield lambda seconds: executor.spin_once(seconds)
        executor.shutdown(1.0)
    finally:
        context.try_shutdown()
