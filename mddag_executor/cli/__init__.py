# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The command line program `mddag`: one module for each verb.

A verb's module is imported only when its verb is run, and has these names:

| name | meaning |
| --- | --- |
| `EXAMPLE` | one command line or more, shown by `--help` |
| `DESCRIPTION` | what `--help` begins with, if that is more than the verb's line in `verbs.py` |
| `add_arguments(parser)` | declares the arguments |
| `main(args) -> int` | does the work and returns the exit status (0, or 1 for `--fail-on-miss`) |

A verb reports bad input by raising an error of `mddag_executor.errors` or `msg_graph`;
`main.py` turns it into one line on standard error and exit status 2. The verbs share
`options.py` (arguments), `common.py` (files), `recorded.py` (recordings) and `text.py` (tables,
warnings, progress).
"""
