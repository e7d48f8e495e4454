# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Random task sets as ordinary declarations, to test beyond the workloads that ship."""

from mddag_executor.generate.declaration import generate
from mddag_executor.generate.options import BASES, GenerateError, METHODS, Options

__all__ = ['BASES', 'GenerateError', 'METHODS', 'Options', 'generate']
