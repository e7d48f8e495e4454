# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Run tests with broken executors, each run in a process of its own.

``python driver.py FOLDER`` reads the runs from standard input, as JSON: for each a name, one of
``mddag_mutations.MUTATIONS`` (or '': the executor stays as it is) and the arguments of pytest.
What the tests made of it is in ``FOLDER/NAME.jsonl`` then, what pytest printed in
``FOLDER/NAME.txt``.  Processes are forked when what takes long to import is there, which saves
most of what they cost; rclpy is not imported before, because it starts threads.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
import signal
import sys

import hypothesis
import lark
import msg_graph
import numpy
import pytest
import pytest_timeout
import yaml

EARLY = (hypothesis, lark, msg_graph, numpy, pytest_timeout, yaml)

AT_ONCE = 3
"""So many runs at a time: their tests mostly wait."""
RUN_S = 170
"""A run that takes longer is ended."""


def run(folder: Path, name: str, mutation: str, arguments: list[str]) -> None:
    """Be one run, and end with it."""
    status = 99
    try:
        signal.alarm(RUN_S)
        output = os.open(folder / f'{name}.txt', os.O_WRONLY | os.O_CREAT, 0o600)
        os.dup2(output, 1)
        os.dup2(output, 2)
        import mddag_mutations
        mddag_mutations.report = folder / f'{name}.jsonl'
        if mutation:
            mddag_mutations.MUTATIONS[mutation]()
        status = int(pytest.main(arguments, plugins=[mddag_mutations]))
    finally:
        sys.stdout.flush()
        os._exit(status)  # whatever threads a broken executor has left


def main() -> None:
    assert 'rclpy' not in sys.modules
    running: set[int] = set()
    for one in json.load(sys.stdin):
        if len(running) >= AT_ONCE:
            running.discard(os.wait()[0])
        process = os.fork()
        if process == 0:
            run(Path(sys.argv[1]), one['name'], one['mutation'], one['arguments'])
        running.add(process)
    while running:
        running.discard(os.wait()[0])


if __name__ == '__main__':
    main()
