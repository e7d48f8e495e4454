# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Running verbs in this process, on input that they use or refuse in lines that say why."""

import contextlib
import io

from mddag_executor.cli import main as program
from mddag_executor.cli.text import printable


def run(*words, about=''):
    """Run a verb, and check how it ends; return its status and output."""
    out, err = (io.TextIOWrapper(io.BytesIO(), 'utf-8', newline='\n') for _ in range(2))
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = program.main(words)
    for stream in (out, err):
        stream.seek(0)
    printed, said = out.read(), err.read()
    assert status in (0, 1, 2), f'{about}: {words}: {said}'
    for line in (printed + said).split('\n'):
        assert line == printable(line), f'{about}: {words}'
    assert all(line.startswith(('error: ', 'warning: ')) for line in said.splitlines()), said
    # A recording in which nothing was due has tables all the same.
    assert status != 2 or 'error: ' in said and (
        not printed or 'so no deadline was judged' in said), said
    return status, printed
