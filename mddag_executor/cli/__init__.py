# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The command line program `mddag`: one module for each verb.

A verb's module has these names, and is imported only when its verb is run:

| name | meaning |
| --- | --- |
| `EXAMPLE` | a command line, or several lines of them, shown by `--help` |
| `add_arguments(parser)` | declares the arguments |
| `main(args) -> int` | does it and returns the exit status (0, or 1 for `--fail-on-miss`) |

Its one-line help is in the table of `main.py`. The module of a verb of a verb (`graph_…`) has its
own in `HELP`, and what its `--help` begins with in `DESCRIPTION`.

A verb reports bad input by raising an error of `mddag_executor.errors` or `msg_graph`;
`main.py` turns it into the one line on standard error and exit status 2. What the verbs share is
in `options.py` (arguments), `common.py` (files) and `text.py` (tables, warnings, progress).
"""
