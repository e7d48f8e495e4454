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

"""The verb `bench`: what is measured; each subject is a module `bench_…`, as a verb is."""

from __future__ import annotations

import argparse
from importlib import import_module

from mddag_executor.cli.options import add_verb

EXAMPLE = 'mddag bench live --load autoware --executors rad-events,multi --utilisation 0.6'

SUBJECTS = ('live', 'core', 'replay', 'evaluate')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the subjects and their arguments."""
    subjects = parser.add_subparsers(
        dest='subject', metavar='SUBJECT', required=True, title='subjects')
    for name in SUBJECTS:
        module = import_module(f'mddag_executor.cli.bench_{name}')
        add_verb(subjects, name, module, module.HELP, module.DESCRIPTION)
