# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The parts of the program know one another in one direction only.

    cli -> rerun -> report, hosting -> (executor | replay | laboratory) -> simulate
        -> trace, core -> msg_graph

Imports are read from the sources, those inside functions and for type checkers included. Ruff
(`SLF`) checks which modules use private names of rclpy.
"""

import ast
from pathlib import Path

import pytest

pytestmark = pytest.mark.linter
TOP = Path(__file__).resolve().parent.parent

LEVELS = {
    'msg_graph': 0,
    'mddag_executor.errors': 1,
    'mddag_executor.memory': 1,
    'mddag_executor.defaults': 1,
    'mddag_executor.text': 1,
    'mddag_executor.resources': 2,
    'mddag_executor': 3,  # its __init__.py, to those who want the version
    'mddag_executor.core': 4,
    'mddag_executor.trace': 4,
    'mddag_executor.recording': 5,
    'mddag_executor.simulate': 5,  # below replay, which reschedules with its engine
    'mddag_executor.laboratory': 6,
    'mddag_executor.executor': 6,
    'mddag_executor.replay': 6,
    'mddag_executor.report': 7,
    'mddag_executor.hosting': 7,
    'mddag_executor.rerun': 8,
    'mddag_executor.cli': 9,
    'mddag_executor.__main__': 10,
}
# What mddag_executor/__init__.py passes on belongs to the part that it comes from.
PASSED_ON = {'mddag_executor.DeadlineMiss': 'mddag_executor.executor',
             'mddag_executor.MultiDeadlineExecutor': 'mddag_executor.executor',
             'mddag_executor.open_recording': 'mddag_executor.replay'}
# The core takes events with their times and answers with decisions; it asks for nothing.
NOT_IN_CORE = {
    'asyncio', 'concurrent', 'datetime', 'io', 'logging', 'multiprocessing', 'os', 'pathlib',
    'queue', 'random', 'rclpy', 'selectors', 'signal', 'socket', 'subprocess', 'sys', 'threading',
    'time', 'yaml',
}
# Offline parts work on a machine without ROS.
ROS = {'rclpy', 'ros2cli', 'rcl_interfaces', 'std_msgs', 'diagnostic_msgs', 'builtin_interfaces',
       'launch', 'launch_ros', 'ament_index_python', 'rosidl_parser'}
MAY_USE_ROS = {'mddag_executor.executor', 'mddag_executor.hosting', 'mddag_executor.rerun',
               'mddag_executor.cli'}


def part_of(module):
    """Return the part of the program that a module belongs to; None for foreign ones."""
    names = PASSED_ON.get(module, module).split('.')
    part = '.'.join(names[:2])
    if names[0] not in ('msg_graph', 'mddag_executor'):
        return None
    return part if part in LEVELS else names[0]


def imports(module, text, is_package):
    """Yield line and full name of what a module imports."""
    package = module.split('.') if is_package else module.split('.')[:-1]
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[:len(package) - node.level + 1] if node.level else []
            name = '.'.join([*base, *filter(None, [node.module])])
            yield from ((node.lineno, f'{name}.{alias.name}') for alias in node.names)


def violations(module, text, is_package=False):
    """Yield what a module imports and must not."""
    mine = part_of(module)
    for line, name in imports(module, text, is_package):
        theirs = part_of(name)
        foreign = name.split('.')[0]
        passed_on = module == 'mddag_executor' and f'{module}.{name.split(".")[-1]}' in PASSED_ON
        if theirs not in (None, mine) and LEVELS[theirs] >= LEVELS[mine] and not passed_on:
            yield f'{module}:{line} imports {name}: {theirs} is no part below {mine}'
        if mine == 'mddag_executor.core' and foreign in NOT_IN_CORE:
            yield f'{module}:{line} imports {name}: the core knows no clock and no thread'
        if foreign in ROS and mine not in MAY_USE_ROS:
            yield f'{module}:{line} imports {name}: {mine} works without ROS'


def modules():
    """Yield name and text of each module, and whether it is a package."""
    for package in ('msg_graph', 'mddag_executor'):
        for path in sorted((TOP / package).rglob('*.py')):
            names = path.relative_to(TOP).with_suffix('').parts
            is_package = names[-1] == '__init__'
            yield ('.'.join(names[:-1] if is_package else names),
                   path.read_text(encoding='utf-8'), is_package)


def test_imports_point_one_way():
    folders = {f'mddag_executor.{path.parent.name}'
               for path in (TOP / 'mddag_executor').glob('*/__init__.py')}
    assert folders and folders - set(LEVELS) == set()
    assert [line for module in modules() for line in violations(*module)] == []
