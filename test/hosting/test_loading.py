# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

from pathlib import Path
import sys

from mddag_executor.hosting.loading import LoadingError, resolve
import pytest

from .workspace import make_workspace


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return make_workspace(tmp_path, monkeypatch)


@pytest.mark.parametrize(('spec', 'argv0'), [
    ('chat_nodes/talker', '{world}/ws/lib/chat_nodes/talker'),
    ('pip-nodes/listener', 'listener'),
    ('pip_nodes/listener', 'listener'),
    ('chat:main', 'chat'),
    ('chat:Listener', 'chat'),
])
def test_what_exists_is_found(world: Path, spec: str, argv0: str) -> None:
    program = resolve(spec)
    assert (program.spec, program.argv0) == (spec, argv0.format(world=world))


def test_a_program_has_a_command_line_of_its_own_while_it_is_imported(
    world: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (world / 'mine_argv.py').write_text(
        'import sys\nseen = [*sys.argv]\ndef main():\n    return seen\n')
    monkeypatch.syspath_prepend(world)
    before = sys.argv
    program = resolve("mine_argv:main --rate '2 Hz'", ['--ros-args', '-r', 'a:=b'])
    seen = sys.modules.pop('mine_argv').seen
    assert seen == ['mine_argv', '--rate', '2 Hz', '--ros-args', '-r', 'a:=b']
    assert program.arguments == ('--rate', '2 Hz') and sys.argv is before


@pytest.mark.parametrize(('spec', 'message'), [
    ("chat:main 'x", 'its quotes are not right'),
    ('chat:main --ros-args -r a:=b', 'put --ros-args at the end of the command line'),
    ('talker', 'this names no node: write package/executable, module:function'),
    ('', 'this names no node'),
    ('a/b/c', 'this names no node'),
    ('/talker', 'this names no node'),
    ('chat:', 'this names no node'),
    (':main', 'this names no node'),
    ('chat:main()', 'this names no node'),
    ('chat_node/talker', "there is no package 'chat_node': did you mean 'chat_nodes'"),
    ('zzzzzzzz/talker', "there is no package 'zzzzzzzz': source its workspace's setup file"),
    ('chat_nodes/talkr', "package 'chat_nodes' has no executable 'talkr': did you mean 'talker'?"),
    ('chat_nodes/zzz', "has no executable 'zzz': it has broken.py, native, shell, talker"),
    ('empty_nodes/x', "package 'empty_nodes' has no executable 'x': it has none"),
    ('pip-nodes/lisener', "has no executable 'lisener': did you mean 'listener'?"),
    ('pip-nodes/stale', "module 'chat' has no 'gone': it has "),
    ('chat_nodes/native', 'only Python nodes can run in this process, and '),
    ('chat_nodes/shell', "shell is no Python program: start it by itself with 'ros2 run'"),
    ('chat_nodes/broken.py', 'broken.py is not valid Python (SyntaxError'),
    ('nowhere:main', "there is no module 'nowhere'"),
    ('chat.sub:main', "there is no module 'chat.sub'"),
    ('half:main', "'half' needs the module 'not_installed_anywhere', which is not installed"),
    ('wrong:main',
     "'wrong' cannot be imported (RuntimeError: no licence here, {site}/wrong.py:2)"),
    ('chat:mian', "module 'chat' has no 'mian': did you mean 'main'"),
    ('chat:NoNode', "'NoNode' is a class, but no rclpy node"),
    ('chat:NUMBER', "'NUMBER' is no function and no class, but of type int"),
])
def test_what_does_not_exist_is_said_on_one_line(world: Path, spec: str, message: str) -> None:
    with pytest.raises(LoadingError) as error:
        resolve(spec)
    text = str(error.value)
    assert text.startswith(f'--node {spec}: ')
    assert message.format(site=world / 'site') in text
    assert '\n' not in text
