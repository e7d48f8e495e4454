# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Entry point of `mddag`: find the verb, run it, turn errors into one line and an exit status.

Theory of operation: the table of verbs below holds the one-line helps, so that `mddag --help`
imports nothing but argparse; the module of a verb is imported when that verb is named first on the
command line, and only then. Options and files follow the verb, in any order (`parsing.py`).
Whatever the user can cause comes up as an exception of a known tree and leaves as one line
`error: PLACE: what is wrong: what to do`, several errors of a declaration as one line each. The
exit status is

| status | meaning |
| --- | --- |
| 0 | done |
| 1 | done, and with `--fail-on-miss` a deadline was missed |
| 2 | bad input or usage |
| 70 | a defect of this program or of a node, with its traceback (EX_SOFTWARE) |
| 130 | interrupted with Ctrl-C |
| 141 | the reader of the output went away |

`MDDAG_DEBUG=1` in the environment shows the traceback of every error.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
import errno
from importlib import import_module
import io
import os
import sys
from types import ModuleType
from typing import Any, NamedTuple

from mddag_executor import __version__
from mddag_executor.cli.parsing import group_parser, Parser, verb_parser
from mddag_executor.cli.text import one_line
from mddag_executor.errors import MddagError, UsageError, UserCodeError

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
        'check', 'draw', 'schema', 'from-caret', 'from-trace', 'from-ros', 'analyse',
        'assign-deadlines', 'place')),
    'import': Verb('import', 'turn a CARET or ros2_tracing recording into a trace', ('ctf',)),
    'export': Verb('export', 'turn a recording into files for Perfetto or for data frames'),
    'diff': Verb('diff', 'compare two recorded runs sink by sink'),
    'top': Verb('top', 'show the deadlines and workers of running executors, live'),
}
# What a ROS installation brings; pip leaves it out unless asked for the extra `ros`.
_ROS = ('rclpy', 'std_msgs', 'rcl_interfaces', 'diagnostic_msgs', 'ament_index_python')


def load(verb: Verb) -> ModuleType:
    """Import the module of a verb."""
    return import_module(f'mddag_executor.cli.{verb.module}')


def load_inner(verb: Verb, name: str) -> ModuleType:
    """Import the module of a verb of a verb."""
    return import_module(f'mddag_executor.cli.{verb.module}_{name.replace("-", "_")}')


def find_verb(argv: Sequence[str]) -> tuple[Parser, Sequence[str]]:
    """
    Find the verb that a command line names.

    :returns: its parser and its arguments
    :raises mddag_executor.errors.UsageError: when there is no such verb
    """
    name, rest = _first_word(program_parser, 'mddag', VERBS, argv)
    verb = VERBS[name]
    sentence = f'{verb.summary[:1].upper()}{verb.summary[1:]}.'
    if not verb.verbs:
        return verb_parser(f'mddag {name}', load(verb), sentence), rest
    modules = dict.fromkeys(verb.verbs)
    inner, rest = _first_word(
        lambda: group_parser(f'mddag {name}', {each: load_inner(verb, each) for each in modules},
                             sentence), f'mddag {name}', modules, rest)
    module = load_inner(verb, inner)
    return verb_parser(f'mddag {name} {inner}', module, module.DESCRIPTION), rest


def _first_word(
    parser: Callable[[], Parser], prog: str, verbs: Collection[str], argv: Sequence[str]
) -> tuple[str, Sequence[str]]:
    """Return the verb that comes first, and what follows; do what an option there says."""
    if not argv or argv[0].startswith('-'):
        parser().parse(argv[:1])   # shows help or version, or fails
    if argv[0] not in verbs:
        from msg_graph.errors import did_you_mean, shown
        remedy = did_you_mean(argv[0], verbs, f"see '{prog} --help'")
        raise UsageError(f'{prog}: there is no verb {shown(argv[0])}: {remedy}')
    return argv[0], argv[1:]


def program_parser() -> Parser:
    """Return the parser of what stands before the verb."""
    parser = Parser(
        prog='mddag', allow_abbrev=False,
        description='Run ROS 2 callbacks by their deadlines, and check recorded runs offline.',
        epilog="'mddag VERB --help' explains a verb and shows an example.")
    parser.add_argument('--version', action='version', version=f'mddag {__version__}')
    parser.add_verbs({name: verb.summary for name, verb in VERBS.items()})
    return parser


def run(argv: Sequence[str]) -> int:
    """
    Parse and do what a command line says.

    :returns: the verb's exit status
    """
    parser, rest = find_verb(argv)
    args = parser.parse(rest)
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
        raised = error.__cause__ if isinstance(error, UserCodeError) else error
        if line is None or raised is not error or os.environ.get('MDDAG_DEBUG') == '1':
            import traceback
            traceback.print_exception(raised)
        if line is None:
            return EXIT_DEFECT
        for each in filter(None, _user_lines(error, line)):
            print(f'error: {each}', file=sys.stderr)
        return EXIT_BAD_INPUT if raised is error else EXIT_DEFECT


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
