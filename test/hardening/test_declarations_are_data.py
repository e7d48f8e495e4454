# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Files that mean harm, at every verb that reads one: bounded, and nothing in them is obeyed."""

import os
from pathlib import Path

import msg_graph
import numpy as np
import pytest

TOP = Path(__file__).resolve().parents[2]
AUTOWARE = TOP / 'config' / 'autoware.yaml'
HEAD = 'mddag: 1\n'


HARMFUL = {
    'aliases': HEAD + 'x0: &a0 [1, 1]\n' + ''.join(
        f'x{i}: &a{i} [{", ".join([f"*a{i - 1}"] * 9)}]\n' for i in range(1, 12)),
    'deep blocks': HEAD + 'nodes:\n' + ''.join(' ' * i + '- \n' for i in range(1, 2000)),
    'code': HEAD + 'nodes: !!python/object/apply:os.system ["touch owned"]\n',
    'a long name': HEAD + f'nodes: [{{node: /{"n" * 1_000_000}, callbacks: []}}]\n',
    'many errors': HEAD + f'nodes: [{", ".join(["{node: x, y: z}"] * 20_000)}]\n',
    'open brackets': HEAD + f'arguments: {{a: b}}\nnodes: ["{"$(" * 1_000_000}"]\n',
    'escapes': HEAD + 'nodes: [{node: "/\\e[2J", "\\e]0;x\\a": 1}]\n',
}


def refused(done, folder):
    """Check that something was refused, in lines, and did nothing."""
    assert done.returncode == 2, done.stdout + done.stderr
    lines = done.stderr.splitlines()
    assert 1 <= len(lines) <= 60 and all(line.isprintable() for line in lines)
    assert all(line.startswith('error: ') and len(line) < 2000 for line in lines)
    assert not (folder / 'owned').exists() and not (folder / 'out.yaml').exists()


@pytest.mark.parametrize('command', [
    'graph check graph.yaml', 'graph from-caret graph.yaml -o out.yaml'])
@pytest.mark.parametrize('name', HARMFUL)
def test_harmful_yaml_is_refused(call, tmp_path, command, name):
    (tmp_path / 'graph.yaml').write_text(HARMFUL[name])
    refused(call(*command.split(), cwd=tmp_path), tmp_path)


@pytest.mark.parametrize('command', [
    'graph check /dev/zero', 'graph from-caret /dev/zero -o out.yaml',
    f'simulate {AUTOWARE} --execution-times /dev/zero', 'replay /dev/zero', 'replay /dev/urandom'])
def test_endless_files(mddag, tmp_path, command):
    refused(mddag(*command.split(), cwd=tmp_path, timeout=30), tmp_path)


OUTSIDE, IRREGULAR = 'lies outside of the folder of the first file', 'it is not a regular file'


@pytest.mark.parametrize(('name', 'says'), [
    ('/etc/passwd', "'/etc/passwd' is not a relative path"), ('../secret.yaml', OUTSIDE),
    ('link', OUTSIDE), ('folder/link', OUTSIDE), ('folder', IRREGULAR), ('fifo', IRREGULAR),
    *((name, '') for name in (
        'sub/../../secret.yaml', '~/secret.yaml', '.', '"a\\0b"', '$(HOME)/x', "''"))])
def test_includes_stay_in_their_folder(tmp_path, name, says):
    """And what is outside of it is not even looked at."""
    secret, inside = tmp_path / 'secret.yaml', tmp_path / 'inside'
    secret.write_text('mddag: 1\nnodes: [the secret]\n')
    for folder in (inside / 'folder', inside / 'sub'):
        folder.mkdir(parents=True)
    for link in (inside / 'link', inside / 'folder' / 'link'):
        link.symlink_to(secret)
    os.mkfifo(inside / 'fifo')
    (inside / 'graph.yaml').write_text(f'{HEAD}include: [{name}]\n')
    with pytest.raises(msg_graph.GraphError) as caught:
        msg_graph.load(inside / 'graph.yaml')
    assert caught.value.file == str(inside / 'graph.yaml') and says in str(caught.value)
    assert 'the secret' not in str(caught.value) and 'root:' not in str(caught.value)


@pytest.mark.parametrize('text', [
    '[' * 200_000, '{"d": ' * 100_000, f'{{"d": {{"/n:x": 1{"0" * 5000}}}}}', 'NaN', '1e999', '',
    '{"control": {"/x:y": "\\u001b[2J"}}', '\ud800'.encode('utf-8', 'replace').decode()],
    ids=range(8))  # pytest 7 would hand the whole text on in the environment
def test_harmful_tables_of_execution_times(call, tmp_path, text):
    refused(call('simulate', AUTOWARE, '--execution-times', '-', stdin=text), tmp_path)


class Owner:
    """Does something when it is unpickled."""

    def __reduce__(self):
        return os.system, ('touch owned',)


@pytest.mark.parametrize('key', ['/n:t', 'control', None])
def test_samples_are_no_pickles(call, tmp_path, key):
    (tmp_path / 'graph.yaml').write_text(
        HEAD + 'nodes: [{node: /n, callbacks: [{name: t, timer: 1ms, deadline: 1ms}]}]\n')
    np.savez(tmp_path / 'samples.npz', **{str(key): np.array([Owner()], dtype=object)})
    if key is None:
        (tmp_path / 'samples.npz').write_bytes(b'\x80\x04cos\nsystem\n(S"touch owned"\ntR.')
    refused(call('evaluate', 'graph.yaml', '--runs', '2', '--execution-times', 'samples.npz',
                 cwd=tmp_path), tmp_path)
