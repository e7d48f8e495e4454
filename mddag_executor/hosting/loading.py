# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Find and run the programs of ``mddag run --node SPEC``.

Theory of operation
-------------------
A SPEC is

* ``package/executable``, as for ``ros2 run``: a file in ``PREFIX/lib/PACKAGE/`` of the ament index
  (``AMENT_PREFIX_PATH``).  A Python script is executed as ``__main__``, as by Python.
* ``module:NodeClass``: a subclass of ``rclpy.node.Node``; it is constructed without arguments.
* ``module:function``: it may return one or several nodes, or be a ``main()`` that spins.

``resolve`` finds the file or imports the module, so an error in a SPEC is reported before any node
starts; the ``Host`` then runs the returned ``Program``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from importlib import import_module
import inspect
from itertools import dropwhile
import os
from pathlib import Path
import shlex
import sys
import threading
import traceback
from types import ModuleType
from typing import Any, cast

from ament_index_python.packages import (
    get_package_prefix,
    get_packages_with_prefixes,
    PackageNotFoundError,
)
from mddag_executor.errors import MddagError, UserCodeError
from mddag_executor.hosting.run_options import spec_of
from msg_graph.errors import did_you_mean
from rclpy.node import Node

_ROS_ARGS = '--ros-args'
_OF_PROCESS = {  # arguments of rclpy that no node can have alone
    '--log-level', '--log-config-file', '--log-file-name', '--disable-external-lib-logs',
    '--disable-rosout-logs', '--disable-stdout-logs', '--enable-external-lib-logs',
    '--enable-rosout-logs', '--enable-stdout-logs'}


class LoadingError(MddagError):
    """A ``--node`` that cannot be run; one line with the reason and the remedy."""

    def __init__(self, spec: str, problem: str, remedy: str) -> None:
        super().__init__(f'--node {spec}: {problem}: {remedy}')
        self.spec = spec


class ProgramFailed(LoadingError, UserCodeError):
    """A program that raised during its start; the cause is its exception."""


@dataclass(frozen=True)
class Program:
    """
    A program that makes nodes.

    :ivar spec: as the user wrote it.
    :ivar argv0: ``sys.argv[0]`` during its start.
    :ivar run: runs it; the result may be nodes.
    :ivar arguments: its own command line arguments.
    """

    spec: str
    argv0: str
    run: Callable[[], Any]
    arguments: tuple[str, ...] = ()

    @property
    def ros_arguments(self) -> list[str]:
        """Its arguments for rclpy, from ``--ros-args`` on, which are those of its nodes alone."""
        return [*dropwhile(lambda word: word != _ROS_ARGS, self.arguments)]


class MainFailed(UserCodeError):
    """A program whose main raised, which is the cause; the status is Python's."""

    status = 1


def resolve(
    text: str | Callable[[], Any], ros_arguments: Iterable[str] = ()
) -> Program:
    """
    Find the program of a SPEC; its arguments may follow, as in a shell.

    A function or class is such a program itself.

    Imported modules see the command line that the program will see.

    :raises LoadingError: when it cannot be found or imported, or does not make nodes.
    """
    if not isinstance(text, str):
        spec = spec_of(text)
        return Program(spec, spec.partition(':')[0], _checked(spec, spec, text))
    try:
        spec, *arguments = shlex.split(text) or ['']
    except ValueError as error:
        raise LoadingError(text, f'its quotes are not right ({error})', 'correct them') from None
    of_process = sorted(_OF_PROCESS.intersection(
        dropwhile(lambda word: word != _ROS_ARGS, arguments)))
    if of_process:
        raise LoadingError(
            text, f'all nodes of this process share {of_process[0]}',
            'put it after a --ros-args at the end of the command line')
    argv = sys.argv
    sys.argv = [spec.partition(':')[0].rpartition('/')[2], *arguments, *ros_arguments]
    try:
        return replace(_find(spec), spec=text, arguments=tuple(arguments))
    finally:
        sys.argv = argv


def ros_arguments(given: Sequence[str] | None) -> list[str]:
    """Return the ``--ros-args`` for programs and rclpy."""
    return [_ROS_ARGS, *given] if given else []


def _find(spec: str) -> Program:
    package, slash, executable = spec.partition('/')
    module, colon, attribute = spec.partition(':')
    if colon and all(name.isidentifier() for name in [*module.split('.'), attribute]):
        return _attribute(spec, module, attribute)
    if not colon and package and executable and '/' not in executable:
        return _executable(spec, package, executable)
    raise LoadingError(
        spec, 'this names no node',
        'write package/executable, module:function or module:NodeClass')


def _attribute(spec: str, module_name: str, attribute: str) -> Program:
    if '' not in sys.path and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())  # as `python -m` does
    module = _import(spec, module_name)
    target: Any = getattr(module, attribute, None)
    if target is None:
        raise LoadingError(
            spec, f"module '{module_name}' has no '{attribute}'", _suggest(attribute, [
                name for name, value in vars(module).items()
                if not name.startswith('_') and callable(value)]))
    return Program(spec, module_name, _checked(spec, attribute, target))


def _checked(spec: str, attribute: str, target: Any) -> Callable[[], Any]:
    if not callable(target) or isinstance(target, type) and not issubclass(target, Node):
        raise LoadingError(
            spec, f"'{attribute}' makes no node",
            'name a function or a subclass of rclpy.node.Node')
    with suppress(ValueError):  # a builtin may have no signature
        parameters = inspect.signature(target)
        try:
            parameters.bind()
        except TypeError as error:
            raise LoadingError(
                spec, f"'{attribute}' cannot be called without arguments ({error})",
                'name a function or class that needs none') from None
    return cast('Callable[[], Any]', target)


def _import(spec: str, module_name: str) -> ModuleType:
    try:
        return import_module(module_name)
    except ModuleNotFoundError as error:
        raise LoadingError(
            spec, f"there is no module '{error.name or module_name}'",
            'check its name, install it, or add its folder to PYTHONPATH') from error
    except LoadingError:    # it uses rclpy while it is imported
        raise
    except Exception as error:
        wrong = isinstance(error, (ImportError, SyntaxError))  # else the program has raised
        raise (LoadingError if wrong else ProgramFailed)(
            spec, f"'{module_name}' cannot be imported ({describe(error)})",
            'correct it') from error


def _executable(spec: str, package: str, name: str) -> Program:
    try:
        folder = Path(get_package_prefix(package), 'lib', package)
    except (PackageNotFoundError, ValueError, OSError):  # ValueError: an invalid name
        packages: list[str] = []
        with suppress(OSError):
            packages = [*get_packages_with_prefixes()]
        raise LoadingError(
            spec, f"there is no package '{package}'",
            did_you_mean(package, packages, "source its workspace's setup file, or write "
                         'module:function if pip installed it')
        ) from None
    if (folder / name).is_file():
        return _script(spec, folder / name)
    files = [p.name for p in folder.glob('*') if p.is_file() and os.access(p, os.X_OK)]
    raise LoadingError(
        spec, f"package '{package}' has no executable '{name}'", _suggest(name, files))


def _script(spec: str, path: Path) -> Program:
    source = path.read_bytes()
    first_line = source.split(b'\n', 1)[0]
    if not (path.suffix == '.py' or first_line.startswith(b'#!') and b'python' in first_line):
        raise LoadingError(
            spec, f'only Python nodes can run in this process, and {path} is not a Python program',
            "start it by itself with 'ros2 run'")
    try:
        code = compile(source, str(path), 'exec')
    except (SyntaxError, ValueError) as error:
        raise LoadingError(
            spec, f'{path} is not valid Python ({describe(error)})', 'correct it') from None

    def run() -> None:
        # Not runpy.run_path: several scripts run here concurrently, in threads.
        folder = str(path.parent)
        if folder not in sys.path:
            sys.path.insert(0, folder)
        module = ModuleType('__main__')
        module.__file__ = str(path)
        with _as_main(module):
            exec(code, module.__dict__)

    return Program(spec, str(path), run)


@contextmanager
def _as_main(module: ModuleType) -> Iterator[None]:
    """
    Let a script be found as ``__main__`` while it runs: pickle and multiprocessing look there.

    There is only one: that of the main thread.
    """
    before = sys.modules['__main__']
    is_main = threading.current_thread() is threading.main_thread()
    if is_main:
        sys.modules['__main__'] = module
    try:
        yield
    finally:
        if is_main:
            sys.modules['__main__'] = before


def describe(error: BaseException) -> str:
    """Return an exception on one line, with the place where it was raised."""
    # even str(error) may raise
    text = ' '.join(str(traceback.TracebackException.from_exception(error)).split())
    name = type(error).__name__
    if isinstance(error, SyntaxError) and error.filename is not None:
        return f'{name}: {error.msg}, {error.filename}:{error.lineno}'
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if not f.filename.startswith('<') and f.filename != __file__]
    place = f', {own[-1].filename}:{own[-1].lineno}' if own else ''
    return f'{name}: {text}{place}' if text else f'{name}{place}'


def _suggest(word: str, known: Iterable[str]) -> str:
    names = sorted(set(known))
    more = ', …' if len(names) > 10 else ''
    return did_you_mean(
        word, names, f"it has {', '.join(names[:10])}{more}" if names else 'it has none')
