# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Evaluations go on from what is kept, and only from what answers the same question."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
import tempfile
from typing import BinaryIO

from hypothesis import given, settings
import hypothesis.strategies as st
from mddag_executor.errors import InputError
from mddag_executor.simulate import evaluate as module
from mddag_executor.simulate.checkpoint import Checkpoint
from mddag_executor.simulate.evaluate import evaluate, Evaluation, Experiment
from msg_graph import load, loads
import numpy as np
import pytest

from .test_evaluate import same

GRAPH = """\
mddag: 1
workers: 1
nodes:
  - node: /n
    callbacks:
      - {name: fast, timer: 10ms, dag: fast, deadline: 10ms, execution_time: 2500us}
      - name: slow
        timer: 20ms
        dag: slow
        deadline: 20ms
        execution_time: {quantiles_us: [9000, 20000]}
"""
BASE = Experiment(
    loads(GRAPH), ('rad', 'rm'), workers=1, duration_ns=100_000_000, seed=2, judge='horizon')
OTHER = replace(BASE, task_set=loads(GRAPH.replace('9000', '7000')))
RUNS = 40
WHOLE = evaluate(BASE, RUNS, core='plain')


def checkpoint(path: Path) -> Checkpoint:
    @contextmanager
    def output() -> Iterator[BinaryIO]:
        with path.open('wb') as file:
            yield file

    return Checkpoint(str(path), output)


def part(whole: Evaluation, done: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Evaluation:
    """Return an evaluation of which just these runs were done."""
    some = Evaluation(whole.experiments, whole.runs_each)
    some.done[:] = done
    some.utilisation[done] = whole.utilisation[done]
    some.possible[done] = whole.possible[done]
    some.accepted[:, done] = whole.accepted[:, done]
    return some


def test_the_runs_are_worth_it() -> None:
    assert 0 < WHOLE.accepted.mean() < 1 and 0 < WHOLE.possible.mean() < 1


@settings(max_examples=30)
@given(done=st.lists(st.booleans(), min_size=RUNS, max_size=RUNS))
def test_any_gaps_are_filled(done: list[bool]) -> None:
    """Whichever runs are kept, only the others are done, and the result is the same."""
    with tempfile.TemporaryDirectory() as folder:
        kept = checkpoint(Path(folder, 'kept.npz'))
        kept.save(part(WHOLE, np.array(done)))
        counts: list[int] = []
        outcome = evaluate(BASE, RUNS, core='plain', checkpoint=kept, progress=counts.append)
        assert same(outcome, WHOLE)
        assert outcome.resumed == sum(done)
        assert all(count > sum(done) for count in counts)
        again = evaluate(BASE, RUNS, core='plain', checkpoint=kept)
        assert same(again, WHOLE) and again.resumed == RUNS


def test_interrupted_again_and_again(tmp_path: Path) -> None:
    kept = checkpoint(tmp_path / 'kept.npz')
    sessions, before = 0, 0
    while True:
        def stop(done: int, before: int = before) -> None:
            if done > before + 5:
                raise KeyboardInterrupt

        outcome = evaluate(BASE, RUNS, core='plain', checkpoint=kept, progress=stop)
        assert outcome.resumed == before
        sessions, before = sessions + 1, outcome.runs
        if not outcome.interrupted:
            break
    assert sessions > 1 and same(outcome, WHOLE)


def test_kept_while_it_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that is killed has lost little: what is done is written now and then."""
    monkeypatch.setattr(module, '_KEEP_S', 0.0)
    path = tmp_path / 'kept.npz'
    found = []

    def look(done: int) -> None:
        copy = tmp_path / 'copy.npz'
        copy.write_bytes(path.read_bytes())
        before = Evaluation((BASE,), RUNS)
        checkpoint(copy).restore(before)
        found.append((done, before.runs))

    evaluate(BASE, RUNS, core='plain', checkpoint=checkpoint(path), progress=look)
    assert found and all(done == kept for done, kept in found)


def test_more_runs_than_before(tmp_path: Path) -> None:
    kept = checkpoint(tmp_path / 'kept.npz')
    experiments = (BASE, OTHER)
    evaluate(experiments, 10, core='plain', checkpoint=kept)
    outcome = evaluate(experiments, 25, core='plain', checkpoint=kept)
    assert outcome.resumed == 20 and outcome.runs == 50
    assert same(outcome, evaluate(experiments, 25, core='plain'))
    with pytest.raises(InputError, match='it is for 25 runs, more than 10: give --runs 25 or mor'):
        evaluate(experiments, 10, core='plain', checkpoint=kept)


def test_where_the_graph_stands_does_not_matter(tmp_path: Path) -> None:
    kept = checkpoint(tmp_path / 'kept.npz')
    evaluate(BASE, 5, core='plain', checkpoint=kept)
    moved = replace(BASE, task_set=loads('# a comment\n\n' + GRAPH, 'elsewhere.yaml'))
    assert evaluate(moved, 5, core='plain', checkpoint=kept).resumed == 5


def test_nor_do_the_files_that_it_includes(tmp_path: Path) -> None:
    for name in ('before', 'after'):
        folder = tmp_path / name
        folder.mkdir()
        (folder / 'top.yaml').write_text('mddag: 1\ninclude: [part.yaml]\n')
        (folder / 'part.yaml').write_text(GRAPH)
    kept = checkpoint(tmp_path / 'kept.npz')
    before, after = (replace(BASE, task_set=load(tmp_path / name / 'top.yaml'))
                     for name in ('before', 'after'))
    evaluate(before, 5, core='plain', checkpoint=kept)
    assert evaluate(after, 5, core='plain', checkpoint=kept).resumed == 5


SAMPLES = {'/n:fast': np.array([2_500_000]), '/n:slow': np.array([9_000_000, 20_000_000])}


@pytest.mark.parametrize(('change', 'problem'), [
    ({'task_set': OTHER.task_set}, 'it holds another evaluation: of another graph'),
    ({'task_set': loads(GRAPH + 'processes: {p: [/n]}\n')},
     'it holds another evaluation: of another graph'),
    ({'policies': ('rad', 'fifo')}, 'another evaluation: --policies was ["rad", "rm"], and now '),
    ({'workers': 2}, 'another evaluation: --workers was [1], and now it is [2]: '),
    ({'duration_ns': 10}, 'another evaluation: --duration was 100000000, and now it is 10: '),
    ({'seed': 3}, 'another evaluation: --seed was 2, and now it is 3: name another file, '),
    ({'samples': SAMPLES}, 'it holds another evaluation: with other --samples: '),
    ({'preemptive': False}, '--non-preemptive was false, and now it is true: '),
    ({'overhead_ns': 9}, 'it holds another evaluation: --overhead was 0, and now it is 9: '),
    ({'judge': 'completions'}, '--judge was horizon, and now it is completions: '),
])
def test_another_question(tmp_path: Path, change: dict[str, object], problem: str) -> None:
    path = tmp_path / 'kept.npz'
    evaluate(BASE, 2, core='plain', checkpoint=checkpoint(path))
    before = path.read_bytes()
    with pytest.raises(InputError) as caught:
        evaluate(replace(BASE, **change), 2, core='plain', checkpoint=checkpoint(path))
    assert str(caught.value).startswith(f'{path}: ') and problem in str(caught.value)
    assert path.read_bytes() == before
    with pytest.raises(InputError, match='of 1 graphs, and now there are 2'):
        evaluate((BASE, BASE), 2, core='plain', checkpoint=checkpoint(path))


def test_another_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = checkpoint(tmp_path / 'kept.npz')
    evaluate(BASE, 2, core='plain', checkpoint=kept)
    monkeypatch.setattr('mddag_executor.simulate.checkpoint.__version__', '9.9.9')
    with pytest.raises(InputError, match=r'it was made by mddag .*, and this is 9\.9\.9'):
        evaluate(BASE, 2, core='plain', checkpoint=checkpoint(Path(kept.path)))


def _saved() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        checkpoint(Path(folder, 'k')).save(part(WHOLE, np.arange(RUNS) % 3 > 0))
        return Path(folder, 'k').read_bytes()


SAVED = _saved()


@settings(max_examples=300)
@given(data=st.data())
def test_damage(data: st.DataObject) -> None:
    """It is found, or it did no harm."""
    damaged = bytearray(SAVED)
    if data.draw(st.booleans()):
        del damaged[data.draw(st.integers(0, len(SAVED) - 1)):]
    else:
        for place in data.draw(st.lists(st.integers(0, len(SAVED) - 1), min_size=1, max_size=3)):
            damaged[place] ^= data.draw(st.integers(1, 255))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'kept.npz')
        path.write_bytes(damaged)
        outcome = Evaluation((BASE,), RUNS)
        try:
            checkpoint(path).restore(outcome)
        except InputError as error:
            assert str(error) == (
                f'{path}: it is damaged, or no file of kept runs: remove it, or name another file')
        else:
            assert same(outcome, part(WHOLE, np.arange(RUNS) % 3 > 0))


@pytest.mark.parametrize('content', [
    b'', b'junk', b'{}', b'PK\x05\x06' + b'\0' * 18])
def test_no_checkpoint(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / 'kept.npz'
    path.write_bytes(content)
    with pytest.raises(InputError, match='it is damaged, or no file of kept runs'):
        evaluate(BASE, 2, core='plain', checkpoint=checkpoint(path))


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(IsADirectoryError):
        evaluate(BASE, 2, core='plain', checkpoint=checkpoint(tmp_path))


def test_encrypted_as_it_seems(tmp_path: Path) -> None:
    damaged = bytearray(SAVED)
    for signature, place in ((b'PK\x03\x04', 6), (b'PK\x01\x02', 8)):
        damaged[SAVED.index(signature) + place] |= 1
    path = tmp_path / 'kept.npz'
    path.write_bytes(damaged)
    with pytest.raises(InputError, match='it is damaged, or no file of kept runs'):
        evaluate(BASE, 2, core='plain', checkpoint=checkpoint(path))


def test_other_archives(tmp_path: Path) -> None:
    path = tmp_path / 'kept.npz'
    text = np.frombuffer(b'{"format": "mddag evaluation 1", "question": 3}', dtype=np.uint8)
    for arrays in ({'a': np.zeros(3)}, {'question': np.zeros(3)}, {'question': text}):
        np.savez(path, **arrays)
        with pytest.raises(InputError, match='it is damaged, or no file of kept runs'):
            evaluate(BASE, 2, core='plain', checkpoint=checkpoint(path))
