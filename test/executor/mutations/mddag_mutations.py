# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A plugin of pytest that breaks the executor on purpose, and notes how the tests noticed.

MDDAG_MUTATION has the changes as JSON: file in ``mddag_executor``, old text and new text of each.
They are made when the file is imported.  The file MDDAG_MUTATION_REPORT gets a line of JSON when a
test begins, and one for each phase of it that fails and for the end of its call.  So a test that
never ended shows as well: it has only begun.
"""

from importlib.machinery import SourceFileLoader
import json
import os
from pathlib import Path

import pytest

CHANGES = json.loads(os.environ.get('MDDAG_MUTATION', '[]'))
_get_code = SourceFileLoader.get_code


def changed(path, changes):
    """Return a file's text with some texts replaced, each of which it must contain."""
    text = path.read_text(encoding='utf-8')
    for old, new in changes:
        assert old in text, f'{path} has no longer: {old}'
        text = text.replace(old, new)
    return text


def get_code(self, name):
    file = '/'.join(name.split('.')[1:]) + '.py'
    changes = [(old, new) for each, old, new in CHANGES if each == file]
    if not name.startswith('mddag_executor.') or not changes:
        return _get_code(self, name)
    return compile(changed(Path(self.path), changes), self.path, 'exec')


SourceFileLoader.get_code = get_code


def note(**what):
    with Path(os.environ['MDDAG_MUTATION_REPORT']).open('a', encoding='utf-8') as lines:
        lines.write(json.dumps(what) + '\n')


def pytest_runtest_logstart(nodeid):
    note(test=nodeid, outcome='begun')


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    phase = yield
    if phase.failed or phase.when == 'call':
        note(test=item.nodeid, when=phase.when, outcome=outcome_of(phase, call),
             seconds=round(phase.duration, 3))
    return phase


def outcome_of(phase, call):
    """Return ``passed``, ``assertion`` (of the test, or of a fixture's end) or ``error``."""
    if not phase.failed:
        return str(phase.outcome)
    judged = (AssertionError, pytest.fail.Exception)
    return 'assertion' if call.excinfo.errisinstance(judged) else 'error'
