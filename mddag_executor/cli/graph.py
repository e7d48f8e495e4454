# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `graph`: what a declaration means; each of its own verbs is a module `graph_…`.

Those modules import nothing heavy before they run: `mddag graph --help` stays quick.
"""

from __future__ import annotations

import argparse

from mddag_executor.cli.options import add_verbs

EXAMPLE = """\
mddag graph check config/autoware.yaml
mddag graph draw config/autoware.yaml -o autoware.svg
mddag graph check --help
"""

VERBS = ('check', 'draw', 'schema', 'fmt', 'from-caret', 'from-trace', 'from-ros', 'analyse',
         'assign-deadlines', 'place')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verbs of this verb, with their arguments."""
    add_verbs(parser, 'graph', VERBS)
