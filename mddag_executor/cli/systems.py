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
        if isinstance(given, str) and given != '-' and Path(given).is_dir():
            from mddag_executor.trace import import_ctf
            from mddag_executor.trace.reader import no_trace
            traces = any(Path(given).glob('*.mcap')) or not any(Path(given).iterdir())
            if traces and not any(Path(given).rglob('metadata')):
                raise no_trace(given)
            with tempfile.TemporaryDirectory(prefix='mddag-') as folder:
                trace = Path(folder, 'session.mcap')
                warnings = import_ctf(given, trace, progress=line.events).warnings
                system = System(trace, given, line.events)
            system.warnings = [*warnings, *system.warnings]
        else:
            system = System(*common.input_path(given), line.events)
    warn(*system.warnings)
    return system


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
