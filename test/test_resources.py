# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Shipped files are found in a checkout and in every kind of installation."""

from pathlib import Path
import subprocess
import sys

from mddag_executor import resources
from mddag_executor.errors import InputError
import pytest

TOP = Path(__file__).resolve().parent.parent


def test_a_checkout_has_its_own_files():
    assert resources.find('package.xml') == TOP / 'package.xml'
    with pytest.raises(InputError, match=r'^config/none\.yaml: not found among .*: install'):
        resources.find('config/none.yaml')


def share(prefix):
    """Lay out what an installation shares; return a file of it."""
    file = prefix / 'share' / 'mddag_executor' / 'config' / 'probe.yaml'
    marker = prefix / 'share' / 'ament_index' / 'resource_index' / 'packages' / 'mddag_executor'
    for path in (file, marker):
        path.parent.mkdir(parents=True)
        path.touch()
    return file


@pytest.mark.parametrize('folder', [
    'lib/python3.12/site-packages', 'local/lib/python3.12/dist-packages', 'elsewhere'])
def test_an_installation_has_its_own_files(tmp_path, folder):
    mine, workspace = tmp_path / 'mine', share(tmp_path / 'workspace')
    modules = mine / folder / 'mddag_executor'
    modules.mkdir(parents=True)
    for name in ('__init__.py', 'errors.py', 'lazy.py', 'resources.py'):
        (modules / name).write_bytes((TOP / 'mddag_executor' / name).read_bytes())
    # A sourced workspace is searched, but must not win.
    expected = workspace if folder == 'elsewhere' else share(mine)
    code = (f'import sys; sys.path.insert(0, {str(modules.parent)!r})\n'
            'from mddag_executor.resources import find\n'
            "print(find('config/probe.yaml'))\n")
    prefixes = f'{tmp_path}/empty::{tmp_path}/workspace'
    found = subprocess.run([sys.executable, '-c', code], check=True, capture_output=True,
                           text=True, env={'AMENT_PREFIX_PATH': prefixes})
    assert found.stdout.strip() == str(expected)
