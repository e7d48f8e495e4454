# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What is built and installed works without the checkout and without the optional packages."""

from configparser import ConfigParser
import json
from pathlib import Path
import subprocess
import sys
import tarfile
import zipfile

from mddag_executor import __version__
import pytest

from .conftest import run_program

TOP = Path(__file__).resolve().parent.parent
NAME = 'mddag_executor'
SHARE = f'share/{NAME}'
ROS = ('ament_index_python', 'builtin_interfaces', 'diagnostic_msgs', 'launch', 'launch_ros',
       'rcl_interfaces', 'rclpy', 'rosgraph_msgs', 'rosidl_parser', 'std_msgs')
OPTIONAL = ('distributed', 'isal', 'llvmlite', 'matplotlib', 'perfetto', 'pyarrow')
BLOCKER = """
from contextlib import redirect_stderr, redirect_stdout
from importlib.machinery import PathFinder
import io, json, sys
blocked, commands = map(json.loads, sys.argv[1:])
find = PathFinder.find_spec
PathFinder.find_spec = lambda name, *rest: None if name in blocked else find(name, *rest)
from mddag_executor.cli.main import main
done = []
for command in commands:
    with redirect_stdout(io.TextIOWrapper(io.BytesIO())), redirect_stderr(io.StringIO()) as errors:
        done.append((main(command), errors.getvalue()))
print(json.dumps(done))
"""
GRAPH = """
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: tick, timer: 10ms, publishes: [/a], execution_time: 1ms, dag: d}
      - {name: done, subscription: /a, deadline: 10ms, execution_time: 1ms}
"""
TRACE = str(TOP / 'bags' / 'demo_short.mcap')


def run_without(missing, commands, folder):
    """Run commands of `mddag` in a process that cannot import some packages."""
    (folder / 'graph.yaml').write_text(GRAPH)
    done = subprocess.run(
        [sys.executable, '-c', BLOCKER, json.dumps(missing),
         json.dumps([each.split() for each in commands])], cwd=folder,
        capture_output=True, text=True, timeout=120, stdin=subprocess.DEVNULL, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def test_works_without_anything_optional(tmp_path):
    commands = [
        'graph check graph.yaml', 'graph schema',
        'graph draw graph.yaml -o out.mmd',
        'simulate graph.yaml --duration 100ms --trace out.mcap',
        'evaluate graph.yaml --runs 2 --duration 50ms --policies rad',
        f'replay {TRACE} --report out.html', f'export {TRACE} -o out.csv', f'diff {TRACE} {TRACE}']
    done = run_without((*OPTIONAL, *ROS), commands, tmp_path)
    assert [(command, errors) for command, (status, errors) in zip(commands, done, strict=True)
            if status > 1 or errors] == []


@pytest.mark.parametrize(('missing', 'extra', 'commands'), [
    ('pyarrow', 'export', [f'export {TRACE} -o out.parquet']),
    ('matplotlib', 'batch', ['evaluate graph.yaml --runs 2 --plot out.png']),
    ('distributed', 'dask', ['evaluate graph.yaml --runs 2 --dask tcp://127.0.0.1:9']),
    ('rclpy', 'ros', ['run graph.yaml --synthetic sleep', 'top --once']),
], ids=lambda value: value if isinstance(value, str) else '')
def test_says_in_one_line_what_is_missing(tmp_path, missing, extra, commands):
    for status, errors in run_without((missing,), commands, tmp_path):
        assert (status, errors.count('\n')) == (2, 1) and errors.startswith('error: '), errors
        assert f'mddag_executor[{extra}]' in errors
        assert {'distributed': 'Dask'}.get(missing, missing) in errors
    assert [path.name for path in tmp_path.iterdir()] == ['graph.yaml']

HEAVY = {'ctypes', 'distributed', 'llvmlite', 'lz4', 'matplotlib', 'mcap',
         'numpy', 'perfetto', 'pyarrow', 'rclpy', 'rosbags', 'ruamel', 'yaml', 'zstandard'}


def loaded(code):
    """Return the modules that are there after some code."""
    _, modules = run_program(f'{code}\nimport sys\nsys.stderr.write(" ".join(sys.modules))')
    return set(modules.split())


def test_help_loads_nothing_heavy():
    modules = loaded("from contextlib import suppress\nfrom mddag_executor.cli.main import run\n"
                     "with suppress(SystemExit):\n    run(['--help'])\n")
    assert {name.split('.')[0] for name in modules} & HEAVY == set()
    assert {'json', 'asyncio', 'inspect', 'logging', 'subprocess', 'dataclasses', 'msg_graph'
            } & modules == set()


def test_a_replay_loads_what_it_uses():
    modules = loaded('from mddag_executor.cli.main import run\n'
                     f"run(['replay', '-q', {TRACE!r}])\n")
    assert {name.split('.')[0] for name in modules} & HEAVY == {
        'ctypes', 'mcap', 'numpy', 'yaml', 'zstandard'}
    assert {'asyncio', 'concurrent', 'difflib', 'http', 'jinja2', 'json', 'logging', 'sqlite3',
            'subprocess', 'tempfile', 'mcap.records', 'msg_graph.draft', 'numpy.ma'
            } & modules == set()
    parts = {name.split('.')[1] for name in modules if name.startswith('mddag_executor.')}
    assert {'executor', 'laboratory', 'rerun', 'results', 'simulate', 'whatif'} & parts == set()
    assert {'html', 'html_data', 'perfetto', 'picture'} & {
        name.split('.')[-1] for name in modules if name.startswith('mddag_executor.report.')
    } == set()


def test_a_short_simulation_loads_no_numpy():
    modules = loaded('from mddag_executor.cli.main import run\n'
                     f"run(['simulate', '-q', {str(TOP / 'config' / 'autoware.yaml')!r}])\n")
    assert {name.split('.')[0] for name in modules} & HEAVY == {'yaml'}


def test_the_executor_loads_little_besides_rclpy():
    rclpy = loaded('import rclpy, rclpy.node, rclpy.executors')
    more = loaded('from mddag_executor import MultiDeadlineExecutor') - rclpy
    foreign = {name.split('.')[0] for name in more}
    # It takes declarations, calls into rcl, and wraps the pools of ``multiprocessing`` (2 MB);
    # traces, plots and compilers come when asked for.
    assert foreign & (HEAVY | {'json', 'asyncio', 'http'}) <= {
        'ctypes', 'mcap', 'yaml'}
    assert {name for name in more if name.startswith('mcap')} == {'mcap', 'mcap.opcode'}
    assert {f'{NAME}.{part}' for part in (
        'cli', 'replay', 'report', 'simulate', 'trace.ctf', 'trace.reader')} & more == set()


@pytest.fixture(scope='module')
def built(tmp_path_factory):
    """Build a source distribution, and a wheel from its contents, as pip does."""
    place = tmp_path_factory.mktemp('built')
    files = subprocess.run(
        ['git', 'ls-files', '--cached', '--others', '--exclude-standard'], cwd=TOP,
        capture_output=True, text=True, check=False)
    if files.returncode != 0:
        pytest.skip('this is not a git checkout')
    for name in filter(lambda name: (TOP / name).is_file(), files.stdout.splitlines()):
        (place / 'checkout' / name).parent.mkdir(parents=True, exist_ok=True)
        (place / 'checkout' / name).write_bytes((TOP / name).read_bytes())
    build(place / 'checkout', 'sdist', place)
    with tarfile.open(next(place.glob('*.tar.gz'))) as archive:
        # Python 3.11.2 (Debian 12) has none, and no argument for it.
        archive.extraction_filter = getattr(tarfile, 'data_filter', None)
        archive.extractall(place / 'unpacked')
    unpacked, = (place / 'unpacked').iterdir()
    build(unpacked, 'wheel', place)
    return place


def build(source, kind, to):
    done = subprocess.run(
        [sys.executable, '-c',
         f'from setuptools import build_meta; build_meta.build_{kind}({str(to)!r})'],
        cwd=source, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]


def files_in(folder, *places):
    """Return the files below some places in a folder, without what was made from them."""
    return {path.relative_to(folder).as_posix() for place in places
            for path in (folder / place).rglob('*')
            if path.is_file() and path.suffix != '.pyc' and '.egg-info' not in path.parent.name}


@pytest.mark.slow
def test_the_distributions_hold_what_they_should(built):
    with tarfile.open(next(built.glob('*.tar.gz'))) as archive:
        names = {name.partition('/')[2] for name in archive.getnames()}
    # MANIFEST.in names what there is; something of a new kind has to be added there.
    assert files_in(built / 'checkout', '.') - names <= {'.gitignore', '.gitattributes'}
    assert [name for name in names if name.endswith('.pyc') or '/.venv' in name] == []
    with zipfile.ZipFile(next(built.glob('*.whl'))) as archive:
        names = set(archive.namelist())
        info = next(n.split('/')[0] for n in names if n.endswith('.dist-info/RECORD'))
        entries = ConfigParser()
        entries.read_string(archive.read(f'{info}/entry_points.txt').decode())
    assert info == f'{NAME}-{__version__}.dist-info'
    assert dict(entries['console_scripts']) == {'mddag': f'{NAME}.__main__:main'}
    data = f'{info.removesuffix(".dist-info")}.data/data/'
    assert {n for n in names if not n.startswith((info, data))} == files_in(
        built / 'checkout', NAME, 'msg_graph')
    assert {f'{data}{name}' for name in (
        f'share/ament_index/resource_index/packages/{NAME}', f'lib/{NAME}/mddag',
        f'{SHARE}/package.xml', f'{SHARE}/launch/run.launch.py', f'{SHARE}/config/autoware.yaml',
    )} <= names


@pytest.mark.slow
def test_what_is_installed_works_without_the_checkout(built, tmp_path):
    target = tmp_path / 'installed'
    done = subprocess.run(
        [sys.executable, '-m', 'pip', 'install', '--quiet', '--no-deps', '--no-index',
         '--no-compile', '--disable-pip-version-check', '--target', str(target),
         str(next(built.glob('*.whl')))],
        capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    config, bag = (str(target / SHARE / name) for name in (
        'config/autoware.yaml', 'bags/demo_short.mcap'))
    # -I and no editable finder: only what was installed, and what it depends on.
    code = f"""if True:
        import sys
        sys.path.insert(0, {str(target)!r})
        sys.meta_path[:] = [
            f for f in sys.meta_path
            if 'editable' not in type(f).__module__ + getattr(f, '__name__', '').lower()]
        import {NAME}, msg_graph
        assert all(each.__file__.startswith({str(target)!r}) for each in ({NAME}, msg_graph))
        from mddag_executor.cli.main import main
        from mddag_executor.resources import find
        for command in (['graph', 'check', {config!r}],
                        ['replay', {bag!r}, '--report', 'out.html'],
                        ['simulate', {config!r}, '--duration', '50ms', '--json', 'out.json']):
            assert main(command) == 0, command
        print(find('config/autoware.yaml'))
    """
    done = subprocess.run([sys.executable, '-I', '-c', code], cwd=tmp_path, capture_output=True,
                          text=True, timeout=120, stdin=subprocess.DEVNULL, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == config
    assert json.loads((tmp_path / 'out.json').read_text())['dags']
    css = (TOP / NAME / 'report' / 'html.css').read_text(encoding='utf-8')
    assert css[:40] in (tmp_path / 'out.html').read_text(encoding='utf-8')
