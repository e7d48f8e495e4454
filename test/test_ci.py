# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What continuous integration counts as passed, and what a release needs."""

import json
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys

from mddag_executor import __version__
import pytest
import yaml

from .conftest import ALLOWED_SKIPS, is_allowed_skip, keep_bytecode

TOP = Path(__file__).resolve().parent.parent
# Used as make: the first call fails with these tests in the cache, and the second one passes.
MAKE = """#!/bin/sh
[ -e .repeated ] && exit 0
case "$*" in *last-failed*) touch .repeated; exit {status};; esac
mkdir -p .pytest_cache/v/cache
{write}
exit 1
"""


def run_ci(folder, failed, status=0):
    """Run `.ci/run` with a make of which some tests fail at first; return the finished process."""
    (folder / '.ci').mkdir()
    for name in ('run', 'flaky'):
        shutil.copy(TOP / '.ci' / name, folder / '.ci' / name)
    text = json.dumps(dict.fromkeys(failed, True))
    write = f"echo '{text}' > .pytest_cache/v/cache/lastfailed" if failed else ':'
    make = folder / 'bin' / 'make'
    make.parent.mkdir()
    make.write_text(MAKE.format(status=status, write=write), encoding='utf-8')
    make.chmod(0o755)
    return subprocess.run(
        ['bash', '.ci/run'], cwd=folder, text=True, capture_output=True, check=False, timeout=60,
        env={**os.environ, 'PATH': f'{make.parent}{os.pathsep}{os.environ["PATH"]}'})


@pytest.mark.parametrize(('failed', 'status', 'expected'), [
    (['a.py::b'], 0, 0), (['a.py::b', 'a.py::c'], 0, 0), (['a.py::b', 'a.py::c', 'd.py::e'], 0, 1),
    (['a.py::b'], 1, 1), ([], 0, 1)])
def test_flaky_tests_are_named_and_at_most_two(failed, status, expected, tmp_path):
    done = run_ci(tmp_path, failed, status)
    assert done.returncode == expected, done.stdout + done.stderr
    flaky = [line[7:] for line in done.stdout.splitlines() if line.startswith('FLAKY: ')]
    assert flaky == ([] if status else failed)


def test_a_skip_without_a_known_reason_fails_in_continuous_integration(monkeypatch):
    assert all(is_allowed_skip(f'Skipped: {reason}') for reason in ALLOWED_SKIPS)
    assert not is_allowed_skip('Skipped: something is not there')
    monkeypatch.setenv('MDDAG_NO_SKIP', 'ros2 is not installed')
    assert not is_allowed_skip('Skipped: ros2 is not installed here')


def test_each_allowed_reason_is_one_of_a_test():
    tests = ''.join(path.read_text(encoding='utf-8') for path in (TOP / 'test').rglob('*.py')
                    if path != TOP / 'test' / 'conftest.py')
    assert [reason for reason in ALLOWED_SKIPS if reason not in tests] == []


@pytest.mark.parametrize('unwanted', ['', '1'])
def test_programs_share_bytecode_that_is_not_next_to_the_sources(tmp_path, unwanted):
    (tmp_path / 'module.py').touch()
    environment = {'PYTHONDONTWRITEBYTECODE': unwanted}
    keep_bytecode(environment, tmp_path / 'kept')
    subprocess.run([sys.executable, '-c', 'import module'], cwd=tmp_path, env=environment,
                   check=True)
    found, = tmp_path.rglob('module.*.pyc')
    assert found.is_relative_to(tmp_path / ('kept' if unwanted else '__pycache__'))


def test_pytest_7_finds_the_neighbours_of_the_conftest():
    """Ubuntu has that version.  It does not import the package first, and Python has a `test`."""
    code = (
        'import importlib.util, sys, types\n'
        'sys.modules["test"] = types.ModuleType("test")\n'
        'spec = importlib.util.spec_from_file_location("test.conftest", sys.argv[1])\n'
        'sys.modules["test.conftest"] = module = importlib.util.module_from_spec(spec)\n'
        'spec.loader.exec_module(module)\n'
        'print(module._claim_domain())')
    done = subprocess.run([sys.executable, '-c', code, TOP / 'test' / 'conftest.py'], text=True,
                          capture_output=True, check=True)
    assert int(done.stdout) >= 0


def test_tools_that_are_missing_are_known_with_their_packages():
    done = subprocess.run(
        [shutil.which('sh'), TOP / '.ci' / 'tools', 'missing'], env={'PATH': '/nowhere'},
        text=True, capture_output=True, check=True)
    lines = dict(line.split(' ', 1) for line in done.stdout.splitlines())
    tests = ''.join(path.read_text(encoding='utf-8') for path in (TOP / 'test').rglob('test_*.py'))
    assert set(lines) == set(re.findall(r"mark\.needs\('(\w+)'\)", tests))


@pytest.mark.parametrize('target', ['test', 'test-kilted', 'test-jazzy'])
def test_make_gets_the_tools_of_the_tests_that_it_runs(target):
    """In continuous integration a test fails if its program is missing."""
    done = subprocess.run(
        ['make', '-n', target], cwd=TOP, text=True, capture_output=True, check=True)
    assert 'sh .ci/tools install' in done.stdout


def test_actions_are_pinned_and_workflows_are_yaml():
    paths = sorted((TOP / '.github' / 'workflows').glob('*.yml'))
    for path in paths:
        text = path.read_text(encoding='utf-8')
        assert yaml.safe_load(text)['jobs']
        uses = re.findall(r'uses: (\S+)', text)
        assert uses and all(re.fullmatch(r'[\w.-]+/[\w.-]+@[0-9a-f]{40}', each) for each in uses)
    assert paths


# --- release -------------------------------------------------------------------------------------


def is_tagged():
    """Return whether the checkout is that of a version's tag."""
    if os.environ.get('GITHUB_REF_TYPE') == 'tag':
        return True
    done = subprocess.run(['git', 'tag', '--points-at', 'HEAD'], cwd=TOP, text=True,
                          capture_output=True, check=False)
    return __version__ in done.stdout.split()


def placeholders():
    """Return the files that have an address at example.com, which belongs to no one."""
    done = subprocess.run(
        ['git', 'grep', '-lI', r'example\.com', '--', ':!test/test_ci.py', ':!docs/release.md'],
        cwd=TOP, text=True, capture_output=True, check=False)
    return done.stdout.split()


def test_addresses_are_in_one_place_and_filled_in_at_a_tag():
    assert set(placeholders()) <= {'package.xml'}, 'package.xml is the one place for addresses'
    assert not (is_tagged() and placeholders()), (
        'package.xml: fill in the maintainer and the addresses before a release')


def test_the_changelog_for_bloom_has_the_released_versions():
    text = subprocess.run(
        [sys.executable, TOP / '.ci' / 'changelog_rst'], text=True, capture_output=True,
        check=True).stdout
    markdown = (TOP / 'CHANGELOG.md').read_text(encoding='utf-8')
    versions = re.findall(r'^## (\d\S+) - (\S+)$', markdown, re.MULTILINE)
    assert versions and re.findall(r'^(\d\S+) \((\S+)\)\n-+$', text, re.MULTILINE) == versions
    assert text.startswith('^^^') and 'Unreleased' not in text
    assert not re.search(r'(?<!`)`(?!`)[^`<]*`(?!`)(?!_)|\]\(|^#|^- ', text, re.MULTILINE)
    assert len(re.findall(r'^\* ', text, re.MULTILINE)) > 50


def test_a_project_page_has_links_that_work_everywhere():
    done = subprocess.run(
        [sys.executable, 'setup.py', '--quiet', '--long-description'], cwd=TOP, text=True,
        capture_output=True, check=True, env={**os.environ, 'PYTHONWARNINGS': 'ignore'})
    text = done.stdout
    links = re.findall(r'\]\(([^)\s]+)\)', text)
    assert len(links) > 30
    assert not [link for link in links if not re.match(r'https?://|#', link)]
    assert '<!--' not in text
    for link in links:
        name = re.sub(r'^.*?/(?:blob|raw)/HEAD/', '', link).partition('#')[0]
        assert name == link.partition('#')[0] or (TOP / name).exists(), link
