# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Make one measurement in this process and print it as JSON.

    python -m mddag_executor.executor.bench '{"load": "topics", "executor": "multi", "topics": 20}'

The process ends without destroying anything: rclpy's executors cannot be stopped in an orderly way
while callbacks wait for their pool.  It also ends when its standard input does, so that it cannot
outlive the process that started it, even when that was killed.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import traceback
from typing import TextIO

from mddag_executor.errors import MddagError
from mddag_executor.executor.bench.campaign import Spec
from mddag_executor.executor.bench.loads import run
from msg_graph import GraphError


def _end_with_stdin() -> None:
    sys.stdin.buffer.read()
    os._exit(1)


def main(text: str) -> int:
    """Make the measurement that a text says; return the exit status."""
    threading.Thread(target=_end_with_stdin, daemon=True).start()
    output = _take_stdout()
    try:
        result = run(Spec.from_json(text))
    except (MddagError, GraphError) as error:
        print(error, file=sys.stderr)
        return 2
    except BaseException:
        traceback.print_exc()
        return 70
    with output:
        json.dump(result, output, default=list)
        output.write('\n')
    return 0


def _take_stdout() -> TextIO:
    """
    Return standard output, and let everybody else who writes to it write to standard error.

    Native code of rclpy's does: where a clock has many timers, for instance.
    """
    output = os.fdopen(os.dup(sys.stdout.fileno()), 'w')
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return output


if __name__ == '__main__':
    # Not even an exception may end in the interpreter's exit, which joins the executor's threads.
    status = main(sys.argv[1])
    sys.stderr.flush()
    os._exit(status)
