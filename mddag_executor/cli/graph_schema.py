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

"""The verb `graph schema`: the JSON Schema of declarations, for editors."""

from __future__ import annotations

import argparse

from mddag_executor.cli import common

HELP = 'print the JSON Schema of declarations, for editors'
EXAMPLE = """\
mddag graph schema -o mddag.schema.json
"""
DESCRIPTION = """\
Print the JSON Schema (draft 7) of declarations. Editors with a language server for YAML complete
and check a declaration that begins with the line
  # yaml-language-server: $schema=mddag.schema.json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        '-o', '--output', metavar='OUT', default='-', help="the file ('-': standard output)")


def main(args: argparse.Namespace) -> int:
    """Print the schema."""
    from msg_graph.schema import schema
    common.check_output(args.output)
    common.write_json(args.output, schema())
    return 0
