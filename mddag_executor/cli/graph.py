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
The verb `graph`: what a declaration means; each of its own verbs is a module `graph_…`.

Those modules import nothing heavy before they run: `mddag graph --help` stays quick.
"""

from __future__ import annotations

import argparse
from importlib import import_module

from mddag_executor.cli.options import add_verb

EXAMPLE = """\
mddag graph check config/autoware.yaml
mddag graph draw config/autoware.yaml -o autoware.svg
mddag graph check --help
"""

VERBS = ('check', 'draw', 'schema', 'fmt', 'from-caret', 'from-trace', 'from-ros', 'analyse',
         'assign-deadlines')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verbs of this verb, with their arguments."""
    verbs = parser.add_subparsers(dest='graph_verb', metavar='VERB', required=True, title='verbs')
    for name in VERBS:
        module = import_module(f'mddag_executor.cli.graph_{name.replace("-", "_")}')
        add_verb(verbs, name, module, module.HELP, module.DESCRIPTION)
