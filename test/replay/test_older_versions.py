# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Recordings of earlier versions stay readable."""

from __future__ import annotations

from mddag_executor.recording.head import declared, Head
import pytest

DECLARATION = """mddag: 1
nodes:
  - node: /camera
    callbacks:
      - {{name: capture, timer: 10ms, publishes: [], deadline: 5ms, {key} abort}}
"""


@pytest.mark.parametrize('key', ['on_miss:', '"on_miss":', "'on_miss' :"])
def test_a_recorded_declaration_may_have_the_key_of_version_1(key: str) -> None:
    def read(text: str) -> object:
        return declared(
            Head(0, text, 'graph.yaml', 'rad', 7, 100_000_000, 64, False), 'run.mcap').dags

    now = read(DECLARATION.format(key='on_late:'))
    assert read(DECLARATION.format(key=key)) == now
