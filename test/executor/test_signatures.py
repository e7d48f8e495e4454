# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Whatever rclpy's executors may be called with, these may be called with as well."""

import inspect
import re

from mddag_executor import MultiDeadlineExecutor
from mddag_executor.hosting.guest_executor import _guest_class
import pytest
from rclpy.executors import Executor, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation

KINDS = [Executor, SingleThreadedExecutor, MultiThreadedExecutor]
VARIABLE = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD


def public(kind):
    """Return the names of the public methods and attributes of a class."""
    return [name for name in dir(kind) if not name.startswith('_')]


def parameters(function):
    return list(inspect.signature(function).parameters.values())


def check(ours, theirs):
    """Check that a function accepts what another one does."""
    mine = {each.name: each for each in parameters(ours)}
    places = [*mine]
    takes_any = any(each.kind is inspect.Parameter.VAR_KEYWORD for each in mine.values())
    for place, each in enumerate(parameters(theirs)):
        if each.kind in VARIABLE:
            assert any(other.kind is each.kind for other in mine.values()), each
        elif each.kind is inspect.Parameter.KEYWORD_ONLY:
            assert each.name in mine or takes_any, each
        else:
            assert places[place] == each.name, each
        if each.default is not inspect.Parameter.empty and each.name in mine:
            assert mine[each.name].default is not inspect.Parameter.empty, each
    names = {each.name for each in parameters(theirs)}
    for each in mine.values():
        assert each.name in names or each.kind in VARIABLE or (
            each.default is not inspect.Parameter.empty), each


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('ours', [lambda _: MultiDeadlineExecutor, _guest_class],
                         ids=['executor', 'of a program'])
def test_methods_accept_what_those_of_rclpy_accept(ours, kind):
    for name in public(kind):
        theirs, mine = (inspect.getattr_static(each, name) for each in (kind, ours(kind)))
        if callable(theirs):
            check(mine, theirs)
        else:
            assert type(mine) is type(theirs), name


@pytest.mark.parametrize('kind', KINDS)
def test_the_constructor_accepts_what_those_of_rclpy_accept_by_name(kind):
    mine = inspect.signature(MultiDeadlineExecutor).parameters
    assert {*inspect.signature(kind).parameters} <= {*mine}


@pytest.mark.skipif(not hasattr(rclpy_implementation, 'EventsExecutor'),
                    reason='this rclpy has no EventsExecutor')
def test_methods_accept_what_those_of_the_events_executor_accept():
    """Its methods are written in C++: their docstrings begin with the signature."""
    kind = rclpy_implementation.EventsExecutor
    for name in public(kind):
        method = getattr(kind, name)
        assert hasattr(MultiDeadlineExecutor, name), name
        if not callable(method):
            continue
        signature = re.match(rf'{name}\((.*)\) ->', method.__doc__)
        names = re.findall(r'(?:^|, )(\*{0,2}\w+)(?=[:,]|$)', signature[1])
        mine = [*inspect.signature(getattr(MultiDeadlineExecutor, name)).parameters.values()]
        for place, each in enumerate(names):
            if each.startswith('*'):
                assert any(str(other).startswith(each[:each.rindex('*') + 1]) for other in mine)
            elif each != 'self' and not re.fullmatch(r'arg\d+', each):
                assert mine[place].name == each, (name, signature[1])
            else:
                assert len(mine) > place, (name, signature[1])
