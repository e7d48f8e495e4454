# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
What all tests share: a ROS domain of their own, an order, and guards against leftovers.

Every session (and every worker of pytest-xdist) claims a ROS domain that no other session on this
machine has, and discovery stays on this machine, so tests neither hear a robot nor disturb one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import fcntl
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from typing import Any

import hypothesis
import pytest

HERE = Path(__file__).resolve().parent

# Fast and basic ones first, so that a mistake shows early; whatever starts ROS comes last.
ORDER = ('msg_graph', 'core', 'trace', 'simulate', 'analysis', 'replay', 'report', 'cli', 'launch',
         '', 'live', 'integration', 'bench')
# Domains above 101 collide with the ephemeral ports of Linux; low ones are what people use.
DOMAINS = range(40, 102)

_session = contextlib.ExitStack()


def pytest_configure(config: pytest.Config) -> None:
    os.environ['ROS_DOMAIN_ID'] = str(_claim_domain())
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ.pop('ROS_STATIC_PEERS', None)
    os.environ['ROS_LOG_DIR'] = _session.enter_context(
        tempfile.TemporaryDirectory(prefix='mddag-test-log-', ignore_cleanup_errors=True))
    hypothesis.settings.register_profile(
        'mddag', deadline=None, print_blob=True,
        # The same examples on every run of continuous integration; new ones at home.
        derandomize=bool(os.environ.get('CI')))
    hypothesis.settings.load_profile('mddag')


def pytest_unconfigure(config: pytest.Config) -> None:
    _session.close()


def _claim_domain() -> int:
    """Return a domain that is locked for as long as this session lasts."""
    start = os.getpid() % len(DOMAINS)
    for domain in (*DOMAINS[start:], *DOMAINS[:start]):
        path = Path(tempfile.gettempdir(), f'mddag-test-domain-{domain}.{os.getuid()}.lock')
        lock = path.open('w')
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            continue
        _session.enter_context(lock)
        return domain
    raise pytest.UsageError('every ROS domain for tests is in use by another test session')


# What runs ROS, or looks at how time passes. Side by side (`make test`) they are one group, which
# one process runs one after the other while the other process runs the rest.
ALONE = ('live', 'integration', 'bench', 'launch', 'examples', 'hardening')
ALONE_FILES = (
    'cli/test_run.py', 'cli/test_demo.py', 'cli/test_top.py', 'cli/test_bench_replay.py',
    'cli/test_graph_systems.py', 'replay/test_live_replay.py', 'test_docs.py', 'test_readme.py')


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=_rank)
    if 'PYTEST_XDIST_WORKER' in os.environ:
        for item in items:
            if _is_alone(item):
                item.add_marker(pytest.mark.xdist_group('alone'))
        items.sort(key=lambda item: not _is_alone(item))  # the longest group first


def _is_alone(item: pytest.Item) -> bool:
    try:
        path = item.path.relative_to(HERE)
    except ValueError:
        return False
    return path.parts[0] in ALONE or path.as_posix() in ALONE_FILES


def _rank(item: pytest.Item) -> tuple[bool, int]:
    try:
        parts = item.path.relative_to(HERE).parts
    except ValueError:
        parts = ()
    folder = parts[0] if len(parts) > 1 else ''
    place = ORDER.index(folder) if folder in ORDER else ORDER.index('live')
    return item.get_closest_marker('slow') is not None, place


@pytest.fixture
def no_thread_leak() -> Iterator[None]:
    """Fail a test that leaves a Python thread running for more than two seconds."""
    before = set(threading.enumerate())
    yield
    end = time.monotonic() + 2.0
    while time.monotonic() < end:
        left = [thread for thread in threading.enumerate() if thread not in before]
        if not left:
            return
        time.sleep(0.01)
    frames = sys._current_frames()
    where = [f'{thread!r}\n' + ''.join(traceback.format_stack(frames[thread.ident]))
             for thread in left if thread.ident in frames]
    pytest.fail('threads left behind:\n' + '\n'.join(where), pytrace=False)


@pytest.fixture
def ros_context(no_thread_leak: None) -> Iterator[Any]:
    """Give an rclpy context of its own, shut down afterwards; no thread may be left then."""
    import rclpy
    from rclpy.context import Context
    context = Context()
    rclpy.init(context=context)
    yield context
    context.try_shutdown()


@pytest.fixture
def mddag() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Give a function that runs `mddag` with arguments in a process of its own."""
    def call(*arguments: str | Path, timeout: float = 60.0,
             **options: Any) -> subprocess.CompletedProcess[str]:
        if 'input' not in options:
            options.setdefault('stdin', subprocess.DEVNULL)
        return subprocess.run(
            [sys.executable, '-m', 'mddag_executor', *map(str, arguments)],
            capture_output=True, text=True, timeout=timeout, check=False, **options)
    return call
