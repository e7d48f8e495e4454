# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""CARET's sample recordings, which are not part of the project."""

import os
from pathlib import Path

# not a part of the repository: looked for next to it
BESIDE = Path(__file__).resolve().parents[3] / 'shared' / 'caret'
CARET = Path(os.environ.get('MDDAG_CARET_SAMPLE', BESIDE))
