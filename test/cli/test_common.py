# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Reading and writing files, and standard input."""

from __future__ import annotations

import json
import os
from pathlib import Path
import stat

from mddag_executor.cli import common
from mddag_executor.errors import InputError, UsageError
import numpy
import pytest


def test_a_dash_is_standard_input(stdin) -> None:
    stdin(b'a: b\n')
    assert common.read_text('-') == ('<stdin>', 'a: b\n')


def test_standard_input_is_read_once(stdin) -> None:
    stdin(b'a: b\n')
    common.read_text('-')
    with pytest.raises(UsageError, match='only once'):
        common.read_text('-')
    stdin(b'again')
    assert common.read_text('-') == ('<stdin>', 'again')


def test_a_trace_from_standard_input_is_seekable(stdin) -> None:
    data = os.urandom(3_000_000)
    stdin(data)
    with common.input_file('-') as path:
        with path.open('rb') as file:
            file.seek(1_500_000)
            assert file.read() == data[1_500_000:]
    assert not path.exists()


def test_json_is_written_whole(tmp_path: Path) -> None:
    path = tmp_path / 'result.json'
    value = {'name': 'ä\x1b', 'ns': numpy.int64(3), 'list': numpy.arange(2), 'path': Path('a')}
    common.write_json(str(path), value)
    assert json.loads(path.read_text()) == {'name': 'ä\x1b', 'ns': 3, 'list': [0, 1], 'path': 'a'}
    assert path.read_text().endswith('\n')
    assert os.listdir(tmp_path) == ['result.json']
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~umask


@pytest.mark.parametrize('value', [{'a': float('nan')}, {'a': object()}])
def test_what_json_lacks_leaves_no_file(tmp_path: Path, value: object) -> None:
    with pytest.raises((ValueError, TypeError)):
        common.write_json(str(tmp_path / 'result.json'), value)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize('error', [RuntimeError, KeyboardInterrupt])
def test_a_failed_output_leaves_what_was_there(tmp_path: Path, error: type) -> None:
    path = tmp_path / 'out.bin'
    path.write_bytes(b'before')
    with pytest.raises(error), common.output_file(str(path)) as file:
        file.write(b'half')
        raise error
    assert path.read_bytes() == b'before'
    assert os.listdir(tmp_path) == ['out.bin']


def test_an_output_keeps_links_and_permissions(tmp_path: Path) -> None:
    target, link = tmp_path / 'target', tmp_path / 'link'
    target.write_text('before')
    target.chmod(0o640)
    link.symlink_to('target')
    common.write_text(str(link), 'after')
    assert link.is_symlink()
    assert target.read_text() == 'after'
    assert stat.S_IMODE(target.stat().st_mode) == 0o640


def test_an_output_may_be_a_pipe(tmp_path: Path) -> None:
    pipe = tmp_path / 'pipe'
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        common.check_output(str(pipe))
        common.write_text(str(pipe), 'through')
        assert os.read(reader, 100) == b'through'
    finally:
        os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


@pytest.mark.skipif(os.geteuid() == 0, reason='root may write everywhere')
def test_a_folder_without_write_permission(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match='cannot be written to'):
        common.check_output(str(tmp_path / 'new.json'))
