# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What tests of verbs share: a declaration in the working directory."""

import pytest


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Give a new folder, which is the working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def graph(folder, graph):
    """Give the same in the working directory."""
    return graph
