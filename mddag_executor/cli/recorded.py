# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What `replay`, `explain`, `export` and `diff` share: recordings of every kind become runs.

A trace of this executor and an imported recording are replayed as they were recorded, or, with
`replay --reschedule`, as the scheduler core would have run them; an ordinary bag has no jobs, so
it can only be rescheduled: its messages are the releases.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TYPE_CHECKING

from mddag_executor.cli import common, options
from mddag_executor.cli.text import Progress
from mddag_executor.errors import UsageError

if TYPE_CHECKING:
    from mddag_executor.analysis.as_recorded import Replay
    from mddag_executor.sources.open import Given
    from mddag_executor.whatif.reschedule import Reschedule
    from msg_graph import Process, TaskSet

_ONLY_RESCHEDULED = (
    'workers', 'cpus', 'processes', 'policy', 'on_late', 'preemptive', 'overheads',
    'execution_times', 'seed')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `--reschedule` and what belongs to it."""
    parser.add_argument(
        '--reschedule', action='store_true',
        help='run the scheduler over the recorded releases and execution times')
    group = parser.add_argument_group('with --reschedule')
    add = group.add_argument
    options.add(
        group, '--workers', only='in each process, ', otherwise='as recorded',
        type=options.workers_of, metavar='N|PROCESS=N,…')
    options.add(group, '--cpus', otherwise='as recorded, else enough for all')
    add('--processes', metavar='N|FILE', type=options.Input,
        help='run the nodes in N processes, packed by the recorded times, or in those of '
        'a YAML file with `processes:` (default: as recorded)')
    options.add(group, '--policy', otherwise='as recorded')
    options.add(group, '--on-late', otherwise='as recorded; of a bag: continue')
    options.add(group, '--preemptive', otherwise='as recorded, if the policy can')
    add('--overheads', type=_overheads, metavar='WHICH',
        help='the time that noticing, dispatch and transport take: recorded (default; none of a '
        'bag), none, or a time for each dispatch (50us)')
    options.add(group, '--execution-times', '--seed', only='of an ordinary bag: ', default=None)


def _number_of_processes(args: argparse.Namespace) -> int | None:
    """Return the number that `--processes` gives; None: none is given, or a file is."""
    if args.processes is None:
        return None
    from mddag_executor.hosting.run_options import number_of_processes
    return number_of_processes(args.processes)


def _overheads(text: str) -> int | None:
    """Return the overhead of each dispatch in ns, None for that of the recording."""
    if text == 'recorded':
        return None
    return 0 if text == 'none' else options.duration(text)


def check(args: argparse.Namespace) -> None:
    """Check the options that depend on each other."""
    _number_of_processes(args)
    if args.reschedule:
        if args.end is not None:
            raise UsageError('--to: the scheduler runs to the end of a recording: leave it or '
                             '--reschedule out')
        if args.callbacks:
            raise UsageError(
                '--callbacks: it shows what was recorded: leave it or --reschedule out')
        return
    options.reject_options(args, _ONLY_RESCHEDULED,
                   'a run is replayed as it was recorded: add --reschedule')


class Source(NamedTuple):
    """
    A recording of any kind.

    :ivar name: its name for messages.
    :ivar task_set: of GRAPH, if it is given.
    """

    path: Given
    name: str
    task_set: TaskSet | None = None

    @property
    def is_bag(self) -> bool:
        """Return whether it is an ordinary bag, which can only be rescheduled."""
        from mddag_executor.sources.kinds import is_ordinary
        return isinstance(self.path, str) and is_ordinary(self.path)

    def check_deadlines(self) -> None:
        """Check that the recording itself has deadlines."""
        if self.is_bag:
            raise self.no_graph()
        from mddag_executor.sources.open import check_declared
        check_declared(self.path, self.name)

    def no_graph(self) -> UsageError:
        """Return the error about a bag that is not rescheduled, or has no graph."""
        return UsageError(
            f'{self.name}: no run of this executor is recorded in it, so there are no jobs: '
            "'mddag replay BAG GRAPH --reschedule' uses its messages as releases")


def source_of(args: argparse.Namespace) -> Source:
    """Return the recording that TRACE… names, with GRAPH's task set."""
    from mddag_executor.sources.kinds import opened_trace
    task_set = None if args.graph is None else common.load_graph(args.graph)
    path, name = common.input_path(args.trace)
    trace = opened_trace(path) if isinstance(path, str) else None
    return Source(trace or path, name, task_set)


def as_recorded(
    source: Source, doing: str = 'replaying', skip: int = 0, begin: int | None = None,
    end: int | None = None,
) -> Replay:
    """Replay a recorded run, or the part of it from ``begin`` to ``end``."""
    from mddag_executor.analysis.as_recorded import replay
    span = span_of(begin, end)
    if source.is_bag:
        raise source.no_graph()
    with Progress(doing) as line:
        return replay(source.path, source.task_set, name=source.name, progress=line.events,
                      skip=skip, span=span)


def span_of(begin: int | None, end: int | None) -> tuple[int, int] | None:
    """Return the part of the recording that `--from` and `--to` name, None for all of it."""
    if begin is None and end is None:
        return None
    span = begin or 0, end or 2 ** 62
    if span[0] >= span[1]:
        raise UsageError('--to: the part ends before it begins: give a time after --from')
    return span


def outcome_of(args: argparse.Namespace, source: Source) -> Replay | Reschedule:
    """Reschedule a recording if that is wanted or it is a bag; else replay it as recorded."""
    if not args.reschedule and not source.is_bag:
        return as_recorded(source, begin=args.begin, end=args.end)
    changes = {
        'policy': args.policy, 'workers': args.workers, 'preemptive': args.preemptive,
        'on_late': args.on_late, 'cpus': args.cpus}
    skip, name = args.begin or 0, source.name
    if source.is_bag:
        return _rescheduled_bag(args, source, {**changes, 'skip': skip, 'name': name})
    options.reject_options(args, ('execution_times', 'seed'),
                   'a trace has its own execution times: leave the option out')
    from mddag_executor.simulate.policies import ALL_POLICIES
    from mddag_executor.sources.open import open_recording
    from mddag_executor.whatif.agreement import disagreement
    from mddag_executor.whatif.reschedule import Changes, Observed
    unchanged = Changes()
    wanted = Changes(
        overheads=args.overheads is None, dispatch_overhead=args.overheads or 0,
        processes=_processes(args), **changes)
    with Progress('replaying') as line:
        recording = open_recording(source.path, source.task_set, name, line.events)
        policy = recording.run.head.policy
        if policy == args.policy:   # which may be one of the user's own
            unchanged = Changes(policy=policy)
        compares = wanted != unchanged and (
            policy == args.policy or policy in ALL_POLICIES)
        observed = Observed(recording, skip)
        outcome = observed.reschedule(wanted, again=compares)
        text = None
        if compares:
            text = disagreement(observed.reschedule(unchanged))
        elif wanted == unchanged:
            text = disagreement(outcome)
    if text is not None:
        outcome.warnings.append(text)
    return outcome


def _rescheduled_bag(
    args: argparse.Namespace, source: Source, settings: dict[str, Any]
) -> Reschedule:
    from mddag_executor.simulate import read_execution_times
    from mddag_executor.whatif.bags_reschedule import reschedule_bag
    path, task_set = source.path, source.task_set
    assert isinstance(path, str)
    if args.processes is not None:
        raise UsageError('--processes: an ordinary bag does not say which callbacks compute: '
                         'leave the option out')
    if task_set is None or not args.reschedule:
        raise source.no_graph()
    times = None
    if args.execution_times is not None:
        times_name, text = common.read_text(args.execution_times)
        times = read_execution_times(task_set, text, times_name)
    with Progress('replaying'):
        return reschedule_bag(
            path, task_set, times=times, seed=args.seed or 0,
            dispatch_overhead=args.overheads or 0, **settings)


def _processes(
    args: argparse.Namespace
) -> Callable[[TaskSet, list[list[int]]], Sequence[Process]] | None:
    """Return a function that says which node runs in which process, as `--processes` says."""
    from msg_graph.edit import load_processes
    count = _number_of_processes(args)
    if args.processes is None:
        return None
    if count is not None:
        from mddag_executor.laboratory.placement import packed
        return lambda task_set, times: packed(task_set, count, times)
    name, text = common.read_text(args.processes)
    return lambda task_set, times: load_processes(text, name, task_set)
