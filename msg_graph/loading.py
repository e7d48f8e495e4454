# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""From the text of a declaration to its task set."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import gc
from os import fspath, PathLike

from msg_graph.declaration import parse_declaration
from msg_graph.derive import derive_task_set
from msg_graph.draft import with_blanks
from msg_graph.errors import GraphError
from msg_graph.model import TaskSet
from msg_graph.yamltext import decode, MAX_BYTES


def load(path: str | PathLike[str]) -> TaskSet:
    """
    Return the task set of a declaration file.

    :raises GraphError: the file cannot be read, is not YAML, or breaks a rule of the language or
        of the model.
    """
    name = fspath(path)
    try:
        with open(path, 'rb') as file:
            data = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        raise GraphError(
            name, None, f'the file cannot be read ({reason or error})',
            'give the path of a declaration') from None
    return loads(data, name, name)


def loads(
    text: str | bytes, name: str = '<string>', path: str | PathLike[str] | None = None, *,
    without_deadline: list[str] | None = None,
) -> TaskSet:
    """
    Return the task set of a declaration.

    :param text: the YAML; bytes must be UTF-8.
    :param name: what errors call it.
    :param path: the file that it comes from, if it is to include others that lie beside it.
    :param without_deadline: takes the keys of the sinks that have no deadline; None: they are
        errors.
    :raises GraphError: it is not YAML, or breaks a rule of the language or of the model.
    """
    text = decode(text, name) if isinstance(text, bytes) else text
    try:
        with no_garbage():
            return derive_task_set(
                parse_declaration(text, name, None if path is None else fspath(path)),
                without_deadline)
    except GraphError as error:
        raise with_blanks(error, text, name) from None


@contextmanager
def no_garbage() -> Iterator[None]:
    """
    Hold the cyclic garbage collector off.

    Hundreds of thousands of objects come to be and none of them dies; looking for garbage among
    them again and again takes a quarter of the time that it takes to read a declaration.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
