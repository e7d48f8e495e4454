# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What all tests share: a ROS domain of their own, an order, and guards against leftovers.

Every session (and every worker of pytest-xdist) claims a ROS domain that no other session on this
machine has, and discovery stays on this machine, so tests neither hear a robot nor disturb one.
Each also has a folder for temporary files, which has to be empty at its end. This folder is in the
environment of the test's processes, so that they can be found: none of them may still be running.
If a session is killed, its guard ends these processes and removes the folder (see ``leftovers``).

A test marked `needs('graphviz')` is skipped where `.ci/tools` misses that program, and the last
line says so. With CI in the environment nothing may be missing: such a test fails, and so does a
test that is skipped for any reason that is not in `ALLOWED_SKIPS`.
"""

from collections import Counter
import contextlib
from functools import cache
import importlib
import io
import json
import os
from pathlib import Path, PurePosixPath
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from types import ModuleType
from typing import NamedTuple

import hypothesis
import pytest

HERE = Path(__file__).resolve().parent

CI = bool(os.environ.get('CI'))
NEEDS = 'needs '
BYTECODE = 'bytecode'

# Reasons for which continuous integration may skip a test, and why it may.
ALLOWED_SKIPS = {
    'ros2 is not installed here': 'the package index has no ros2cli; the job in ros:jazzy runs it',
    'the sample recording is not here': "CARET's sample may not be part of this project",
    'the recording is not there': "CARET's sample may not be part of this project",
    'this Python has no sys.monitoring': 'callbacks pause from Python 3.12 on',
    'asyncio.timeout is new in Python 3.11': 'Python 3.10 is tested without it',
    'this rclpy has no TimerInfo': 'rclpy 7.1.5, which the package index has, lacks it',
    # The ROS package has no linters among its dependencies.
    'mypy is not installed': 'make lint runs it', 'ruff is not installed': 'make lint runs it',
    'mypy runs with Python 3.12 only': 'its findings depend on the Python',
    'root may write everywhere': 'containers run as root; other machines test it',
    'this kernel does not show what threads do': 'gVisor lacks it; other machines test it',
    'this kernel does not show how long threads wait': 'the same',
    'Graphviz is in the folder of Python': 'it cannot be hidden from the test there',
    'only a checkout has benchmarks': 'colcon tests the installed package',
}

_session = contextlib.ExitStack()

if __name__ == 'test.conftest':
    # Before its version 8, pytest takes the standard library's `test` for the package that these
    # are in, and a relative import finds no neighbour there.
    _package = sys.modules.setdefault('test', ModuleType('test'))
    _paths = [*getattr(_package, '__path__', ())]
    if str(HERE) not in _paths:
        _package.__path__ = [str(HERE), *_paths]


def pytest_configure(config):
    # A shell's job in the background ignores Ctrl-C, and so would all programs that tests start.
    if (signal.getsignal(signal.SIGINT) is signal.SIG_IGN
            and threading.current_thread() is threading.main_thread()):
        signal.signal(signal.SIGINT, signal.default_int_handler)
    # What pytest itself keeps stays where it is.
    os.environ.setdefault('PYTEST_DEBUG_TEMPROOT', tempfile.gettempdir())
    # programs that tests start inherit it
    os.environ.setdefault('MDDAG_DEBUG', str(HERE / 'invariants.py'))
    # not at the top: the package has no path there, before pytest's version 8
    from .leftovers import guarded
    folder = tempfile.TemporaryDirectory(prefix='mddag-test-', ignore_cleanup_errors=True)
    _session.enter_context(guarded(folder.name))
    tempfile.tempdir = _session.enter_context(folder)
    keep_bytecode(os.environ, Path(tempfile.tempdir, BYTECODE))
    os.environ.pop('ROS_STATIC_PEERS', None)
    os.environ.update(
        ROS_DOMAIN_ID=str(_claim_domain()), ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST',
        TMPDIR=tempfile.tempdir, ROS_LOG_DIR=str(Path(tempfile.tempdir, 'log')))
    hypothesis.settings.register_profile(
        'mddag', deadline=None, print_blob=True,
        # The same examples on every run of continuous integration; new ones at home.
        derandomize=CI)
    hypothesis.settings.load_profile('mddag')
    if getattr(config.option, 'maxworkerrestart', '') is None:
        config.option.maxworkerrestart = '0'  # a new worker would wait for ever for its tests
    if CI:  # what is not there is an error
        pytest.importorskip = lambda name, *_, **__: importlib.import_module(name)


def pytest_unconfigure(config):
    _session.close()
    reporter = config.pluginmanager.get_plugin('terminalreporter')
    if reporter is None:
        return
    reasons = Counter(report.longrepr[2] for report in reporter.stats.get('skipped', ()))
    counts = {tool: count for tool in missing_tools()
              if (count := reasons[f'Skipped: {NEEDS}{tool}'])}
    if counts:
        tools = ', '.join(f'what {tool} is needed for ({count} tests)'
                          for tool, count in counts.items())
        packages = ' '.join(missing_tools()[tool] for tool in counts)
        reporter.write_line(f'not tested: {tools}: sudo apt install {packages}')


def keep_bytecode(environment, folder):
    """
    Let the programs that tests start share bytecode even if the user wants none to be written.

    There are hundreds of them, and each would compile the same modules.  The bytecode is kept in a
    folder of the session then, not next to the sources.
    """
    if environment.pop('PYTHONDONTWRITEBYTECODE', None):
        environment.setdefault('PYTHONPYCACHEPREFIX', str(folder))


def _claim_domain():
    """Return a domain that no other session has for as long as this one lasts."""
    from .ros_domains import claim_domain
    domain, claim = claim_domain()
    if domain is None:
        raise pytest.UsageError('every ROS domain for tests is in use by another test session')
    _session.enter_context(claim)
    return domain


@cache
def missing_tools():
    """Return the programs that tests lack, and Debian's packages with them."""
    done = subprocess.run(['sh', str(HERE.parent / '.ci' / 'tools'), 'missing'],
                          capture_output=True, text=True, check=True)
    return dict(line.split(' ', 1) for line in sorted(done.stdout.splitlines()))


def pytest_runtest_setup(item):
    for mark in item.iter_markers('needs'):
        tool, = mark.args
        if tool in missing_tools():
            say = pytest.fail if CI else pytest.skip
            say(f'{NEEDS}{tool}')


def is_allowed_skip(reason):
    """
    Return whether continuous integration may skip a test for a reason.

    MDDAG_NO_SKIP in the environment is (the beginning of) a reason that it may not, either.
    """
    reason = reason.removeprefix('Skipped: ')
    forbidden = os.environ.get('MDDAG_NO_SKIP')
    return reason in ALLOWED_SKIPS and not (forbidden and reason.startswith(forbidden))


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    outcome = yield
    report = outcome.get_result()
    if CI and report.skipped and isinstance(report.longrepr, tuple) and not hasattr(
            report, 'wasxfail') and not is_allowed_skip(report.longrepr[2]):
        report.outcome = 'failed'
        report.longrepr = f'{report.longrepr[2]}: this reason is not in ALLOWED_SKIPS'


# What runs ROS, or waits as time passes. Side by side (`make test`) a process takes whole files of
# these, which come first: most of their time they wait, so that both take what is left then.
ROS = (
    'executor', 'hosting', 'synthetic', 'benchmarks', 'launch', 'examples',
    'hardening/test_misuse.py',
    'cli/test_run.py', 'cli/test_demo.py', 'cli/test_top.py', 'cli/test_graph.py',
    'test_docs.py')


def pytest_collection_modifyitems(items):
    if 'PYTEST_XDIST_WORKER' in os.environ:
        # The longest first, so that no process has to wait for the other at the end.
        items.sort(key=lambda item: (
            not _is_in(item.nodeid, ROS), item.get_closest_marker('slow') is None))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    from xdist.scheduler import LoadScopeScheduling

    class Scheduling(LoadScopeScheduling):

        def _split_scope(self, nodeid):
            return nodeid.partition('::')[0] if _is_in(nodeid, ROS) else nodeid

    config.option.loadscopereorder = False  # they are in order
    return Scheduling(config, log)


def _is_in(nodeid, places):
    file = PurePosixPath(nodeid.partition('::')[0])
    return any(file.is_relative_to(PurePosixPath(HERE.name, each)) for each in places)


@pytest.fixture(scope='session', autouse=True)
def nothing_left_behind():
    """Fail a session that leaves temporary files behind, or processes for more than a while."""
    yield
    from .leftovers import kill, processes_of
    folder = Path(tempfile.gettempdir())
    end = time.monotonic() + 10.0
    while processes := processes_of(folder):
        if time.monotonic() > end:
            kill(processes)
            break
        time.sleep(0.05)
    files = [str(path) for path in folder.rglob('*')
             if (top := path.relative_to(folder).parts[0]) not in ('log', BYTECODE)
             and not top.startswith('.org.chromium.')]
    assert (processes, files) == ({}, []), 'the tests left these processes and files behind'


@pytest.fixture
def no_thread_leak():
    """Fail a test that leaves a Python thread running for more than some seconds."""
    before = set(threading.enumerate())
    yield
    end = time.monotonic() + 10.0
    while left := [thread for thread in threading.enumerate() if thread not in before]:
        if time.monotonic() > end:
            frames = sys._current_frames()
            where = [f'{thread!r}\n' + ''.join(traceback.format_stack(frames[thread.ident]))
                     for thread in left if thread.ident in frames]
            pytest.fail('threads still run:\n' + '\n'.join(where), pytrace=False)
        time.sleep(0.01)


@pytest.fixture
def ros_context(no_thread_leak):
    """Give an rclpy context of its own, shut down afterwards; no thread may be left then."""
    import rclpy
    from rclpy.context import Context
    context = Context()
    rclpy.init(context=context)
    yield context
    context.try_shutdown()


def examples(count):
    """Return settings for that many examples; MDDAG_THOROUGH=20 in the environment: 20 fold."""
    check = hypothesis.HealthCheck
    return hypothesis.settings(
        max_examples=count * int(os.environ.get('MDDAG_THOROUGH', '1')), suppress_health_check=[
            check.too_slow, check.data_too_large, check.function_scoped_fixture])


def run_program(program, *arguments, send=None):
    """
    Run a program in a process of its own; return its output and errors.

    :param send: the signal that it gets when it has printed ``ready``.
    """
    process = subprocess.Popen(
        [sys.executable, '-c', program, *map(str, arguments)], stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True)
    try:
        if send is not None:
            assert process.stdout.readline() == 'ready\n', process.communicate()[1]
            process.send_signal(send)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0, err
    return out, err


def wait_for_run(process, condition):
    """Wait until something is true of a process that goes on."""
    end = time.monotonic() + 60
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.01)


class Done(NamedTuple):
    returncode: int
    stdout: str
    stderr: str

    @property
    def result(self):
        """What the command printed as JSON; its status must be 0."""
        assert self.returncode == 0, self.stderr
        return json.loads(self.stdout)


def check_json(arguments, done, folder=None):
    """Check the result that a command has written, if it has: no key missing or unknown."""
    words = [*map(str, arguments)]
    if '--json' in words[:-1] and done.returncode in (0, 1):
        path = Path(folder or '', words[words.index('--json') + 1])
        text = done.stdout if path.name == '-' else path.read_text() if path.is_file() else ''
        if text:
            from .json_results import check_result  # needs a package of the tests
            check_result(' '.join(words[:2 if words[0] == 'graph' else 1]), json.loads(text))


@pytest.fixture
def graph(tmp_path, request):
    """Give the declaration `GRAPH` of the test's module as a file, graph.yaml."""
    path = tmp_path / 'graph.yaml'
    path.write_text(request.module.GRAPH)
    return path


@pytest.fixture
def call(capsys, monkeypatch):
    """Give a function that runs `mddag` with arguments in this process, which is quicker."""
    def run(*arguments, cwd=None, stdin=b''):
        from mddag_executor.cli.main import main
        capsys.readouterr()
        with monkeypatch.context() as patch:
            if cwd is not None:
                patch.chdir(cwd)
            given = stdin if isinstance(stdin, bytes) else stdin.encode()
            patch.setattr('sys.stdin', io.TextIOWrapper(io.BytesIO(given), encoding='utf-8'))
            status = main([*map(str, arguments)])
            done = Done(status, *capsys.readouterr())
            check_json(arguments, done)
        return done
    return run


@pytest.fixture
def mddag():
    """Give a function that runs `mddag` with arguments in a process of its own."""
    def call(*arguments, timeout=60.0, **options):
        given = options.pop('input', None)
        options.setdefault('stdin', subprocess.DEVNULL if given is None else subprocess.PIPE)
        environment = {**(options.pop('env', None) or os.environ), 'PYTHONFAULTHANDLER': '1'}
        command = [sys.executable, '-m', 'mddag_executor', *map(str, arguments)]
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
            **options,
        ) as process:
            try:
                out, err = process.communicate(given, timeout)
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGABRT)  # writes the stack of each thread
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.communicate(timeout=10)
                process.kill()
                out, err = process.communicate()
                pytest.fail(f'{command} has not ended within {timeout:g} s\n{out}\n{err}')
            except BaseException:
                process.kill()
                raise
        done = Done(process.returncode, out, err)
        check_json(arguments, done, options.get('cwd'))
        return done
    return call
