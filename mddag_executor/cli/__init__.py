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
The command line program `mddag`: one module for each verb.

A verb's module has these names, and is imported only when its verb is run:

| name | meaning |
| --- | --- |
| `EXAMPLE` | a command line, or several lines of them, shown by `--help` |
| `add_arguments(parser)` | declares the arguments; a verb of verbs adds its sub-verbs here |
| `main(args) -> int` | does it and returns the exit status (0, or 1 for `--fail-on-miss`) |

Its one-line help is in the table of `main.py`. The module of a verb of a verb (`graph_…`,
`bench_…`) has its own in `HELP`, and what its `--help` begins with in `DESCRIPTION`.

A verb reports bad input by raising an error of `mddag_executor.errors` or `msg_graph`;
`main.py` turns it into the one line on standard error and exit status 2. What the verbs share is
in `options.py` (arguments), `common.py` (files) and `text.py` (tables, warnings, progress).
"""
