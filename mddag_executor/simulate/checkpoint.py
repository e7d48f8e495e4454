# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What an evaluation has done so far, in a file from which it goes on.

Theory of operation
-------------------
The file is a .npz archive: the *question* as JSON, and the runs' outcomes.  The question holds all
that the outcome of a run depends on, graphs and measured values as hashes of what they mean; a
file that holds the answer to another one is refused, with the option that differs.  As a run does
not depend on how many there are, a file with fewer runs fits too.  The archive's checksums find
damage.  It is always written as a whole.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
import hashlib
import json
import os
from typing import Any, BinaryIO

from mddag_executor import __version__
from mddag_executor.errors import InputError
from mddag_executor.simulate.draws import Samples
from mddag_executor.simulate.evaluation import Evaluation
from msg_graph import TaskSet
from msg_graph.layout import without_lines
import numpy as np
import numpy.typing as npt

_FORMAT = 'mddag evaluation 1'
_REMEDY = 'name another file, or ask the same as before'
_DAMAGED = 'it is damaged, or no file of kept runs'
_LONGEST_QUESTION = 1 << 26


class Checkpoint:
    """
    A file of kept runs.

    :param path: where it is, or will be.
    :param output: opens it for writing, so that what is written takes its place as a whole.
    """

    def __init__(
        self, path: str, output: Callable[[], AbstractContextManager[BinaryIO]]
    ) -> None:
        self.path = path
        self._output = output
        self._asked: dict[str, Any] | None = None

    def restore(self, outcome: Evaluation) -> None:
        """
        Read what was done before, if there is such a file.

        :raises OSError: it cannot be read.
        """
        if not os.path.exists(self.path):
            return
        try:
            with np.load(self.path, allow_pickle=False) as archive:
                question = json.loads(_bytes(archive, 'question', _LONGEST_QUESTION))
                before = self._fitting(question, outcome)
                self._fill(outcome, archive, before)
        except InputError:
            raise
        except Exception as error:  # noqa: B902 - what reading a damaged archive may raise
            if isinstance(error, OSError) and error.filename is not None:
                raise
            raise InputError(self.path, _DAMAGED, 'remove it, or name another file') from None
        outcome.resumed = outcome.runs

    def _fitting(self, question: dict[str, Any], outcome: Evaluation) -> int:
        """Return how many runs of each experiment a file holds that answers the question."""
        if question['format'] != _FORMAT:
            raise ValueError('another format')
        for key, value in self._question(outcome).items():
            if question['question'][key] != value:
                raise InputError(
                    self.path, f'it holds another evaluation: {_difference(key, question, value)}',
                    _REMEDY)
        runs: int = question['runs']
        if not isinstance(runs, int) or runs < 1:
            raise ValueError('no number of runs')
        if runs > outcome.runs_each:
            raise InputError(
                self.path, f'it is for {runs} runs, more than {outcome.runs_each}',
                f'give --runs {runs} or more, or name another file')
        return runs

    def _question(self, outcome: Evaluation) -> dict[str, Any]:
        if self._asked is None:  # hashing a thousand graphs takes its time
            self._asked = question_of(outcome)
        return self._asked

    def _fill(self, outcome: Evaluation, archive: Any, before: int) -> None:
        n_sets, n_flags = len(outcome.experiments), 2 + len(outcome.accepted)
        total = n_sets * before
        utilisation = archive['utilisation']
        packed = archive['flags']
        if utilisation.dtype != np.float64 or utilisation.shape != (total,) \
                or packed.dtype != np.uint8 or packed.shape != (n_flags, -(-total // 8)):
            raise ValueError('another size')
        flags = np.unpackbits(packed, axis=1, count=total).astype(np.bool_)
        rows = [outcome.utilisation, outcome.done, outcome.possible, *outcome.accepted]
        for row, kept in zip(rows, [utilisation, *flags]):
            # A slice of views, so that it is the outcome's own array that is filled.
            row.reshape(n_sets, -1)[:, :before] = kept.reshape(n_sets, before)

    def save(self, outcome: Evaluation) -> None:
        """
        Keep what is done.

        :raises OSError: it cannot be written.
        """
        question = json.dumps({
            'format': _FORMAT, 'runs': outcome.runs_each, 'question': self._question(outcome)})
        flags = np.packbits(np.vstack([outcome.done, outcome.possible, outcome.accepted]), axis=1)
        with self._output() as file:
            np.savez(
                file, question=np.frombuffer(question.encode(), dtype=np.uint8),
                utilisation=outcome.utilisation, flags=flags)


def _bytes(archive: Any, name: str, longest: int) -> bytes:
    values: npt.NDArray[Any] = archive[name]
    if values.dtype != np.uint8 or values.ndim != 1 or values.size > longest:
        raise ValueError(name)
    return values.tobytes()


def question_of(outcome: Evaluation) -> dict[str, Any]:
    """Return all that the outcome of a run depends on, by the option that gives it."""
    experiment = outcome.experiment
    return {
        'GRAPH': [_digest(each.task_set) for each in outcome.experiments],
        '--policies': list(experiment.policies),
        '--workers': [each.workers for each in outcome.experiments],
        '--duration': experiment.duration_ns, '--seed': experiment.seed,
        '--samples': _digest_of_samples(experiment.samples),
        '--non-preemptive': experiment.preemptive is False,
        '--overhead': experiment.overhead_ns, '--judge': experiment.judge,
        'mddag': __version__}


def _difference(key: str, question: dict[str, Any], now: Any) -> str:
    before = question['question'][key]
    if key == 'GRAPH':
        count = len(before) if isinstance(before, list) else 0
        return 'of another graph' if count == len(now) == 1 else (
            f'of {count} graphs, and now there are {len(now)}' if count != len(now)
            else 'one of the graphs has changed')
    if key == '--samples':
        return 'with other --samples'
    if key == 'mddag':
        return f'it was made by mddag {before}, and this is {now}'
    shown = [json.dumps(value)[:60].strip('"') for value in (before, now)]
    return f'{key} was {shown[0]}, and now it is {shown[1]}'


def _digest(task_set: TaskSet) -> str:
    """Return a hash of what a declaration means for a run, in whichever files it is written."""
    plain = without_lines(task_set)
    text = repr((plain.dags, plain.processes))
    return hashlib.sha256(text.encode()).hexdigest()


def _digest_of_samples(samples: Samples | None) -> str | None:
    if samples is None:
        return None
    digest = hashlib.sha256()
    for key in sorted(samples):
        digest.update(key.encode() + b'\0' + samples[key].astype('<i8').tobytes())
    return digest.hexdigest()
