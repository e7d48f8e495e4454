# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Shipped files are found in a checkout and in every kind of installation."""

from __future__ import annotations

from pathlib import Path
import subprocess
import sys

from mddag_executor import resources
from mddag_executor.errors import InputError
import pytest

TOP = Path(__file__).resolve().parent.parent


def test_a_checkout_has_its_own_files() -> None:
    assert resources.find('package.xml') == TOP / 'package.xml'
    assert resources.find('config/autoware.yaml') == TOP / 'config' / 'autoware.yaml'


def test_what_is_nowhere_is_one_line() -> None:
    with pytest.raises(InputError, match=r'^config/none\.yaml: not found among .*: install'):
        resources.find('config/none.yaml')


def install(prefix: Path, folder: str) -> Path:
    """Lay the package out as an installer does; return where the modules are."""
    modules = prefix / folder
    for name in ('__init__.py', 'errors.py', 'lazy.py', 'resources.py'):
        target = modules / 'mddag_executor' / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes((TOP / 'mddag_executor' / name).read_bytes())
    share(prefix)
    return modules


def share(prefix: Path) -> None:
    file = prefix / 'share' / 'mddag_executor' / 'config' / 'probe.yaml'
    file.parent.mkdir(parents=True)
    file.write_text('mddag: 1\n')
    marker = prefix / 'share' / 'ament_index' / 'resource_index' / 'packages' / 'mddag_executor'
    marker.parent.mkdir(parents=True)
    marker.touch()


def found(modules: Path, **environment: str) -> str:
    code = (f'import sys; sys.path.insert(0, {str(modules)!r})\n'
            'from mddag_executor.resources import find\n'
            "print(find('config/probe.yaml'))\n")
    return subprocess.run([sys.executable, '-c', code], check=True, capture_output=True,
                          text=True, env=environment).stdout.strip()


@pytest.mark.parametrize('folder', [
    'lib/python3.12/site-packages', 'local/lib/python3.12/dist-packages'])
def test_an_installation_has_its_own_files(tmp_path: Path, folder: str) -> None:
    mine, other = tmp_path / 'mine', tmp_path / 'other'
    modules = install(mine, folder)
    share(other)
    # Another workspace that is sourced as well must not win.
    assert found(modules, AMENT_PREFIX_PATH=str(other)) == str(
        mine / 'share' / 'mddag_executor' / 'config' / 'probe.yaml')


def test_the_ament_index_is_searched(tmp_path: Path) -> None:
    other = tmp_path / 'workspace'
    modules = install(tmp_path / 'mine', 'modules')
    share(other)
    empty = tmp_path / 'empty'
    assert found(modules, AMENT_PREFIX_PATH=f'{empty}::{other}') == str(
        other / 'share' / 'mddag_executor' / 'config' / 'probe.yaml')
