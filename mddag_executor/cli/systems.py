# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the verbs that make declarations share: recorded systems, and writing the declaration."""

from __future__ import annotations

from pathlib import Path
import tempfile
from typing import TYPE_CHECKING

from mddag_executor.cli import common
from mddag_executor.cli.text import Progress, say, warn
from mddag_executor.text import counted

if TYPE_CHECKING:
    from mddag_executor.analysis.drafting import System


def recorded_system(*paths: str) -> System:
    """
    Return the system in a trace (`-`: standard input), or in a session of LTTng (a folder).

    :param paths: several, or their folder: the traces of all processes of one run.
    """
    from mddag_executor.analysis.drafting import System
    given = common.one_run(paths, ())
    with Progress('reading the trace') as line:
        if isinstance(given, str) and given != '-' and _is_session(given):
            from mddag_executor.trace import import_ctf
            with tempfile.TemporaryDirectory(prefix='mddag-') as folder:
                trace = Path(folder, 'session.mcap')
                warnings = import_ctf(given, trace, progress=line.events).warnings
                system = System(trace, given, line.events)
            system.warnings = [*warnings, *system.warnings]
        else:
            system = System(*common.input_path(given), line.events)
    warn(*system.warnings)
    return system


def _is_session(path: str) -> bool:
    """Return whether a path is a folder that LTTng recorded to, or what CARET has left of one."""
    from mddag_executor.trace.ctf import CARET_CACHE
    folder = Path(path)
    return folder.is_dir() and (
        any(folder.rglob('metadata')) or folder.joinpath(CARET_CACHE).exists())


def write_declaration(output: str, text: str) -> None:
    """Write a declaration, and print how many blanks it has and how many callbacks it lacks."""
    from msg_graph.blanks import MARK
    from msg_graph.draft import LEFT_OUT
    common.write_text(output, text)
    if output == '-':
        return
    lines = text.splitlines()
    count = sum(MARK in line for line in lines[2:])
    if count:
        say(f"{counted(count, 'blank')} to fill in, marked '{MARK}'")
    else:
        say('no blanks to fill in')
    if count := sum(line.startswith(LEFT_OUT) for line in lines):
        say(f"{counted(count, 'callback')} left out: see '{LEFT_OUT}' in it")
