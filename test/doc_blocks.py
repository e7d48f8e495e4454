# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The code blocks of a page, and how each is tried.

Theory of operation
-------------------
A page (Markdown) has a folder of its own for its test, with `config/`, `bags/` and `examples/` of
the checkout in it; `examples/rerun` is on Python's path, and `examples/third_party/install` is a
sourced workspace.  Its blocks are tried there in the order of the page, so that one may use what
one before it has made.  What is done with a block depends on its language:

* `sh`: run by bash, which must end with status 0; `mddag` and `python` are those of this test.
* `text` right after it: the output of that command.  `…` in it matches anything.
* `python`: run as a program.
* `yaml`: a declaration, which must load.

Comments (HTML, invisible on the page) right before a block change that:

* `<!-- file: NAME -->`: the block is that file's content (and a declaration must still load, once
  all files of the page are there).
* `<!-- exit: N -->`: it ends with this status.
* `<!-- in the test: A => B -->`: B is tried in place of A, to be quick.
* `<!-- measured -->`: the output has measured values.  A number in it stands for any number, and a
  table may have further columns.
* `<!-- not run: REASON -->`: it is not run, for one of ``REASONS``; what can be checked without
  running it is: Python must compile, YAML must parse, options of `mddag` must exist.
"""

from dataclasses import dataclass, field
import os
from pathlib import Path
import re
import subprocess
import sys

import msg_graph
import yaml

TOP = Path(__file__).resolve().parent.parent
REASONS = ('an excerpt', 'needs an installed ROS', 'needs root', 'needs a recorded drive',
           'needs another machine', 'takes minutes')
_BLOCK = re.compile(
    r'(?P<marks>(?:^[ ]*<!-- [^\n]* -->\n+)*)'
    r'^(?P<indent> *)```(?P<language>\w*)[^\n]*\n(?P<text>.*?)^(?P=indent)```$',
    re.MULTILINE | re.DOTALL)
_MARK = re.compile(r'<!-- (file|exit|in the test|not run|measured)(?:: (.*?))? -->')
_NUMBER, _UNIT = r'-?\d[\d,]*(?:\.\d+)?', '(?:ns|us|ms|s)'
# The parts of a measured output that stand for others, and the regular expression of each.
_MEASURED = re.compile(
    rf'(?P<any>…)|(?P<number>{_NUMBER})|(?<=\d )(?P<unit>{_UNIT}\b)|'
    r'(?P<columns> {2,})|(?P<blank> )')
_STANDS_FOR = {
    'any': '.*?', 'number': _NUMBER, 'unit': _UNIT, 'columns': r' [^\n]*?', 'blank': ' +'}
_TIMEOUT_S = 150.0  # of a command that takes 10 s on an idle machine


@dataclass
class Block:
    """A code block: its page, line, language and text, and the marks before it."""

    page: str
    line: int
    language: str
    text: str
    marks: dict[str, list[str]] = field(default_factory=dict)

    @property
    def place(self):
        return f'{self.page}:{self.line}'

    def mark(self, kind):
        return self.marks.get(kind, [None])[0]

    @property
    def to_try(self):
        """Return the text with what the test has in place of it."""
        text = self.text
        for each in self.marks.get('in the test', []):
            old, new = each.split(' => ')
            assert old in text, f'{self.place}: there is no {old!r}'
            text = text.replace(old, new)
        return text


def pages():
    """Return all pages of the project, by their paths in the checkout."""
    found = [TOP / name for name in ('README.md', 'CONTRIBUTING.md', 'CHANGELOG.md')]
    found += [TOP / 'bags' / 'README.md', *(TOP / 'examples').glob('*.md'),
              *sorted((TOP / 'docs').rglob('*.md'))]
    return [path.relative_to(TOP).as_posix() for path in found if path.exists()]


def blocks(page):
    """Return the code blocks of a page."""
    text = (TOP / page).read_text(encoding='utf-8')
    found = []
    for match in _BLOCK.finditer(text):
        marks = {}
        for kind, value in _MARK.findall(match['marks']):
            marks.setdefault(kind, []).append(value)
        assert len(marks.get('not run', [])) < 2, f'{page}: a block is marked twice'
        lines = match['text'].splitlines(keepends=True)
        found.append(Block(
            page, text.count('\n', 0, match.start('language')) + 1, match['language'],
            ''.join(line.removeprefix(match['indent']) for line in lines), marks))
    return found


def _before(variable, *paths):
    """Return the value of a variable of the environment that lists paths, with some before it."""
    return os.pathsep.join([*map(str, paths), *filter(None, [os.environ.get(variable)])])


class Folder:
    """
    The folder in which the blocks of one page are tried.

    :param path: an empty folder.
    :param files: further files that the page uses and does not show.
    """

    def __init__(self, path, files=None):
        self.path = path
        self.output = ''
        for name in ('config', 'bags', 'examples'):
            (path / name).symlink_to(TOP / name)
        for name, text in (files or {}).items():
            self.write(name, text)
        programs = path / '.bin'
        programs.mkdir()
        for name, command in (('mddag', '-m mddag_executor'), ('python', '')):
            program = programs / name
            program.write_text(f'#!/bin/sh\nexec {sys.executable} {command} "$@"\n')
            program.chmod(0o755)
        self._environment = {
            **os.environ,
            'PYTHONPATH': _before('PYTHONPATH', path, path / 'examples' / 'rerun', TOP),
            'AMENT_PREFIX_PATH': _before(
                'AMENT_PREFIX_PATH', path / 'examples' / 'third_party' / 'install'),
            'PATH': os.pathsep.join([str(programs), os.environ['PATH']])}

    def write(self, name, text):
        """Write a file below the folder."""
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding='utf-8')
        return path

    def try_all(self, found):
        """Try blocks, one after the other; those that are files are there from the first on."""
        for block in found:
            if block.mark('file') is not None:
                self.write(block.mark('file'), block.text)
        for block in found:
            self.try_one(block)

    def try_one(self, block):
        """Try a block; an AssertionError says what is wrong with it."""
        name, reason = block.mark('file'), block.mark('not run')
        assert block.language, f'{block.place}: a block has no language'
        if reason is not None:
            assert reason in REASONS, f'{block.place}: no known reason: {reason}'
        elif block.language == 'sh':
            return self._run(block, ['bash', '-eo', 'pipefail', '-c', block.to_try])
        elif block.language == 'python' and name is None:
            self.write('example.py', block.to_try)
            return self._run(block, [sys.executable, 'example.py'])
        elif block.language == 'text' and name is None:
            expected = self._expected(block)
            actual = '\n'.join(line.rstrip() for line in self.output.rstrip().splitlines())
            assert re.fullmatch(expected, actual, re.DOTALL), (
                f'{block.place}: the output is not\n{block.text}\nbut\n{actual}')
            return
        elif block.language == 'yaml':
            # A part is shown by what includes it.
            if name is None or 'arguments:' not in block.text:
                msg_graph.load(self.write(name or 'block.yaml', block.text))
            return
        elif name is not None and block.language != 'python':
            return
        if block.language == 'python':
            compile(block.text, block.place, 'exec')
        elif block.language == 'yaml':
            yaml.safe_load(block.text)
        else:
            assert reason is not None, (
                f'{block.place}: {block.language!r} cannot be tried: mark it')

    @staticmethod
    def _expected(block):
        """Return the regular expression of the output that a block shows."""
        text = block.text.rstrip()
        if block.mark('measured') is None:
            return re.escape(text).replace('…', '.*?')
        parts, end = [], 0
        for match in _MEASURED.finditer(text):
            parts += [re.escape(text[end:match.start()]), _STANDS_FOR[match.lastgroup]]
            end = match.end()
        return ''.join([*parts, re.escape(text[end:])])

    def _run(self, block, command):
        expected = int(block.mark('exit') or 0)
        done = subprocess.run(
            command, cwd=self.path, env=self._environment, text=True, stdin=subprocess.DEVNULL,
            capture_output=True, timeout=_TIMEOUT_S, check=False)
        assert done.returncode == expected, (
            f'{block.place} ended with {done.returncode}\n{done.stdout}{done.stderr}')
        self.output = done.stdout if expected != 2 else done.stderr
