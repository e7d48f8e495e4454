# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Tab completion in shells, with argcomplete (`eval "$(register-python-argcomplete mddag)"`)."""

from __future__ import annotations

import argparse
import os

from mddag_executor.cli.verbs import load, VERBS


def complete() -> None:
    """Print what can follow on the command line that the shell passes, and exit."""
    import argcomplete
    words = os.environ.get('COMP_LINE', '').split()[1:]
    parser = argparse.ArgumentParser(prog='mddag')
    parsers = {'': parser.add_subparsers()}
    for verb in VERBS:
        *family, name = verb.split()
        above = ' '.join(family)
        if above not in parsers:
            parsers[above] = parsers[''].add_parser(above).add_subparsers()
        inner = parsers[above].add_parser(name)
        if words[:len(family) + 1] == verb.split():     # imports the module of this verb only
            load(verb).add_arguments(inner)
    argcomplete.autocomplete(parser)
