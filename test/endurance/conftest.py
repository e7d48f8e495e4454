# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Let the tests import the programs of this folder as these import each other."""

from pathlib import Path
import sys

sys.path.insert(0, str(Path(__file__).parent))
