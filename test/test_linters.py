# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The linters of ament, ruff and mypy, and what they leave out: headers and dependencies."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest

pytestmark = pytest.mark.linter

TOP = Path(__file__).resolve().parent.parent
NAMES = (
    'setup.py', 'mddag_executor', 'msg_graph', 'benchmarks', 'launch', 'config', 'examples',
    'test')
ROOTS = [name for name in NAMES if (TOP / name).exists()]
SOURCES = sorted(path for root in ROOTS
                 for path in ((TOP / root).rglob('*.py') if (TOP / root).is_dir()
                              else [TOP / root]))
HEADER = re.compile(
    r'# Copyright 20\d\d The mddag_executor developers\n'
    r'# SPDX-License-Identifier: Apache-2\.0\n')

# What the packages import, with the key in package.xml and the name in setup.py that bring it.
# None in setup.py: the extra `ros` does. None in package.xml: another key does.
THIRD_PARTY: dict[str, tuple[str | None, str | None]] = {
    'ament_index_python': ('ament_index_python', None),
    'action_msgs': ('action_msgs', None),
    'bokeh': (None, 'bokeh'),  # of the extra `report`
    'builtin_interfaces': ('builtin_interfaces', None),
    'diagnostic_msgs': ('diagnostic_msgs', None),
    'dask': (None, 'distributed'),
    'distributed': (None, 'distributed'),  # Dask has no rosdep key; it is an extra
    'geometry_msgs': ('geometry_msgs', None),
    'launch': ('launch', None),
    'launch_ros': ('launch_ros', None),
    'llvmlite': (None, 'numba'),  # of the extra `batch`
    'lz4': ('mcap-ros2-support', 'lz4'),
    'mcap': ('mcap-ros2-support', 'mcap'),
    'matplotlib': (None, 'matplotlib'),  # of the extra `batch`
    'nav_msgs': ('nav_msgs', None),
    'numba': (None, 'numba'),  # of the extra `batch`
    'numpy': ('python3-numpy', 'numpy'),
    'pyarrow': (None, 'pyarrow'),  # of the extra `export`
    'rcl_interfaces': ('rcl_interfaces', None),
    'rclpy': ('rclpy', None),
    'rich': (None, 'rich'),  # of the extra `top`
    'ros2cli': ('ros2cli', None),
    'rosbags': ('python3-rosbags-pip', 'rosbags'),
    'rosgraph_msgs': ('rosgraph_msgs', None),
    'rosidl_parser': ('rosidl_parser', None),
    'sensor_msgs': ('sensor_msgs', None),
    'std_msgs': ('std_msgs', None),
    'yaml': ('python3-yaml', 'PyYAML'),
    'zstandard': ('mcap-ros2-support', 'zstandard'),
}


def run(*command: str) -> None:
    result = subprocess.run([sys.executable, '-m', *command], cwd=TOP, text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False)
    if result.returncode != 0:
        findings = [line for line in result.stdout.splitlines()
                    if line.strip() and not line.startswith(('checking ', '* '))]
        pytest.fail('\n'.join(findings), pytrace=False)


def test_ruff() -> None:
    run('ruff', 'check', '--no-cache', '--output-format', 'concise', *ROOTS)


# What it finds depends on the Python, and on the types that numpy has for it.
@pytest.mark.skipif(sys.version_info[:2] != (3, 12), reason='mypy runs with Python 3.12 only')
def test_mypy() -> None:
    run('mypy')


def test_ament_flake8() -> None:
    run('ament_flake8.main', *ROOTS)


def test_ament_pep257() -> None:
    run('ament_pep257.main', *ROOTS)


def test_copyright() -> None:
    assert SOURCES
    assert not [str(path.relative_to(TOP)) for path in SOURCES
                if not HEADER.match(path.read_text(encoding='utf-8'))]
    assert 'Apache License' in (TOP / 'LICENSE').read_text(encoding='utf-8')


def package() -> ElementTree.Element:
    return ElementTree.parse(TOP / 'package.xml').getroot()


def dependencies(*tags: str) -> list[str]:
    return [element.text or '' for element in package() if element.tag in tags]


def test_package_xml_has_format_3() -> None:
    root = package()
    assert (root.tag, root.attrib) == ('package', {'format': '3'})
    # REP 149, with the tags that this package has no use for left out.
    once = {'name', 'version', 'description', 'export'}
    many = {'maintainer', 'license', 'url', 'author', 'exec_depend', 'test_depend'}
    tags = [element.tag for element in root]
    assert set(tags) <= once | many
    assert once | {'maintainer', 'license'} <= set(tags)
    assert [tag for tag in once if tags.count(tag) != 1] == []
    assert root.findtext('export/build_type') == 'ament_python'
    assert root.findtext('license') == 'Apache-2.0'
    maintainer = root.find('maintainer')
    assert maintainer is not None and '@' in maintainer.get('email', '')
    for tag in ('exec_depend', 'test_depend'):
        names = dependencies(tag)
        assert names == sorted(set(names)), f'{tag}: sorted, each once'


def test_names_and_versions_agree() -> None:
    from mddag_executor import __version__
    root = package()
    assert re.fullmatch(r'\d+\.\d+\.\d+', __version__)
    assert root.findtext('version') == __version__
    name = root.findtext('name')
    assert name == 'mddag_executor'
    assert (TOP / 'resource' / name).is_file()


def run_nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield all nodes but those that only type checkers read."""
    yield node
    if isinstance(node, ast.If) and ast.unparse(node.test).endswith('TYPE_CHECKING'):
        children: list[ast.AST] = list(node.orelse)
    else:
        children = list(ast.iter_child_nodes(node))
    for child in children:
        yield from run_nodes(child)


def test_what_is_imported_is_declared() -> None:
    imported: dict[str, str] = {}
    for path in SOURCES:
        parts = path.relative_to(TOP).parts
        if parts[0] not in ('mddag_executor', 'msg_graph', 'launch') and (
                parts[:2] != ('examples', 'robot')):    # it is installed, too
            continue
        for node in run_nodes(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module or '']
            else:
                continue
            for name in names:
                imported.setdefault(name.split('.')[0], str(path.relative_to(TOP)))
    foreign = set(imported) - set(sys.stdlib_module_names) - {'mddag_executor', 'msg_graph'}
    assert {'numpy', 'yaml'} & foreign
    unknown = {name: imported[name] for name in foreign - set(THIRD_PARTY)}
    assert unknown == {}, 'add them to package.xml, setup.py and THIRD_PARTY'
    keys = dependencies('exec_depend')
    requirements = (TOP / 'setup.py').read_text(encoding='utf-8')
    for name in foreign:
        key, requirement = THIRD_PARTY[name]
        assert key is None or key in keys, (
            f'{name}, imported by {imported[name]}, is not in package.xml')
        assert requirement is None or f"'{requirement}>=" in requirements, (
            f'{name}, imported by {imported[name]}, is not in setup.py')


def test_what_is_an_extra_is_not_forced_on_a_robot() -> None:
    """An extra of setup.py is not a dependency in package.xml, which has no optional ones."""
    text = (TOP / 'setup.py').read_text(encoding='utf-8')
    needed = text[text.index('install_requires'):text.index('extras_require')]
    extras = {name for name, (_, requirement) in THIRD_PARTY.items()
              if requirement is not None and f"'{requirement}>=" not in needed}
    assert {'numba', 'matplotlib', 'rich', 'bokeh'} <= extras
    assert {f'python3-{name}' for name in extras}.isdisjoint(dependencies('exec_depend'))
    assert 'graphviz' not in dependencies('exec_depend')


def test_ruff_finds_a_mistake(tmp_path: Path) -> None:
    """The linters are really run, with this project's rules."""
    wrong = tmp_path / 'wrong.py'
    wrong.write_text('import sys\nimport os\nname = "double"\n', encoding='utf-8')
    with pytest.raises(pytest.fail.Exception, match=r'(?s)D100.*Q000|Q000.*D100'):
        run('ruff', 'check', '--no-cache', '--config', str(TOP / 'pyproject.toml'),
            '--output-format', 'concise', str(wrong))


def test_ament_flake8_finds_a_mistake(tmp_path: Path) -> None:
    """The plug-ins for quotes and for the order of imports are there."""
    wrong = tmp_path / 'wrong.py'
    wrong.write_text('import sys\nimport os\nname = "double"\n', encoding='utf-8')
    with pytest.raises(pytest.fail.Exception, match=r'(?s)I100.*Q000|Q000.*I100'):
        run('ament_flake8.main', str(wrong))
