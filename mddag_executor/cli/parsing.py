# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The parser of a verb's arguments: made from the verb's module, for options and files in any order.

argparse fills every positional argument from the first group of words without an option, so that
`replay run.mcap --reschedule graph.yaml` has no place for the last word. `Parser.parse` therefore
parses the options first and the words between them after that, for all verbs.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from itertools import takewhile
from types import ModuleType
from typing import NoReturn

from mddag_executor.errors import UsageError

_REST = ('--', '--ros-args')
"""What follows one of these is not for the parser."""


class Parser(argparse.ArgumentParser):
    """An argument parser that reports a wrong command line as a `UsageError`."""

    _given: Sequence[str] = ()
    _has_verbs = False

    def parse(self, args: Sequence[str]) -> argparse.Namespace:
        """Parse options and other arguments, in any order up to `--`."""
        self._given = args
        if self._has_verbs or '--' in args:     # argparse would forget about `--`
            return self.parse_args(args)
        return self.parse_intermixed_args(args)

    def add_verbs(self, summaries: Mapping[str, str]) -> None:
        """Show verbs in the help; one of them has to come before any other argument."""
        self._has_verbs = True
        verbs = self.add_subparsers(dest='verb', metavar='VERB', required=True, title='verbs')
        for name, summary in summaries.items():
            verbs.add_parser(name, help=summary, add_help=False)

    def error(self, message: str) -> NoReturn:
        """Raise instead of printing the usage over several lines and exiting."""
        remedy = f"see '{self.prog} --help'"
        for word in takewhile(lambda each: each not in _REST, self._given):
            name = word.partition('=')[0] if word.startswith('--') else word[:2]
            if _is_option(name) and name not in self._option_string_actions:
                from msg_graph.errors import did_you_mean
                message = f"there is no option '{name}'"
                if self._has_verbs:
                    remedy = f'options of a verb follow it, {remedy}'
                remedy = did_you_mean(name, self._option_string_actions, remedy)
                break
        raise UsageError(f'{self.prog}: {message}: {remedy}')


def _is_option(word: str) -> bool:
    return len(word) > 2 if word.startswith('--') else word[:1] == '-' and word[1:].isalpha()


def verb_parser(prog: str, module: ModuleType, description: str) -> Parser:
    """
    Return the parser of a verb.

    :param prog: the command up to the verb
    :param module: has `EXAMPLE`, `add_arguments`, and `main`, which becomes `args.main`
    """
    parser = _parser(prog, description, module.EXAMPLE.strip().splitlines())
    module.add_arguments(parser)
    parser.set_defaults(main=module.main)
    return parser


def group_parser(prog: str, modules: Mapping[str, ModuleType], description: str) -> Parser:
    """Return the parser of a verb that has verbs."""
    parser = _parser(
        prog, description, [module.EXAMPLE.split('\n')[0] for module in modules.values()])
    parser.add_verbs({name: module.HELP for name, module in modules.items()})
    return parser


def _parser(prog: str, description: str, examples: Sequence[str]) -> Parser:
    return Parser(
        prog=prog, allow_abbrev=False, description=description,
        epilog='\n  '.join(('example:', *examples)),
        formatter_class=argparse.RawDescriptionHelpFormatter)
