# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Comparison with the files in golden/, without what is different in each run."""

import os
from pathlib import Path
import re

from mddag_executor import __version__

FOLDER = Path(__file__).with_name('golden')
_CHANGING = (
    (re.compile(r'"(elapsed_s)": [0-9.e-]+'), r'"\1": 0'),
    (re.compile(r'in \d+\.\d s, \d+\.\d\d ms for'), 'in 0.0 s, 0.00 ms for'),
    (re.compile('sha256:[0-9a-f]{64}'), 'DIGEST'),
    (re.compile(r'in [0-9.]+ s \([0-9.]+ times'), 'in 0 s (0 times'),
    # what libraries say, which is not the same in each version
    (re.compile('(invalid choice|not usable JSON|--dask nonsense|initialize rcl)[ :].*'), r'\1 …'),
    (re.compile(f'"mddag": "{re.escape(__version__)}"'), '"mddag": "VERSION"'))


def compare(name, found, folder=FOLDER):
    """Compare a text with a file; with UPDATE_GOLDEN in the environment, write the file."""
    found = found.replace('\r\n', '\n')
    for pattern, constant in _CHANGING:
        found = pattern.sub(constant, found)
    path = folder / f'{name}.txt'
    if os.environ.get('UPDATE_GOLDEN'):
        path.write_bytes(found.encode())
    assert found == path.read_bytes().decode()


def words(text):
    """Return the text of a live run without its numbers, and without what a busy machine adds."""
    text = re.sub(r'-?\d+(\.\d+)?( (ns|us|ms|s)\b)?', '#', re.sub(' +', ' ', text))
    text = re.sub('(, #)? (expired|demoted)', '', text)     # counts that are shown if not 0
    return ''.join(f'{re.sub("# (#( %)? )*", "# ", line)}\n' for line in text.splitlines()
                   if not re.search('due to # stops?|# dropped|timer releases? skipped|'
                                    'differences? between', line))


def shape(value):
    """Return a result without its values: the names of all that it has whatever happens."""
    if isinstance(value, dict):
        return {key: '...' if key == 'dropped' else shape(each)
                for key, each in sorted(value.items()) if key != 'demoted'}
    return '...'
