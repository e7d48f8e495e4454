# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What is built and installed works without the checkout, without the optional packages, and fast.

`blocked` runs `mddag` in a process in which some packages cannot be imported, as if they were not
installed.
"""

from __future__ import annotations

from collections.abc import Callable
from configparser import ConfigParser
import json
from pathlib import Path
import subprocess
import sys
import tarfile
import zipfile

import pytest

TOP = Path(__file__).resolve().parent.parent
NAME = 'mddag_executor'
SHARE = f'share/{NAME}'
OPTIONAL = ('bokeh', 'distributed', 'llvmlite', 'matplotlib', 'numba', 'perfetto', 'pyarrow',
            'rich')
ROS = ('ament_index_python', 'builtin_interfaces', 'diagnostic_msgs', 'launch', 'launch_ros',
       'rcl_interfaces', 'rclpy', 'rosgraph_msgs', 'rosidl_parser', 'std_msgs')
BLOCKER = """
import sys


class WithoutBlocked:

    def __init__(self, finder):
        self.finder = finder

    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in blocked:
            return None
        return self.finder.find_spec(name, path, target)

    def __getattr__(self, name):
        return getattr(self.finder, name)


blocked = set(sys.argv.pop(1).split(','))
sys.meta_path[:] = [WithoutBlocked(finder) for finder in sys.meta_path]
if blocked == {'rich'}:
    sys.stdout.isatty = lambda: True  # elsewhere it is not wanted
from mddag_executor.cli.main import main
sys.exit(main())
"""
GRAPH = """
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: tick, timer: 10ms, publishes: [/a], execution_time: 1ms, dag: d}
      - {name: done, subscription: /a, deadline: 10ms, execution_time: 1ms}
"""
Blocked = Callable[..., 'subprocess.CompletedProcess[str]']


@pytest.fixture
def blocked(tmp_path: Path) -> Blocked:
    (tmp_path / 'graph.yaml').write_text(GRAPH)

    def run(missing: tuple[str, ...], *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, '-c', BLOCKER, ','.join(missing), *arguments], cwd=tmp_path,
            capture_output=True, text=True, timeout=60, stdin=subprocess.DEVNULL, check=False)
    return run


# --- optional packages ---------------------------------------------------------------------------

TRACE = str(TOP / 'bags' / 'demo_short.mcap')


@pytest.mark.parametrize('arguments', [
    ('graph', 'check', 'graph.yaml'),
    ('graph', 'analyse', 'graph.yaml'),
    ('graph', 'fmt', 'graph.yaml'),
    ('graph', 'schema'),
    ('graph', 'draw', 'graph.yaml', '-o', 'out.mmd'),
    ('simulate', 'graph.yaml', '--duration', '100ms'),
    ('simulate', 'graph.yaml', '--duration', '100ms', '--trace', 'out.mcap'),
    ('evaluate', 'graph.yaml', '--runs', '2', '--duration', '50ms', '--policies', 'rad'),
    ('replay', TRACE),
    ('export', TRACE, '-o', 'out.csv'),
    ('diff', TRACE, TRACE),
], ids=lambda arguments: ' '.join(arguments[:2]).replace(TRACE, 'TRACE'))
def test_works_without_anything_optional(blocked: Blocked, arguments: tuple[str, ...]) -> None:
    done = blocked((*OPTIONAL, *ROS), *arguments)
    assert (done.returncode, done.stderr) in ((0, ''), (1, '')), done.stderr


@pytest.mark.parametrize(('missing', 'says', 'arguments'), [
    ('bokeh', 'mddag_executor[report]',
     ('simulate', 'graph.yaml', '--report', 'out.html')),
    ('bokeh', 'mddag_executor[report]', ('replay', TRACE, '--report', 'out.html')),
    ('rich', 'mddag_executor[top]', ('top',)),
    ('pyarrow', 'mddag_executor[export]', ('export', TRACE, '-o', 'out.parquet')),
    ('matplotlib', 'mddag_executor[batch]',
     ('evaluate', 'graph.yaml', '--runs', '2', '--plot', 'out.png')),
    ('numba', 'mddag_executor[batch]',
     ('evaluate', 'graph.yaml', '--runs', '2', '--core', 'compiled')),
    ('distributed', 'mddag_executor[dask]',
     ('evaluate', 'graph.yaml', '--runs', '2', '--dask', 'tcp://127.0.0.1:9')),
    ('rclpy', 'mddag_executor[ros]', ('run', 'graph.yaml', '--synthetic', 'sleep')),
    ('rclpy', 'mddag_executor[ros]', ('top', '--once')),
    ('rclpy', 'mddag_executor[ros]', ('graph', 'from-ros', '-o', 'out.yaml')),
], ids=lambda value: value if isinstance(value, str) else ' '.join(value[:1]))
def test_says_in_one_line_what_is_missing(
    blocked: Blocked, tmp_path: Path, missing: str, says: str, arguments: tuple[str, ...]
) -> None:
    done = blocked((missing,), *arguments)
    assert done.returncode == 2, done.stdout + done.stderr
    assert done.stderr.startswith('error: ') and done.stderr.count('\n') == 1, done.stderr
    assert says in done.stderr
    assert {'distributed': 'Dask', 'bokeh': 'Bokeh'}.get(missing, missing) in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ['graph.yaml']


# --- start-up ------------------------------------------------------------------------------------

HEAVY = {'bokeh', 'ctypes', 'distributed', 'llvmlite', 'lz4', 'matplotlib', 'mcap', 'numba',
         'numpy', 'perfetto', 'pyarrow', 'rclpy', 'rich', 'rosbags', 'ruamel', 'yaml',
         'zstandard'}


def loaded(code: str) -> set[str]:
    """Return the modules that are there after some code."""
    done = subprocess.run(
        [sys.executable, '-c',
         f'{code}\nimport sys\nsys.stderr.write(" ".join(sys.modules))'],
        capture_output=True, text=True, check=True)
    return set(done.stderr.split())


def test_help_loads_nothing_heavy() -> None:
    modules = loaded(
        'from contextlib import suppress\n'
        'from mddag_executor.cli.main import run\n'
        'with suppress(SystemExit):\n'
        "    run(['--help'])\n")
    assert {name.split('.')[0] for name in modules} & HEAVY == set()
    assert {'json', 'asyncio', 'inspect', 'logging', 'subprocess', 'dataclasses', 'msg_graph'
            } & modules == set()
    # What it does load of this project: the verbs, the texts, and what defers the rest.
    ours = {name for name in modules if name.startswith(NAME)}
    assert len(ours) <= 12, sorted(ours)


def test_the_executor_loads_little_besides_rclpy() -> None:
    rclpy = loaded('import rclpy, rclpy.node, rclpy.executors')
    more = loaded('from mddag_executor import MultiDeadlineExecutor') - rclpy
    foreign = {name.split('.')[0] for name in more}
    # It takes declarations, and calls into rcl; traces, plots and compilers come when asked for.
    assert foreign & (HEAVY | {'json', 'asyncio', 'multiprocessing', 'http'}) <= {
        'ctypes', 'mcap', 'yaml'}
    assert {name for name in more if name.startswith('mcap')} == {'mcap', 'mcap.opcode'}
    parts = {name.split('.')[1] for name in more if name.startswith(f'{NAME}.')}
    assert parts == {
        'clocks', 'core', 'defaults', 'errors', 'executor', 'lazy', 'text', 'trace'}
    assert {f'{NAME}.trace.writer', f'{NAME}.trace.reader', f'{NAME}.trace.ctf'} & more == set()


# --- built and installed -------------------------------------------------------------------------

def shipped() -> list[str]:
    """Return what the packages consist of, in the checkout."""
    return sorted(
        path.relative_to(TOP).as_posix()
        for package in (NAME, 'msg_graph') for path in (TOP / package).rglob('*')
        if path.is_file() and path.suffix != '.pyc')


@pytest.fixture(scope='module')
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a source distribution, and from what is in it a wheel, as pip does."""
    place = tmp_path_factory.mktemp('built')
    source = place / 'checkout'
    source.mkdir()
    files = subprocess.run(
        ['git', 'ls-files', '--cached', '--others', '--exclude-standard'], cwd=TOP,
        capture_output=True, text=True, check=False)
    if files.returncode != 0:
        pytest.skip('this is no git checkout')
    for name in files.stdout.splitlines():
        if (TOP / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((TOP / name).read_bytes())
    build(source, 'sdist', place)
    with tarfile.open(next(place.glob('*.tar.gz'))) as archive:
        # Python 3.11.2 (Debian 12) has none, and no argument for it.
        archive.extraction_filter = getattr(tarfile, 'data_filter', None)
        archive.extractall(place / 'unpacked')
    unpacked, = (place / 'unpacked').iterdir()
    build(unpacked, 'wheel', place)
    return place


def build(source: Path, kind: str, to: Path) -> None:
    code = f'from setuptools import build_meta; build_meta.build_{kind}({str(to)!r})'
    done = subprocess.run([sys.executable, '-c', code], cwd=source, capture_output=True,
                          text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]


@pytest.mark.slow
def test_the_source_distribution_holds_the_clone(built: Path) -> None:
    with tarfile.open(next(built.glob('*.tar.gz'))) as archive:
        names = {name.partition('/')[2] for name in archive.getnames()}
    assert set(shipped()) <= names
    for name in ('LICENSE', 'Makefile', 'README.md', 'package.xml', 'setup.py', '.ci/environment',
                 'config/from_workload.py', 'docs/declare.md', 'examples/README.md',
                 'examples/sensor_fusion/run.sh', 'test/conftest.py',
                 'test/hosting/guests/chat.py'):
        assert name in names, name
    # MANIFEST.in names what there is; something of a new kind has to be added there.
    checkout = built / 'checkout'
    clone = {path.relative_to(checkout).as_posix() for path in checkout.rglob('*')
             if path.is_file() and '.egg-info' not in path.parent.name}
    assert clone - names <= {'.gitignore', '.gitattributes'}
    assert [name for name in names if name.endswith('.pyc') or '/.venv' in name] == []


@pytest.mark.slow
def test_the_wheel_holds_what_runs_and_nothing_else(built: Path) -> None:
    with zipfile.ZipFile(next(built.glob('*.whl'))) as archive:
        names = set(archive.namelist())
        info = next(n.split('/')[0] for n in names if n.endswith('.dist-info/RECORD'))
        entries = ConfigParser()
        entries.read_string(archive.read(f'{info}/entry_points.txt').decode())
    assert dict(entries['console_scripts']) == {'mddag': f'{NAME}.cli.main:main'}
    data = f'{info.removesuffix(".dist-info")}.data/data/'
    code = {n for n in names if not n.startswith((info, data))}
    assert code == set(shipped())
    share = {n.removeprefix(data) for n in names if n.startswith(data)}
    expected = {f'{SHARE}/{path.relative_to(TOP).as_posix()}'
                for folder, pattern in (('launch', '*.launch.py'), ('config', '*.yaml'),
                                        ('bags', '*.mcap'), ('bags', '*.md'),
                                        ('examples/robot', '*.yaml'), ('examples/robot', '*.py'))
                for path in (TOP / folder).glob(pattern)}
    expected |= {f'{SHARE}/package.xml', f'share/ament_index/resource_index/packages/{NAME}',
                 f'lib/{NAME}/mddag'}
    assert len(expected) > 5
    assert share == expected


@pytest.mark.slow
def test_what_is_installed_works_without_the_checkout(built: Path, tmp_path: Path) -> None:
    target = tmp_path / 'installed'
    done = subprocess.run(
        [sys.executable, '-m', 'pip', 'install', '--quiet', '--no-deps', '--no-index',
         '--disable-pip-version-check', '--target', str(target), str(next(built.glob('*.whl')))],
        capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    config, bag = (target / SHARE / name for name in ('config/autoware.yaml',
                                                      'bags/demo_short.mcap'))

    def mddag(*arguments: str | Path) -> str:
        # -I and no editable finder: only what was installed, and what it depends on.
        code = (f'import sys; sys.path.insert(0, {str(target)!r})\n'
                'sys.meta_path[:] = [f for f in sys.meta_path'
                " if 'editable' not in type(f).__module__ + getattr(f, '__name__', '').lower()]\n"
                f'import {NAME}, msg_graph\n'
                f'assert {NAME}.__file__.startswith({str(target)!r}), {NAME}.__file__\n'
                f'assert msg_graph.__file__.startswith({str(target)!r})\n'
                'from mddag_executor.cli.main import main; sys.exit(main())')
        done = subprocess.run(
            [sys.executable, '-I', '-c', code, *map(str, arguments)], cwd=tmp_path,
            capture_output=True, text=True, timeout=60, stdin=subprocess.DEVNULL, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert 'perception' in mddag('graph', 'check', config)
    assert 'planning' in mddag('replay', bag)
    assert json.loads(mddag('simulate', config, '--duration', '50ms', '--json', '-'))['dags']
    mddag('replay', bag, '--report', 'out.html')
    report = (tmp_path / 'out.html').read_text(encoding='utf-8')
    assert (TOP / NAME / 'report' / 'html.css').read_text(encoding='utf-8')[:40] in report
    code = f'import sys; sys.path.insert(0, {str(target)!r})\nimport {NAME}.resources as r\n' \
           "print(next(p for p in r.roots() if (p / 'config/autoware.yaml').is_file()))"
    found = subprocess.run([sys.executable, '-I', '-c', code], cwd=tmp_path, text=True,
                           capture_output=True, check=True)
    assert found.stdout.strip() == str(target / SHARE)
