# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A workspace with nodes that people could have written: see `guests/`."""

import os
from pathlib import Path
import sys

GUESTS = Path(__file__).resolve().parent / 'guests'

GRAPH = """\
mddag: 1
nodes:
  - node: /talker
    callbacks: [{name: tick, timer: 50ms, publishes: [/chatter]}]
  - node: /listener
    callbacks: [{name: heard, subscription: /chatter, deadline: 50ms}]
"""
TWO_PROCESSES = """\
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: t, timer: 9ms, deadline: 9ms, execution_time: 1ms}]}
  - {node: /b, callbacks: [{name: t, timer: 9ms, deadline: 9ms, execution_time: 1ms}]}
processes: {one: [/a], two: [/b]}
"""


def make_workspace(folder, monkeypatch):
    """Make an ament package and modules; go there."""
    prefix = folder / 'ws'
    index = prefix / 'share' / 'ament_index' / 'resource_index' / 'packages'
    index.mkdir(parents=True)
    (index / 'chat_nodes').touch()
    (index / 'empty_nodes').touch()
    library = prefix / 'lib' / 'chat_nodes'
    library.mkdir(parents=True)
    for name, text in {
        'talker': '#!/usr/bin/env python3\n' + (GUESTS / 'talker.py').read_text(),
        'shell': '#!/bin/sh\nexit 0\n', 'broken.py': 'def (\n', 'native': '\x7fELF\x02\x01',
    }.items():
        (library / name).write_text(text)
        (library / name).chmod(0o755)
    site = folder / 'site'
    site.mkdir()
    (site / 'chat.py').write_text((GUESTS / 'chat.py').read_text())
    (site / 'half.py').write_text('import not_installed_anywhere\n')
    (site / 'wrong.py').write_text('x = 1\nraise RuntimeError("no licence\\nhere")\n')
    (folder / 'graph.yaml').write_text(GRAPH)
    # Before what is there: rclpy and this package may come from a sourced ROS or workspace.
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(prefix), prepend=os.pathsep)
    monkeypatch.setenv('PYTHONPATH', str(site), prepend=os.pathsep)
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.chdir(folder)
    for name in ('chat', 'half', 'wrong'):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return folder
