# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""`python -m mddag_executor` is the `mddag` program."""

import sys

from mddag_executor.cli.main import main

if __name__ == '__main__':
    sys.exit(main())
