# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Make one measurement in this process and print it as JSON.

    python -m benchmarks.child '{"load": "topics", "executor": "multi", "topics": 20}'
"""

from __future__ import annotations

import sys

from benchmarks.campaign import Spec
from benchmarks.loads import run
from mddag_executor.hosting.child import answer

if __name__ == '__main__':
    answer(lambda: run(Spec.from_json(sys.argv[1])))
