# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `bench`: what is measured; each subject is a module `bench_…`, as a verb is."""

from __future__ import annotations

import argparse
from importlib import import_module

from mddag_executor.cli.options import add_verb

EXAMPLE = 'mddag bench live --load autoware --executors rad-events,multi --utilisation 0.6'

SUBJECTS = ('live', 'core', 'replay', 'evaluate')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the subjects and their arguments."""
    subjects = parser.add_subparsers(
        dest='subject', metavar='SUBJECT', required=True, title='subjects')
    for name in SUBJECTS:
        module = import_module(f'mddag_executor.cli.bench_{name}')
        add_verb(subjects, name, module, module.HELP, module.DESCRIPTION)
