# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Run real nodes again from a recording, in virtual time, the same every time.

In a test::

    from mddag_executor.rerun import assert_same, rerun

    def test_tracker(tmp_path):
        result = rerun('drive.mcap', 'graph.yaml', ['my_robot.tracker:main'])
        assert_same(result, 'expected.mcap', tolerance=1e-6)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing, ExitStack
import os
from typing import Any

from mddag_executor.core import policy as find_policy
from mddag_executor.hosting.loading import Program, resolve, ros_arguments
from mddag_executor.output_rules import check_distinct, check_replaced, whole_file
from mddag_executor.rerun.compare import Difference, differences
from mddag_executor.rerun.errors import CallbackFailed, RerunError
from mddag_executor.rerun.inputs import MessageBag, open_input
from mddag_executor.rerun.outputs import Output
from mddag_executor.rerun.run import PATIENCE_S, Rerun, Result
from mddag_executor.trace.trace_file import whole_trace
from msg_graph import load, TaskSet

__all__ = [
    'assert_same', 'CallbackFailed', 'compare', 'Difference', 'Output', 'rerun', 'RerunError',
    'Result']

NodeSpec = str | Callable[[], Any]


def rerun(
    recording: str | os.PathLike[str],
    graph: str | os.PathLike[str] | TaskSet,
    nodes: Sequence[NodeSpec],
    *,
    times: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    cpus: int | None = None,
    policy: str = 'rad',
    seed: int = 0,
    all_clocks: bool = False,
    ros_args: Sequence[str] = (),
    output: str | os.PathLike[str] | None = None,
    trace: str | os.PathLike[str] | None = None,
    patience_s: float = PATIENCE_S,
    overwrite: bool = False,
) -> Result:
    """
    Run nodes from a recording in virtual time.

    rclpy must not be initialised before; nodes that programs make live in a context of this run.

    :param recording: a bag, or a trace of this executor.
    :param graph: the declaration: a file, or a task set.
    :param nodes: as for ``mddag run --node``; or classes of nodes, or functions that return nodes.
    :param times: ``recorded``, ``declared``, or a file (see ``inputs.open_input``).
    :param cpus: that callbacks which compute share; None: as many as are needed.
    :param seed: of Python's ``random``, of numpy's legacy generator and of drawn execution times.
    :param all_clocks: whether steady and system clocks and Python's ``time`` are virtual as well.
    :param output: a file that gets the outputs as a bag; ``trace``: one that gets the run. A run
        that fails leaves no file.
    :param overwrite: whether ``output`` and ``trace`` may replace files that are there.
    :param patience_s: a callback or thread that waits for this long, and not in virtual time, ends
        the run.
    :raises mddag_executor.errors.MddagError: on whatever keeps the run from going on; a
        ``CallbackFailed`` for what a callback raised, which is its cause.
    :raises msg_graph.GraphError: when the declaration is wrong.
    """
    task_set = graph if isinstance(graph, TaskSet) else load(os.fspath(graph))
    find_policy(policy)
    written = [(name, os.fspath(path)) for name, path in (('output', output), ('trace', trace))
               if path is not None]
    given = (('recording', recording), ('graph', graph), ('times', times))
    check_distinct([(name, os.fspath(path)) for name, path in given
                    if isinstance(path, (str, os.PathLike))], written)
    for _, path in written:
        check_replaced(path, is_kept=True, overwrite=overwrite)
    messages, taken = open_input(
        os.fspath(recording), task_set, None if times is None else os.fspath(times), seed)
    with ExitStack() as files:
        bag = None if output is None else files.enter_context(whole_file(os.fspath(output)))
        part = None if trace is None else files.enter_context(
            whole_trace(os.fspath(trace), overwrite))
        run = Rerun(
            messages, taken, task_set, workers=workers, cpus=cpus, policy=policy, seed=seed,
            all_clocks=all_clocks, patience_s=patience_s, ros_args=ros_args,
            output=bag, trace=part)
        return run.run(lambda: programs(nodes, ros_args))


def programs(nodes: Sequence[NodeSpec], ros_args: Sequence[str] = ()) -> list[Program]:
    """Find the programs that bring nodes."""
    return [
        resolve(node, ros_arguments(ros_args)) if isinstance(node, str)
        else Program(getattr(node, '__name__', repr(node)), 'rerun', node) for node in nodes]


def compare(
    result: Result, expected: str | os.PathLike[str], tolerance: float = 0.0
) -> list[Difference]:
    """
    Return how the outputs of a run differ from those in a bag, topic by topic.

    Damage of the bag is added to the warnings of the result.

    :raises mddag_executor.errors.MddagError: when the bag cannot be read.
    """
    with closing(MessageBag(os.fspath(expected))) as recording:
        recording.load(recording.topics)
        result.warnings += [each for each in recording.warnings if each not in result.warnings]
        return differences(
            result.outputs, recording.messages(recording.topics), result.start_ns, tolerance)


def assert_same(
    result: Result, expected: str | os.PathLike[str], tolerance: float = 0.0
) -> None:
    """
    Check that the outputs of a run are those in a bag.

    :raises AssertionError: if they are not; it says where each topic differs first.
    """
    found = compare(result, expected, tolerance)
    if found:
        raise AssertionError('\n'.join(
            [f'the outputs are not those of {os.fspath(expected)}:',
             *(difference.line() for difference in found), *result.warnings]))
