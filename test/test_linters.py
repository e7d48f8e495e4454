# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Ruff and mypy, and what they do not check: English, headers and dependencies."""

import ast
from pathlib import Path
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest

from . import english
from .doc_blocks import pages

pytestmark = pytest.mark.linter

TOP = Path(__file__).resolve().parent.parent
NAMES = (
    'setup.py', 'mddag_executor', 'msg_graph', 'benchmarks', 'launch', 'config', 'examples',
    'test')
ROOTS = [name for name in NAMES if (TOP / name).exists()]
SOURCES = sorted(path for root in ROOTS
                 for path in ((TOP / root).rglob('*.py') if (TOP / root).is_dir()
                              else [TOP / root]))
HEADER = re.compile(r'# Copyright 20\d\d The mddag_executor developers\n'
                    r'# SPDX-License-Identifier: Apache-2\.0\n')

# What the packages import, with the key in package.xml and the name in setup.py that bring it.
# None in setup.py: the extra `ros` does. None in package.xml: another key does, or it is an extra.
THIRD_PARTY = {
    **{name: (name, None) for name in (
        'ament_index_python', 'action_msgs', 'diagnostic_msgs', 'launch', 'launch_ros',
        'rcl_interfaces', 'rclpy', 'ros2cli', 'rosgraph_msgs', 'rosidl_parser', 'std_msgs')},
    **{name: (None, name) for name in (
        'distributed', 'llvmlite', 'matplotlib', 'pandas', 'pyarrow')},
    **{name: ('mcap-ros2-support', name) for name in ('lz4', 'mcap', 'zstandard')},
    'argcomplete': ('python3-argcomplete', 'argcomplete'),
    'isal': (None, 'isal'),
    'numpy': ('python3-numpy', 'numpy'),
    'rosbags': ('python3-rosbags-pip', 'rosbags'), 'yaml': ('python3-yaml', 'PyYAML'),
}


def run(*command):
    result = subprocess.run([sys.executable, '-m', *command], cwd=TOP, text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False)
    if result.returncode != 0:
        pytest.fail(result.stdout, pytrace=False)


def test_ruff():
    pytest.importorskip('ruff', reason='ruff is not installed')
    run('ruff', 'check', '--no-cache', '--output-format', 'concise', *ROOTS)


# What it finds depends on the Python, and on the types that numpy has for it.
@pytest.mark.skipif(sys.version_info[:2] != (3, 12), reason='mypy runs with Python 3.12 only')
@pytest.mark.slow
@pytest.mark.timeout(900)  # minutes on a busy machine, without what earlier runs have found
def test_mypy():
    pytest.importorskip('mypy', reason='mypy is not installed')
    run('mypy')


# It has the patterns and their examples.
UNCHECKED_ENGLISH = ('test/english.py',)


def others():
    """Return the further files with comments, those of a checkout: scripts, workflows and such."""
    patterns = ('Makefile', 'MANIFEST.in', '*.toml', '*.yml', '.ci/*', '.github/**/*.yml',
                'docker/*', 'config/*.yaml', 'examples/**/*.sh', 'examples/**/*.yaml',
                'resource/mddag')
    return sorted(path for pattern in patterns for path in TOP.glob(pattern) if path.is_file())


def test_english():
    paths = [*(TOP / page for page in pages()), *SOURCES, *others()]
    found = [line for path in paths
             if not path.relative_to(TOP).as_posix().startswith(UNCHECKED_ENGLISH)
             for line in english.findings(path)]
    if found:
        pytest.fail('\n'.join(found), pytrace=False)


@pytest.mark.parametrize('pattern', english.PATTERNS, ids=lambda pattern: pattern.remedy[:30])
def test_english_patterns_find_their_examples(pattern, tmp_path):
    text = pattern.example.replace('`', '')
    assert re.search(pattern.regex, text), pattern
    page, module, script = tmp_path / 'page.md', tmp_path / 'module.py', tmp_path / 'script'
    page.write_text(f'# Title\n\n* {text}\n\n```text\n{text}\n```\n', encoding='utf-8')
    module.write_text(f'"""{text}"""\n# {text}\n', encoding='utf-8')
    assert len(english.findings(page, tmp_path)) == 1
    assert len(english.findings(module, tmp_path)) == 2
    script.write_text(f'#!/bin/sh\n# {text}\nrun  # {text}\n', encoding='utf-8')
    assert len(english.findings(script, tmp_path)) == 2


def test_tests_import_helpers_and_not_each_other():
    found = [f'{path.relative_to(TOP)}: {line}' for path in sorted((TOP / 'test').rglob('*.py'))
             for line in re.findall(r'^from (?:\.\S*\.|\.+)test_\w+ import .*$',
                                    path.read_text(encoding='utf-8'), re.MULTILINE)]
    assert not found


def test_copyright():
    assert SOURCES
    assert not [str(path.relative_to(TOP)) for path in SOURCES
                if not HEADER.match(path.read_text(encoding='utf-8'))]
    assert 'Apache License' in (TOP / 'LICENSE').read_text(encoding='utf-8')


@pytest.mark.skipif(shutil.which('make') is None, reason='there is no make')
def test_the_makefile_names_tests_that_exist():
    made = subprocess.run(['make', '-n', 'test-kilted', 'nightly', 'lint'], cwd=TOP, text=True,
                          capture_output=True, check=True).stdout
    tests = [word for word in made.split() if word.startswith('test/')]
    assert len(tests) > 10 and [name for name in tests if not (TOP / name).exists()] == []


def package_xml():
    return ElementTree.parse(TOP / 'package.xml').getroot()


def test_names_and_versions_agree():
    from mddag_executor import __version__
    root = package_xml()
    name = root.findtext('name')
    assert (name, root.findtext('version')) == ('mddag_executor', __version__)
    newest = re.search(r'^## (\S+) - 20', (TOP / 'CHANGELOG.md').read_text(encoding='utf-8'), re.M)
    assert newest is not None and newest[1] == __version__
    assert root.findtext('export/build_type') == 'ament_python'
    assert (TOP / 'resource' / name).is_file()


def test_the_changelog_has_each_line_once():
    """A merge keeps the lines of both sides: so it can double an entry, or a whole section."""
    text = (TOP / 'CHANGELOG.md').read_text(encoding='utf-8')
    versions = re.findall(r'^## (\S+)', text, re.MULTILINE)
    assert len(versions) == len(set(versions)) and len(versions) > 2
    for part in re.split(r'^## ', text, flags=re.MULTILINE)[1:]:
        lines = re.findall(r'^(?:### |- ).*', part, re.MULTILINE)
        assert [line for line in lines if lines.count(line) > 1] == []


def run_nodes(node):
    """Yield all nodes but those that only type checkers read."""
    yield node
    only_types = isinstance(node, ast.If) and ast.unparse(node.test).endswith('TYPE_CHECKING')
    for child in node.orelse if only_types else ast.iter_child_nodes(node):
        yield from run_nodes(child)


def test_what_is_imported_is_declared():
    imported = {}
    for path in SOURCES:
        parts = path.relative_to(TOP).parts
        if parts[0] not in ('mddag_executor', 'msg_graph', 'launch'):
            continue
        for node in run_nodes(ast.parse(path.read_text(encoding='utf-8'))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module or '']
            for name in names:
                imported.setdefault(name.split('.')[0], str(path.relative_to(TOP)))
    foreign = set(imported) - set(sys.stdlib_module_names) - {'mddag_executor', 'msg_graph'}
    assert {'numpy', 'yaml'} & foreign
    unknown = {name: imported[name] for name in foreign - set(THIRD_PARTY)}
    assert unknown == {}, 'add them to package.xml, setup.py and THIRD_PARTY'
    assert set(THIRD_PARTY) - foreign == set(), 'remove them there: nothing imports them'
    keys = {element.text for element in package_xml().iter('exec_depend')}
    # what starts run.launch.py is imported by nothing
    assert keys - {THIRD_PARTY[name][0] for name in foreign} == {'ros2launch'}
    text = (TOP / 'setup.py').read_text(encoding='utf-8')
    required = text[text.index('install_requires'):text.index('extras_require')]
    for name in foreign:
        key, requirement = THIRD_PARTY[name]
        assert key is None or key in keys, (
            f'{name}, imported by {imported[name]}, is not in package.xml')
        assert requirement is None or f"'{requirement}>=" in text, (
            f'{name}, imported by {imported[name]}, is not in setup.py')
        # package.xml has no optional dependencies, so an extra is none of a robot's.
        assert requirement is None or f"'{requirement}>=" in required or (
            key is None and f'python3-{name}' not in keys), name
