# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Entry point of `mddag`: find the verb, run it, turn errors into one line and an exit status.

Theory of operation: the table of verbs below holds the one-line helps, so that `mddag --help`
imports no verb; the module of a verb is imported when that verb is named, and only then. Options
and files follow the verb, in any order (`parsing.py`). Whatever the user can cause is an exception
of a known tree and becomes one line `error: PLACE: what is wrong: what to do`; several errors of a
declaration are one line each. `docs/commands.md` lists the exit statuses. `MDDAG_DEBUG=1` in
the environment shows the traceback of every error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
import errno
import io
import math
import os
import signal
import sys
import threading
import time
from types import FrameType
from typing import Any

from mddag_executor import __version__
from mddag_executor.cli.parsing import Parser, unknown, verb_parser
from mddag_executor.cli.text import label, one_line, set_quiet
from mddag_executor.cli.verbs import load, REMOVED, TASKS, VERBS
from mddag_executor.defaults import SAME_SIGNAL_S
from mddag_executor.errors import from_user_code, MddagError, UsageError, UserCodeError

EXIT_BAD_INPUT = 2
EXIT_DEFECT = 70
EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141
EXIT_SIGNAL = 128
"""A shell adds the number of the signal."""


# The verbs that run nodes of the user, who may need these threads.
_HOSTS = {'mddag run', 'mddag rerun', 'mddag demo'}
_FAMILIES = {verb.split()[0] for verb in VERBS if ' ' in verb}
# What a ROS installation brings; pip leaves it out unless asked for the extra `ros`.
_ROS = ('rclpy', 'std_msgs', 'rcl_interfaces', 'diagnostic_msgs', 'ament_index_python')


def overview(family: str = '') -> str:
    """Return the help that lists the verbs; of a family (`graph`) only its own."""
    lines = [f'usage: mddag {family and family + " "}VERB …', '',
             'Run ROS 2 callbacks by their deadlines, and check recorded runs offline.']
    for task, verbs in TASKS.items():
        shown = {verb: text for verb, text in verbs.items()
                 if not family or verb.startswith(f'{family} ')}
        if shown:
            lines += ['', f'{task}:', *(f'  {verb:<23} {text}' for verb, text in shown.items())]
    return '\n'.join((*lines, '', "'mddag VERB --help' explains a verb and shows an example. "
                      "'mddag --version' shows the version."))


def find_verb(argv: Sequence[str]) -> tuple[Parser, Sequence[str]]:
    """Return the parser and the arguments of the verb that a command line names."""
    family = argv[0] if argv and argv[0] in _FAMILIES else ''
    prog = f'mddag {family}'.rstrip()
    count = 2 if family else 1
    if len(argv) < count:
        raise UsageError(f"{prog}: a verb is missing: see '{prog} --help'")
    word, verb = argv[count - 1], ' '.join(argv[:count])
    if word in ('-h', '--help'):
        print(overview(family))
        raise SystemExit(0)
    if word == '--version' and not family:
        print(f'mddag {__version__}')
        raise SystemExit(0)
    if word.startswith('-'):
        raise UsageError(f'{prog}: {one_line(word)}: options of a verb follow it: '
                         f"see '{prog} --help'")
    if verb in REMOVED:
        raise UsageError(f'mddag {verb}: there is no such verb any more: {REMOVED[verb]}')
    if verb not in VERBS:
        whole = next((each for each in VERBS if each.endswith(f' {word}')), None)
        if not family and whole is not None:
            raise UsageError(f"{prog}: there is no verb '{word}': did you mean '{whole}'?")
        known = (each.removeprefix(f'{family} ') for each in VERBS)
        raise unknown(prog, 'verb', word, [each for each in known if ' ' not in each]
                      + ([] if family else sorted(_FAMILIES)))
    return verb_parser(f'mddag {verb}', load(verb), VERBS[verb]), argv[count:]


def run(argv: Sequence[str]) -> int:
    """Parse and do what a command line says; return the verb's exit status."""
    parser, rest = find_verb(argv)
    if parser.prog not in _HOSTS:
        # Each thread that OpenBLAS makes spins for a while, and nothing here multiplies matrices.
        os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    args = parser.parse(rest)
    set_quiet(args.quiet)
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
    _open_streams()
    if '_ARGCOMPLETE' in os.environ:
        from mddag_executor.cli.completion import complete
        complete()
    with _ending_signals() as received:
        status = status_of(run, sys.argv[1:] if argv is None else argv)
    return EXIT_SIGNAL + received[0] if received else status


@contextmanager
def _ending_signals() -> Iterator[list[int]]:
    """
    Let SIGTERM and SIGHUP end a command as Ctrl-C does, so no incomplete file remains.

    An ignored signal (`nohup`) stays ignored.  Yields a list that gets the number of the signal.
    """
    received: list[int] = []
    last, process = -math.inf, os.getpid()

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal last
        if os.getpid() != process:  # a node has forked this one, which ends as any other
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        if (now := time.monotonic()) - last >= SAME_SIGNAL_S:
            last, received[:] = now, [number]
            raise KeyboardInterrupt

    numbers = [number for number in (signal.SIGTERM, signal.SIGHUP)
               if signal.getsignal(number) == signal.SIG_DFL
               and threading.current_thread() is threading.main_thread()]
    for number in numbers:
        signal.signal(number, interrupt)
    try:
        yield received
    finally:
        for number in numbers:
            if signal.getsignal(number) is interrupt:  # a run that a signal ended ignores more
                signal.signal(number, signal.SIG_DFL)


def status_of(run: Callable[[Sequence[str]], int], argv: Sequence[str]) -> int:
    """Do what the arguments say; report what is raised, and return the exit status."""
    try:
        # A name that the terminal's encoding lacks is escaped; it must not end the program.
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors='backslashreplace')
        return run(argv)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        _silence_stdout()
        return EXIT_BROKEN_PIPE
    except SystemExit:
        raise
    except BaseException as error:      # an asyncio.CancelledError is no Exception
        if isinstance(error, OSError) and error.errno == errno.ENOSPC and error.filename is None:
            _silence_stdout()
        line = user_line(error)
        raised = error.__cause__ if isinstance(error, UserCodeError) else error
        if line is None or raised is not error or os.environ.get('MDDAG_DEBUG') == '1':
            import traceback
            traceback.print_exception(raised and from_user_code(raised))
        if line is None:
            return EXIT_DEFECT
        for each in _user_lines(error, line):
            print(f'{label("error", sys.stderr)}: {each}', file=sys.stderr)
        return error.status if isinstance(error, MddagError) else EXIT_BAD_INPUT


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
    # GraphError is no MddagError; if its module was not imported, none was raised
    graph_errors = sys.modules.get('msg_graph.errors')
    if isinstance(error, MddagError) or (
            graph_errors is not None and isinstance(error, graph_errors.GraphError)):
        return one_line(str(error))
    if isinstance(error, OSError) and error.filename is None and error.errno in _PLACES:
        error.filename = _PLACES[error.errno]
    if isinstance(error, OSError) and error.filename is not None:
        reason = error.strerror or type(error).__name__
        remedy = _REMEDIES.get(error.errno) or _REMEDIES.get(
            type(error), 'check the path and the disk')
        name = error.filename if error.filename2 is None else error.filename2
        place = name if isinstance(name, int) else os.fsdecode(name)
        return one_line(f'{place}: {reason[:1].lower()}{reason[1:]}: {remedy}')
    if isinstance(error, ModuleNotFoundError) and error.name in _ROS:
        return (f'{error.name}: ROS 2 was not found: source the setup file of your ROS 2, '
                "or install 'mddag_executor[ros]' with pip")
    return None


_PLACES = {errno.ENOSPC: 'standard output', errno.ENOENT: 'working directory',
           errno.EMFILE: 'this process'}
"""The places of errors without a file name."""
_REMEDIES: dict[type[BaseException] | int | None, str] = {
    FileNotFoundError: 'check the path',
    IsADirectoryError: 'name a file',
    NotADirectoryError: 'check the path',
    PermissionError: 'change its permissions or name another file',
    errno.ENOSPC: 'free space, or name another file',
    errno.EDQUOT: 'free space, or name another file',
    errno.EMFILE: "allow more with 'ulimit -n'",
}


def _open_streams() -> None:
    """
    Open standard streams that are closed (`2>&-`), to write to nowhere.

    Otherwise the next file that is opened would get their number, and with it what a library in C
    prints.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    for name in ('stdout', 'stderr'):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, 'w', encoding='utf-8'))


def _silence_stdout() -> None:
    # The interpreter flushes stdout once more at its exit, and would complain again.
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):
        pass  # stdout is not a file descriptor (captured by a test), or is closed already
