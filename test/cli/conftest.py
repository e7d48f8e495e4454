# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What tests of verbs share: a declaration in the working directory."""

import pytest

from . import golden


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Give a new folder, which is the working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def graph(folder, request):
    """Give the declaration `GRAPH` of the test's module, or that in golden/, as graph.yaml."""
    text = getattr(request.module, 'GRAPH', None)
    (folder / 'graph.yaml').write_text(text or (golden.FOLDER / 'graph.yaml').read_text())
    return folder / 'graph.yaml'
