# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Entry point of `mddag`: find the verb, run it, turn errors into one line and an exit status.

Theory of operation: the table of verbs below holds the one-line helps, so that `mddag --help`
imports nothing but argparse; the module of a verb is imported when that verb is named first on the
command line, and only then. Whatever the user can cause comes up as an exception of a known tree
and leaves as one line `error: PLACE: what is wrong: what to do`, several errors of a declaration
as one line each. The exit status is

| status | meaning |
| --- | --- |
| 0 | done |
| 1 | done, and with `--fail-on-miss` a deadline was missed |
| 2 | bad input or usage |
| 70 | a defect of this program or of a node's callback, with its traceback (EX_SOFTWARE) |
| 130 | interrupted with Ctrl-C |
| 141 | the reader of the output went away |

`MDDAG_DEBUG=1` in the environment shows the traceback of every error.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
import errno
from importlib import import_module
import io
from itertools import takewhile
import os
import sys
from types import ModuleType
from typing import Any, NamedTuple, NoReturn

from mddag_executor import __version__
from mddag_executor.cli.options import add_verb, add_verbs
from mddag_executor.cli.text import one_line
from mddag_executor.errors import MddagError, UsageError

EXIT_BAD_INPUT = 2
EXIT_DEFECT = 70
EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141


class Verb(NamedTuple):
    """
    A row of the table of verbs: its module in `mddag_executor.cli` and its one-line help.

    What has verbs itself has these instead: `graph check` is the module `graph_check`.
    """

    module: str
    summary: str
    verbs: tuple[str, ...] = ()


VERBS = {
    'demo': Verb('demo', 'run the whole Autoware workload, record it and replay the recording'),
    'run': Verb('run', 'run rclpy nodes, or nodes made from the declaration, and record them'),
    'rerun': Verb('rerun', 'run real nodes again from a recording, in virtual time'),
    'replay': Verb('replay', 'check a recorded run against its deadlines, or reschedule it'),
    'explain': Verb('explain', 'say why each deadline of a recorded run was missed'),
    'slack': Verb('slack', 'find how much longer callbacks may take before a deadline is missed'),
    'simulate': Verb('simulate', 'run a declaration in virtual time'),
    'evaluate': Verb('evaluate', 'measure acceptance ratios over many simulated runs'),
    'generate': Verb('generate', 'make random multi-deadline, multi-rate DAG sets'),
    'graph': Verb('graph', 'check, draw, derive and analyse declarations', (
        'check', 'draw', 'schema', 'fmt', 'from-caret', 'from-trace', 'from-ros', 'analyse',
        'assign-deadlines', 'place')),
    'import': Verb('import', 'turn a CARET or ros2_tracing recording into a trace', ('ctf',)),
    'export': Verb('export', 'turn a trace into a file for Perfetto, Foxglove or spreadsheets'),
    'diff': Verb('diff', 'compare two recorded runs sink by sink'),
    'top': Verb('top', 'show the deadlines and workers of running executors, live'),
}
# What a ROS installation brings; pip leaves it out unless asked for the extra `ros`.
_ROS = ('rclpy', 'std_msgs', 'rcl_interfaces', 'diagnostic_msgs', 'ament_index_python')


class Parser(argparse.ArgumentParser):
    """An argument parser that reports a wrong command line as a `UsageError`."""

    _given: Sequence[str] = ()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; what is left over is an error here, where the options of the verb are known."""
        self._given = args or ()
        parsed, left = super().parse_known_args(args, namespace)
        if left:
            self.error(f'unrecognized arguments: {" ".join(left)}')
        return parsed, left

    def error(self, message: str) -> NoReturn:
        """Raise instead of printing the usage over several lines and exiting."""
        remedy = f"see '{self.prog} --help'"
        for option in takewhile(lambda each: each not in ('--', '--ros-args'), self._given):
            name = option.partition('=')[0]
            if name.startswith('--') and name not in self._option_string_actions:
                from msg_graph.errors import did_you_mean
                message = f"there is no option '{name}'"
                remedy = did_you_mean(name, self._option_string_actions, remedy)
                break
        raise UsageError(f'{self.prog}: {message}: {remedy}')


def load(verb: Verb) -> ModuleType:
    """Import the module of a verb."""
    return import_module(f'mddag_executor.cli.{verb.module}')


def build_parser(chosen: str | None) -> Parser:
    """Return the program's parser, with the arguments of the chosen verb only."""
    parser = Parser(
        prog='mddag', allow_abbrev=False,
        description='Run ROS 2 callbacks by their deadlines, and check recorded runs offline.',
        epilog="'mddag VERB --help' explains a verb and shows an example.")
    parser.add_argument('--version', action='version', version=f'mddag {__version__}')
    verbs = parser.add_subparsers(dest='verb', metavar='VERB', required=True, title='verbs')
    for name, verb in VERBS.items():
        if name == chosen:
            sentence = f'{verb.summary[:1].upper()}{verb.summary[1:]}.'
            if verb.verbs:
                add_verbs(verbs, name, verb.verbs, verb.summary, sentence)
            else:
                add_verb(verbs, name, load(verb), verb.summary, sentence)
        else:
            verbs.add_parser(name, help=verb.summary, add_help=False)
    return parser


def run(argv: Sequence[str]) -> int:
    """
    Parse and do what a command line says.

    :returns: the verb's exit status
    """
    parser = build_parser(argv[0] if argv else None)
    args = parser.parse_args(argv)
    from mddag_executor.cli.common import check_files
    check_files(args)
    status = int(args.main(args))
    # Here, not at the interpreter's exit: a full disk or a closed pipe must still be reported.
    sys.stdout.flush()
    return status


def main(
    argv: Sequence[str] | None = None, run: Callable[[Sequence[str]], int] = run
) -> int:
    """
    Run the program.

    :param argv: the arguments after the program's name; those of the process when None
    :param run: does what they say
    :returns: the exit status
    """
    try:
        # A name that the terminal's encoding lacks is escaped; it must not end the program.
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors='backslashreplace')
        return run(sys.argv[1:] if argv is None else argv)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        _silence_stdout()
        return EXIT_BROKEN_PIPE
    except Exception as error:
        if isinstance(error, OSError) and error.errno == errno.ENOSPC and error.filename is None:
            _silence_stdout()
        line = user_line(error)
        if line is None or os.environ.get('MDDAG_DEBUG') == '1':
            import traceback
            traceback.print_exception(type(error), error, error.__traceback__)
        if line is None:
            return EXIT_DEFECT
        for each in _user_lines(error, line):
            print(f'error: {each}', file=sys.stderr)
        return EXIT_BAD_INPUT


def _user_lines(error: BaseException, line: str) -> list[str]:
    """Return a line for each error that was found: a declaration may have several."""
    every: Sequence[Any] = getattr(error, 'errors', ())
    if len(every) < 2:
        return [line]
    from msg_graph.errors import MOST_ERRORS
    lines = [one_line(str(each)) for each in every]
    if len(every) >= MOST_ERRORS:
        lines.append(one_line(f'{every[0].file}: there may be more errors: correct these first'))
    return lines


def user_line(error: BaseException) -> str | None:
    """Return the line that reports an error to the user, or None when it is a defect."""
    if isinstance(error, known_errors()):
        return one_line(str(error))
    if isinstance(error, OSError) and error.errno == errno.ENOSPC and error.filename is None:
        error.filename = 'standard output'
    if isinstance(error, OSError) and error.filename is not None:
        reason = error.strerror or type(error).__name__
        remedy = _REMEDIES.get(type(error), 'check the path and what it lies on')
        name = error.filename if error.filename2 is None else error.filename2
        place = name if isinstance(name, int) else os.fsdecode(name)
        return one_line(f'{place}: {reason[:1].lower()}{reason[1:]}: {remedy}')
    if isinstance(error, ModuleNotFoundError) and error.name in _ROS:
        return (f'{error.name}: ROS 2 is not there: source the setup file of your ROS 2, '
                "or install 'mddag_executor[ros]' with pip")
    return None


_REMEDIES: dict[type[BaseException], str] = {
    FileNotFoundError: 'check the path',
    IsADirectoryError: 'name a file',
    NotADirectoryError: 'check the path',
    PermissionError: 'change its permissions or name another file',
}


def known_errors() -> tuple[type[BaseException], ...]:
    """
    Return the base classes of the errors that are the user's to mend.

    That of ``msg_graph``, which stands below this package, derives from none of its own. It is
    looked up in sys.modules: a module that was not imported cannot have raised.
    """
    msg_graph = sys.modules.get('msg_graph')
    return (MddagError,) if msg_graph is None else (MddagError, msg_graph.GraphError)


def _silence_stdout() -> None:
    # The interpreter flushes stdout once more at its exit, and would complain again.
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):
        pass  # stdout is no file descriptor (captured by a test), or is closed already
