# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The `mddag` program, which `python -m mddag_executor` is as well."""

import sys

_INTERRUPTED = 130


def main() -> int:
    """Run the program; a Ctrl-C while it is imported is as quiet as a later one."""
    try:
        from mddag_executor.cli.main import main as run
    except KeyboardInterrupt:
        return _INTERRUPTED
    return run()


if __name__ == '__main__':
    sys.exit(main())
