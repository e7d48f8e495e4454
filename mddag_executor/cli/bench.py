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
The verb `bench`: one sub-verb for each thing that is measured.

Each sub-verb is a module `bench_NAME` of this package with `HELP`, `EXAMPLE`, `add_arguments` and
`main`, as a verb is; the table below holds their one-line helps.
"""

from __future__ import annotations

import argparse
from importlib import import_module
from importlib.util import find_spec

NAME = 'bench'
HELP = 'measure the executor, the core, the replayer and the simulator'
EXAMPLE = 'mddag bench live --load autoware --executors rad-events,multi --utilisation 0.6'

SUBJECTS = {
    'live': 'measure executors of rclpy nodes, this one and those of rclpy, side by side',
    'core': 'measure the scheduler core',
    'replay': 'measure the replayer',
    'evaluate': 'measure the batch evaluation',
}


def available() -> dict[str, str]:
    """Return the sub-verbs that this installation has: their module and its one-line help."""
    names = {name: f'mddag_executor.cli.bench_{name}' for name in SUBJECTS}
    return {name: module for name, module in names.items() if find_spec(module) is not None}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the sub-verbs and their arguments."""
    subjects = parser.add_subparsers(
        dest='subject', metavar='SUBJECT', required=True, title='subjects')
    for name, module_name in available().items():
        module = import_module(module_name)
        examples = ''.join(f'\n  {line}' for line in module.EXAMPLE.strip().splitlines())
        own = subjects.add_parser(
            name, help=SUBJECTS[name], allow_abbrev=False,
            description=module.HELP[:1].upper() + module.HELP[1:].rstrip('.') + '.',
            epilog=f'example:{examples}', formatter_class=argparse.RawDescriptionHelpFormatter)
        module.add_arguments(own)
        own.set_defaults(measure=module.main)


def main(args: argparse.Namespace) -> int:
    """
    Measure what was asked for.

    :raises mddag_executor.errors.MddagError: when anything can not be used
    """
    return int(args.measure(args))
