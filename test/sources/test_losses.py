# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What a recording lacks is counted by kind, with one line for each."""

from mddag_executor import open_recording, replay
from mddag_executor.recording.losses import Loss, Losses
from msg_graph import loads

from .helpers import SMALL, small, VirtualRun


def kinds(path, graph=None):
    return {loss.kind: loss.count for loss in open_recording(path, graph).missing}


def test_a_whole_recording_lacks_nothing(tmp_path):
    path = tmp_path / 'run.mcap'
    VirtualRun(path, small(), 0)
    assert kinds(path) == {}


def test_a_killed_run_has_no_end(tmp_path):
    path = tmp_path / 'run.mcap'
    VirtualRun(path, small(), 0, shut_down=False)
    missing = open_recording(path).missing
    assert [(loss.kind, loss.count) for loss in missing] == [('end', 1)]
    assert missing.lines() == replay(path).warnings and missing.count('events') == 0


def test_damage_comes_first(tmp_path):
    path = tmp_path / 'run.mcap'
    VirtualRun(path, small(), 0)
    path.write_bytes(path.read_bytes()[:-40])
    first, *_ = open_recording(path).missing
    assert first.kind == 'damage' and first.text.startswith(f'{path}: the summary at the end')


def test_declared_callbacks_that_are_not_recorded(tmp_path):
    path = tmp_path / 'run.mcap'
    VirtualRun(path, small(), 0)
    more = SMALL + '  - {node: /new, callbacks: [{name: t, timer: 10ms, deadline: 5ms}]}\n'
    found = list(open_recording(path, loads(more, 'g.yaml')).missing)
    assert [(loss.kind, loss.count) for loss in found] == [('callbacks', 1)] * 2
    assert '/new:t' in found[0].text and '1 DAG without jobs' in found[1].text


def test_losses_are_added_up():
    one = Losses([Loss('events', 2, 'a: 2 events lost')])
    two = one.more(Loss('events', 3, 'b: 3 events lost'), Loss('end', 1, 'b: no end'))
    assert (one.count('events'), two.count('events'), two.count('end')) == (2, 5, 1)
    assert len(two) == 3 and two.lines()[0] == 'a: 2 events lost'
