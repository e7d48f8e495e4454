# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The arguments of `launch/run.launch.py`, made from the options of `mddag run`.

The parser of the verb is the only table of its options, so a new option is an argument of the
launch file without further work.  An argument has the name of its option, with underscores; the
empty string leaves the option out.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
import shlex

from mddag_executor.cli.main import find_verb
from mddag_executor.errors import UsageError

_NODES = 'nodes'
"""What the launch file calls `--node`, because one argument names all nodes."""
_YES, _NO = ('true', '1', 'yes', 'on'), ('false', '0', 'no', 'off', '')


def arguments() -> dict[str, str]:
    """Return the name of each argument and its meaning, as `--show-args` prints it."""
    return {_name(action): _meaning(action) for action in _actions()}


def command(values: Mapping[str, str]) -> list[str]:
    """
    Return the words after `mddag` for the values of the arguments.

    :param values: by the names of ``arguments``.
    :raises UsageError: if an argument of several words has a quotation mark without its partner,
        or a switch is neither true nor false.
    """
    words, rest = ['run'], list[str]()
    for action in _actions():
        value = values[_name(action)]
        if not action.option_strings:
            words += [value] if value else []
        elif action.nargs == argparse.REMAINDER:
            parts = _split(action, value)
            rest = [action.option_strings[-1], *parts] if parts else []
        elif action.nargs == 0:
            words += [action.option_strings[-1]] if _is_set(action, value) else []
        else:
            several = isinstance(action, argparse._AppendAction)
            for part in _split(action, value) if several else [value] if value else []:
                words += [action.option_strings[-1], part]
    return words + rest


def _actions() -> Iterator[argparse.Action]:
    """Yield the options and the other arguments of `mddag run`, the declaration first."""
    parser, _ = find_verb(['run'])
    actions = [action for action in parser._actions
               if action.help != argparse.SUPPRESS and action.dest != 'help']
    yield from sorted(actions, key=lambda action: bool(action.option_strings))


def _name(action: argparse.Action) -> str:
    return _NODES if action.dest == 'node' else action.dest


def _meaning(action: argparse.Action) -> str:
    text = (action.help or '') % {**vars(action), 'prog': 'mddag run'}
    if action.nargs == 0:
        return f'true: {text}'
    if isinstance(action, argparse._AppendAction):
        return f'{text}; several are separated by blanks, and one with blanks is quoted'
    return text


def _split(action: argparse.Action, value: str) -> list[str]:
    try:
        return shlex.split(value)
    except ValueError:
        raise UsageError(f'{_name(action)}:={value}: No closing quotation: add it') from None


def _is_set(action: argparse.Action, value: str) -> bool:
    if value.lower() not in (*_YES, *_NO):
        raise UsageError(f'{_name(action)}:={value}: it is a switch: give true or false')
    return value.lower() in _YES
