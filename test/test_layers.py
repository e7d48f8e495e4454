# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The parts of the program know one another in one direction only.

    cli -> rerun -> hosting -> report, synthetic
        -> (executor | laboratory | whatif -> analysis -> sources)
        -> simulate, recording -> trace, core, compiler -> msg_graph

Imports are read from the sources, those inside functions and for type checkers included. Ruff
(`SLF`) checks which modules use private names of rclpy.
"""

import ast
from pathlib import Path

import pytest

pytestmark = pytest.mark.linter
TOP = Path(__file__).resolve().parent.parent

LEVELS = {part: level for level, parts in enumerate((
    ('msg_graph',), ('mddag_executor.errors', 'mddag_executor.memory', 'mddag_executor.defaults',
                     'mddag_executor.text', 'mddag_executor.results',
                     'mddag_executor.shared_memory'),
    ('mddag_executor.resources', 'mddag_executor.child'),
    ('mddag_executor',),  # its __init__.py, to those who want the version
    ('mddag_executor.core', 'mddag_executor.trace', 'mddag_executor.compiler'),
    # simulate is below whatif, which reschedules with its engine
    ('mddag_executor.recording', 'mddag_executor.simulate'),
    ('mddag_executor.sources',), ('mddag_executor.analysis',),
    ('mddag_executor.laboratory', 'mddag_executor.executor', 'mddag_executor.whatif'),
    ('mddag_executor.report', 'mddag_executor.synthetic'), ('mddag_executor.hosting',),
    ('mddag_executor.rerun',),
    ('mddag_executor.cli',), ('mddag_executor.__main__',))) for part in parts}
# What mddag_executor/__init__.py passes on belongs to the part that it comes from.
PASSED_ON = {'mddag_executor.DeadlineMiss': 'mddag_executor.executor',
             'mddag_executor.MultiDeadlineExecutor': 'mddag_executor.executor',
             'mddag_executor.open_recording': 'mddag_executor.sources',
             'mddag_executor.Traces': 'mddag_executor.sources',
             'mddag_executor.ReplayError': 'mddag_executor.recording',
             'mddag_executor.Replay': 'mddag_executor.analysis',
             'mddag_executor.replay': 'mddag_executor.analysis',
             'mddag_executor.Reschedule': 'mddag_executor.whatif',
             'mddag_executor.reschedule': 'mddag_executor.whatif'}
# The core takes events with their times and answers with decisions; it asks for nothing.
NOT_IN_CORE = {
    'asyncio', 'concurrent', 'datetime', 'io', 'logging', 'multiprocessing', 'os', 'pathlib',
    'queue', 'random', 'rclpy', 'selectors', 'signal', 'socket', 'subprocess', 'sys', 'threading',
    'time', 'yaml',
}
# Only sources see events.
NO_EVENTS = {'mddag_executor.recording', 'mddag_executor.analysis', 'mddag_executor.report'}
# Offline parts work on a machine without ROS.
ROS = {'rclpy', 'ros2cli', 'rcl_interfaces', 'std_msgs', 'diagnostic_msgs', 'builtin_interfaces',
       'launch', 'launch_ros', 'ament_index_python', 'rosidl_parser'}
MAY_USE_ROS = {'mddag_executor.executor', 'mddag_executor.synthetic', 'mddag_executor.hosting',
               'mddag_executor.rerun', 'mddag_executor.cli'}


def part_of(module):
    """Return the part of the program that a module belongs to; None for foreign ones."""
    names = PASSED_ON.get(module, module).split('.')
    part = '.'.join(names[:2])
    if names[0] not in ('msg_graph', 'mddag_executor'):
        return None
    return part if part in LEVELS else names[0]


def imports(path):
    """Yield the module of a file, and line and full name of each of its imports."""
    package = path.relative_to(TOP).parts[:-1]
    module = '.'.join(package if path.stem == '__init__' else (*package, path.stem))
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            yield from ((module, node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[:len(package) - node.level + 1] if node.level else ()
            name = '.'.join([*base, *filter(None, [node.module])])
            yield from ((module, node.lineno, f'{name}.{alias.name}') for alias in node.names)


def violations():
    """Yield what modules import and must not."""
    for path in sorted([*(TOP / 'msg_graph').rglob('*.py'),
                        *(TOP / 'mddag_executor').rglob('*.py')]):
        for module, line, name in imports(path):
            mine, theirs, foreign = part_of(module), part_of(name), name.split('.')[0]
            passed_on = f'{module}.{name.split(".")[-1]}' in PASSED_ON
            if theirs not in (None, mine) and LEVELS[theirs] >= LEVELS[mine] and not passed_on:
                yield f'{module}:{line} imports {name}: {theirs} is not below {mine}'
            if mine == 'mddag_executor.core' and foreign in NOT_IN_CORE:
                yield f'{module}:{line} imports {name}: the core knows no clock and no thread'
            if mine in NO_EVENTS and theirs == 'mddag_executor.trace':
                yield f'{module}:{line} imports {name}: {mine} sees tables, and no events'
            if foreign in ROS and mine not in MAY_USE_ROS:
                yield f'{module}:{line} imports {name}: {mine} works without ROS'


def test_imports_point_one_way():
    folders = {f'mddag_executor.{path.parent.name}'
               for path in (TOP / 'mddag_executor').glob('*/__init__.py')}
    assert folders and folders - set(LEVELS) == set()
    assert list(violations()) == []


def circles(folder):
    """Return the files of a folder that import each other in a circle, if only for type checks."""
    files = {path.stem for path in folder.glob('*.py')} - {'__init__'}
    package = '.'.join(folder.relative_to(TOP).parts)
    seen = {}
    for file in files:
        names = [name.removeprefix(f'{package}.').split('.')[0]
                 for _, _, name in imports(folder / f'{file}.py') if name.startswith(package)]
        seen[file] = {name for name in names if name in files and name != file}
    for middle in files:  # from here to where an import leads at last
        for file in files:
            if middle in seen[file]:
                seen[file] |= seen[middle]
    return {file for file in files if file in seen[file]}


def test_files_of_a_folder_import_each_other_one_way_too():
    folders = [TOP / 'msg_graph', *(path.parent for path in TOP.glob('mddag_executor/*/*.py')
                                    if path.stem == '__init__')]
    found = {folder.name: files for folder in folders if (files := circles(folder))}
    assert found == {}
