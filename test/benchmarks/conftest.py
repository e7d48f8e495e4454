# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Benchmarks measure the executor as it is used: without the checks for debugging."""

import pytest


@pytest.fixture(scope='module', autouse=True)
def unchecked():
    """Have no program that a test starts check the engine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv('MDDAG_DEBUG', raising=False)
        yield
