# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `graph`: what a declaration means; each of its own verbs is a module `graph_…`.

Those modules import nothing heavy before they run: `mddag graph --help` stays quick.
"""

from __future__ import annotations

import argparse
from importlib import import_module

from mddag_executor.cli.options import add_verb

EXAMPLE = """\
mddag graph check config/autoware.yaml
mddag graph draw config/autoware.yaml -o autoware.svg
mddag graph check --help
"""

VERBS = ('check', 'draw', 'schema', 'fmt', 'from-caret', 'from-trace', 'from-ros', 'analyse',
         'assign-deadlines', 'place')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verbs of this verb, with their arguments."""
    verbs = parser.add_subparsers(dest='graph_verb', metavar='VERB', required=True, title='verbs')
    for name in VERBS:
        module = import_module(f'mddag_executor.cli.graph_{name.replace("-", "_")}')
        add_verb(verbs, name, module, module.HELP, module.DESCRIPTION)
