# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Text that is no YAML, no declaration, or meant to do harm."""

from msg_graph import GraphError, load, loads, yamltext
import pytest
import yaml

from .helpers import error, MARK

SMALL = """\
mddag: 1
nodes:
  - node: /a
    callbacks:
      - {name: t, timer: 10ms, deadline: 10ms}
"""


@pytest.fixture(params=['CSafeLoader', 'SafeLoader'], autouse=True)
def loader(request, monkeypatch):
    """Run every test with libyaml and without."""
    monkeypatch.setattr(yamltext, '_LOADER', getattr(yaml, request.param))


@pytest.mark.parametrize(('text', 'says'), [
    ('', 'empty'), ('# nothing\n', 'empty'), ('---\n', 'empty'), ('\ufeff', 'empty'),
    (f'hello {MARK}', 'not a declaration'), (f'- a {MARK}\n- b', 'not a declaration'),
    (f"'' {MARK}", 'not a declaration')])
def test_no_declaration(text, says):
    assert says in str(error(text))


@pytest.mark.parametrize('text', [
    'mddag: 1\nnodes: [1', 'mddag: 1\n"nodes', 'mddag: 1\nnodes:\n\t- a', 'mddag: 1\na: b: c',
    '%YAML 7.0\n---\nmddag: 1'])
def test_not_yaml(text):
    with pytest.raises(GraphError, match='not YAML') as caught:
        loads(text, 'g.yaml')
    assert 1 <= caught.value.line <= text.count('\n') + 2


def test_bytes():
    assert len(loads(SMALL.encode()).dags) == 1
    assert len(loads(b'\xef\xbb\xbf' + SMALL.encode()).dags) == 1
    with pytest.raises(GraphError, match=r'g:2: byte 9 is not UTF-8'):
        loads(b'mddag: 1\n\xff', 'g')
    with pytest.raises(GraphError, match='not UTF-8'):
        loads(SMALL.encode('utf-16'))


@pytest.mark.parametrize('text, says', [
    (f'mddag: 1\nmddag: 1 {MARK}\n', "'mddag' is given twice"),
    (f'mddag: 1\nnodes:\n- node: /a\n  node: /b {MARK}\n', 'line 3'),
    (f'mddag: 1\nnodes: !!python/object/apply:os.system [ls] {MARK}\n', 'python'),
    (f'mddag: !!int 1 {MARK}\n', 'tag'),
    (f'mddag: 1\n? [a] {MARK}\n: b\n', 'a key is a list'),
    (f'mddag: 1\nnodes: *none {MARK}\n', "alias 'none' has no anchor"),
    (f'mddag: 1\nnodes: &a [*a] {MARK}\n', 'inside of its own anchor'),
    (f'mddag: 1\n--- {MARK}\nmddag: 1\n', 'second YAML document'),
    (f'mddag: 1\n<<: {{}} {MARK}\n', "unknown key '<<'"),
])
def test_yaml_that_is_refused(text, says):
    assert says in str(error(text))


@pytest.mark.parametrize('opening', ['[', '{a: ', '- ', '- - ? '])
def test_nesting_is_bounded(opening):
    with pytest.raises(GraphError, match='nesting|a key is'):
        loads('mddag: 1\nnodes:\n  ' + opening * 100_000)


def test_aliases_do_not_explode():
    text = 'a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n'
    for i in range(1, 30):
        text += f'a{i}: &a{i} [{", ".join([f"*a{i - 1}"] * 10)}]\n'
    with pytest.raises(GraphError, match=r':7: more than 2000000 entries'):
        loads(text, 'g')


def test_size_is_bounded(tmp_path, monkeypatch):
    big = SMALL + '#' * (16 * 1024 * 1024)
    for given in (big, big.encode()):
        with pytest.raises(GraphError, match='larger than 16 MiB'):
            loads(given)
    path = tmp_path / 'big.yaml'
    path.write_text(big)
    with pytest.raises(GraphError, match='larger than 16 MiB'):
        load(path)
    monkeypatch.setattr(yamltext, 'MAX_SIZE', 40)
    with pytest.raises(GraphError, match='g:1: more than 40 entries'):
        loads(f'[{"a, " * 50}]', 'g')
    assert len(loads(SMALL).dags) == 1


def test_files_that_cannot_be_read(tmp_path):
    for path, problem in ((tmp_path / 'none.yaml', 'no such file or directory: check the path'),
                          (tmp_path, 'the file cannot be read (')):
        with pytest.raises(GraphError) as caught:
            load(path)
        assert str(caught.value).startswith(f'{path}: {problem}')
        assert caught.value.line is None
    with pytest.raises(GraphError, match='cannot be read'):
        load('nul\x00byte')


def test_scalars_are_as_written():
    """Words that YAML 1.1 takes for truth values, dates or numbers are names like any other."""
    tasks = loads("""\
mddag: 1
nodes:
  - node: /on
    callbacks:
      - {name: yes, timer: 10ms, deadline: 10ms, group: 1e3, dag: 2026-01-01}
""")
    assert tasks.callbacks[0].key == '/on:yes'
    assert tasks.callbacks[0].group == '1e3'
    assert tasks.dags[0].name == '2026-01-01'
