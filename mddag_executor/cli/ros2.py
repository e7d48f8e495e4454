# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""`ros2 mddag VERB …`: the same program as a command of ros2cli, which alone imports this."""

from __future__ import annotations

import argparse
import os
from typing import Any

from mddag_executor import __version__
from mddag_executor.cli.main import main, overview
from ros2cli.command import CommandExtension


class MddagCommand(CommandExtension):  # type: ignore[misc]
    """Run nodes by their deadlines, and check recorded runs."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Declare that all that follows is for this program, whose help is shown."""
        if '_ARGCOMPLETE' in os.environ:
            _complete()
        parser.add_argument('--version', action='version', version=f'mddag {__version__}')
        parser.add_argument('arguments', nargs=argparse.REMAINDER)
        parser.format_help = overview  # type: ignore[method-assign]

    def main(self, *, parser: Any, args: argparse.Namespace) -> int:
        """Do what the arguments say; return the exit status."""
        return main(args.arguments)


def _complete() -> None:
    """Complete as for `mddag`, which gets the line without the word before it; exit."""
    from mddag_executor.cli import completion
    line = os.environ['COMP_LINE']
    before = line.index('mddag')
    os.environ['COMP_LINE'] = line[before:]
    os.environ['COMP_POINT'] = str(int(os.environ['COMP_POINT']) - before)
    completion.complete()
