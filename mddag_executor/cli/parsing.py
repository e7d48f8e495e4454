# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The parser of a verb's arguments: options and files in any order, errors as one line."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from itertools import takewhile
from types import ModuleType
from typing import NoReturn

from mddag_executor.errors import UsageError

_REST = ('--', '--ros-args')
"""Words after one of these are not for the parser."""


class Parser(argparse.ArgumentParser):
    """An argument parser that reports a wrong command line as a `UsageError`."""

    _words: Sequence[str] = ()
    removed_options: Mapping[str, str] = {}
    """What to do instead of an option that earlier versions had."""

    def parse(self, words: Sequence[str]) -> argparse.Namespace:
        """Parse options and other arguments, in any order up to `--`."""
        self._words = words
        if '--' in words:     # argparse would lose it
            return self.parse_args(words)
        return self.parse_intermixed_args(words)

    def error(self, message: str) -> NoReturn:
        """Raise instead of printing the usage and exiting."""
        for word in takewhile(lambda each: each not in _REST, self._words):
            name = word.partition('=')[0] if word.startswith('--') else word[:2]
            if name in self.removed_options:
                raise UsageError(f'{self.prog}: there is no option {name} any more: '
                                 f'{self.removed_options[name]}')
            if _is_option(name) and name not in self._option_string_actions:
                raise unknown(self.prog, 'option', name, self._option_string_actions)
        raise UsageError(f"{self.prog}: {message}: see '{self.prog} --help'")


def unknown(prog: str, kind: str, word: str, known: Iterable[str]) -> UsageError:
    """Return the error about a verb or option that does not exist."""
    from msg_graph.errors import did_you_mean, quoted
    remedy = did_you_mean(word, known, f"see '{prog} --help'")
    return UsageError(f'{prog}: there is no {kind} {quoted(word)}: {remedy}')


def _is_option(word: str) -> bool:
    return len(word) > 2 if word.startswith('--') else word[:1] == '-' and word[1:].isalpha()


def _example(text: str) -> str:
    """Return the end of a help text: commands, and perhaps a paragraph below them."""
    commands, *below = text.strip().split('\n\n')
    return '\n\n'.join(('\n  '.join(('example:', *commands.splitlines())), *below))


def verb_parser(prog: str, module: ModuleType, summary: str) -> Parser:
    """
    Return the parser of a verb.

    :param prog: the command up to the verb
    :param module: has `EXAMPLE`, `add_arguments`, perhaps `DESCRIPTION` and `REMOVED_OPTIONS`, and
        `main`, which becomes `args.main`
    """
    parser = Parser(
        prog=prog, allow_abbrev=False,
        description=getattr(module, 'DESCRIPTION', f'{summary[:1].upper()}{summary[1:]}.'),
        epilog=_example(module.EXAMPLE),
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.removed_options = getattr(module, 'REMOVED_OPTIONS', {})
    module.add_arguments(parser)
    parser.add_argument('-q', '--quiet', action='store_true',
                        help='no tables, warnings and progress: only errors and written files')
    parser.set_defaults(main=module.main)
    return parser
