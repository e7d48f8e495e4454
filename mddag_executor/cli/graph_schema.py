# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph schema`: the JSON Schema of declarations, for editors."""

from __future__ import annotations

import argparse

from mddag_executor.cli import common, options

EXAMPLE = """\
mddag graph schema -o mddag.schema.json
"""
DESCRIPTION = """\
Print the JSON Schema (draft 7) of declarations. Editors with a language server for YAML complete
and check a declaration that begins with the line
  # yaml-language-server: $schema=mddag.schema.json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('-o', '--output', metavar='OUT', type=options.Output, default='-',
                        help="the file ('-': standard output)")


def main(args: argparse.Namespace) -> int:
    from msg_graph.language import schema
    common.write_json(args.output, schema())
    return 0
