# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Shipped files are found in a checkout and in every kind of installation."""

from pathlib import Path

from mddag_executor import resources
from mddag_executor.errors import InputError
import pytest

from .conftest import run_program

TOP = Path(__file__).resolve().parent.parent


def test_a_checkout_has_its_own_files():
    assert resources.find('package.xml') == TOP / 'package.xml'
    with pytest.raises(InputError, match=r'^config/none\.yaml: not found among .*: install'):
        resources.find('config/none.yaml')


@pytest.mark.parametrize('folder', [
    'lib/python3.12/site-packages', 'local/lib/python3.12/dist-packages', ''])
def test_an_installation_has_its_own_files(tmp_path, folder):
    modules = tmp_path / folder / 'mddag_executor'
    config = tmp_path / 'share' / 'mddag_executor' / 'config' / 'probe.yaml'
    for path in (modules, config):
        path.mkdir(parents=True)
    for name in ('__init__.py', 'errors.py', 'lazy.py', 'resources.py'):
        (modules / name).write_bytes((TOP / 'mddag_executor' / name).read_bytes())
    code = (f'import sys; sys.path.insert(0, {str(modules.parent)!r})\n'
            'from mddag_executor.resources import find\n'
            "print(find('config/probe.yaml'))\n")
    assert run_program(code)[0] == f'{config}\n'
