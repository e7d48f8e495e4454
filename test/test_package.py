# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What `import mddag_executor` gives, and that shipped files are found however it is installed."""

from pathlib import Path

import mddag_executor
from mddag_executor import resources
from mddag_executor.errors import InputError
from mddag_executor.text import listed
import pytest

from .conftest import run_program

TOP = Path(__file__).resolve().parent.parent


def test_public_names_are_found_on_first_use():
    from mddag_executor.executor.executor import MultiDeadlineExecutor
    from mddag_executor.executor.verdicts import DeadlineMiss
    assert mddag_executor.MultiDeadlineExecutor is MultiDeadlineExecutor
    assert mddag_executor.DeadlineMiss is DeadlineMiss
    names = {}
    exec('from mddag_executor import *', names)
    assert set(mddag_executor.__all__) <= set(names) & set(dir(mddag_executor))
    assert all(names[name].__name__ == name for name in mddag_executor.__all__[:-1])
    with pytest.raises(AttributeError, match="no attribute 'Nonsense'"):
        mddag_executor.Nonsense  # noqa: B018


def test_a_long_list_is_shortened():
    assert (listed('abcde'), listed('abcdefg')) == ('a, b, c, d, e', 'a, b, c, d, e, … (2 more)')


def test_a_checkout_has_its_own_files():
    assert resources.find('package.xml') == TOP / 'package.xml'
    with pytest.raises(InputError, match=r'^config/none\.yaml: not found among .*: install'):
        resources.find('config/none.yaml')


def test_a_checkout_may_be_a_folder_of_the_root(monkeypatch):
    monkeypatch.setattr(resources, '__file__', '/no_src/mddag_executor/resources.py')
    with pytest.raises(InputError):
        resources.find('package.xml')


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
