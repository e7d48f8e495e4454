# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The benchmark `replay --slack`: whether the slack that was found holds in live runs.

Theory of operation
-------------------
The slack of a declaration with fixed execution times is found as by `mddag slack GRAPH`.  Then,
for some callbacks, two live runs follow: with slightly less than the factor (``HOLDS``) no
deadline may be missed, with slightly more (``BREAKS``) some deadline must be missed.

The slack assumes declared execution times and punctual timers.  A live run has neither:
``explain`` reports for each late job how long callbacks ran beyond the declared time, how late the
release was noticed, and how long the machine stalled.  A job that would not have been late without
these (``DISTURBED``) is ignored, at either share.  Waiting for a worker or for the GIL counts.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
import os
from pathlib import Path
from typing import Any

from mddag_executor.cli.text import Progress, table
from mddag_executor.core import Tables
from mddag_executor.defaults import processors
from mddag_executor.errors import MddagError
from mddag_executor.report.tables import short_names
from msg_graph import TaskSet
from msg_graph.edit import callbacks_of

HOLDS, BREAKS = 0.9, 1.1
LEAST, MOST = 1.2, 30.0
"""Range of tried factors: less is within the variation of live runs, more takes too long."""
DISTURBED = frozenset(('ran long', 'released late', 'machine'))
WARM_UP_NS = 1_000_000_000

Record = Callable[[str, str], None]
"""Records a live run of a declaration to a trace."""


def check_slack(
    args: argparse.Namespace, task_set: TaskSet, folder: str, record: Record
) -> dict[str, Any]:
    """Return the result of `replay --slack`."""
    from mddag_executor.simulate import draw_execution_times, periodic_workload, Settings
    from mddag_executor.whatif.slack import find_slack, NOTHING, Problem
    from msg_graph import loads
    times = _times(task_set, args.utilisation[0], args.workers[0])
    fixed = loads(with_times(task_set, times), task_set.file)
    settings = Settings(pools=(args.workers[0],))
    load = periodic_workload(fixed, draw_execution_times(fixed, 0), settings.duration_ns)
    with Progress('recording', 2 * args.callbacks) as line:
        slack = find_slack(Problem(
            load, settings, Tables.build(fixed), fixed.places_of_vertices()), jobs=processors())
        found = sorted((one.factor, task_set.callbacks[i].key, one.breaks)
                       for i, one in slack.factors.items()
                       if i >= 0 and one.factor is not None and LEAST <= one.factor <= MOST)
        if not found:
            raise MddagError(
                '--slack: no callback has a factor that can be tried: give another '
                '--utilisation')
        step = max(1, len(found) // args.callbacks)
        rows: list[dict[str, Any]] = []
        for factor, key, breaks in found[::step][:args.callbacks]:
            assert breaks != NOTHING
            missed: list[tuple[int, int]] = []
            for share in (HOLDS, BREAKS):
                line.update(2 * len(rows) + len(missed), key)
                longer = {**times, key: round(times[key] * factor * share)}
                missed.append(_misses(_run(task_set, longer, folder, record)))
            rows.append({
                'callback': key, 'factor': factor, 'breaks': task_set.vertices[breaks].name,
                'missed_below': missed[0][0], 'missed_above': missed[1][0],
                'disturbed_below': missed[0][1], 'disturbed_above': missed[1][1],
                'as_predicted': missed[0][0] == 0 and missed[1][0] > 0})
    return {'seconds': args.seconds, 'utilisation': args.utilisation[0], 'callbacks': rows,
            'as_predicted': sum(row['as_predicted'] for row in rows)}


def _times(task_set: TaskSet, utilisation: float, workers: int) -> dict[str, int]:
    """Return by callback the execution time that a synthetic run would draw, ns."""
    from mddag_executor.simulate import draw_execution_times, scale_execution_times
    drawn = scale_execution_times(
        task_set, draw_execution_times(task_set, 0), workers, utilisation)
    return {vertex.callback.key: drawn[vertex.dag][vertex.index] for vertex in task_set.vertices}


def _run(task_set: TaskSet, times: dict[str, int], folder: str, record: Record) -> str:
    """Run a declaration with fixed execution times; return its trace."""
    graph, trace = (os.path.join(folder, f'slack.{form}') for form in ('yaml', 'mcap'))
    Path(graph).write_text(with_times(task_set, times), encoding='utf-8')
    record(graph, trace)
    return trace


def with_times(task_set: TaskSet, times: dict[str, int]) -> str:
    """Return a declaration with fixed execution times, ns, by callback."""
    import yaml
    text = 'tag:yaml.org,2002:str'
    # As nodes, not as values: a name such as on or 0x10 is not changed.
    declaration = yaml.compose(task_set.text, yaml.SafeLoader)
    for key, callback, _ in callbacks_of(declaration):
        if key in times:
            callback.value = [each for each in callback.value
                              if each[0].value != 'execution_time']
            callback.value.append((yaml.ScalarNode(text, 'execution_time'),
                                   yaml.ScalarNode(text, f'{times[key]}ns')))
    return str(yaml.serialize(declaration, Dumper=yaml.SafeDumper))


def _misses(trace: str) -> tuple[int, int]:
    """Return the number of missed deadlines, and of additional ones through disturbances."""
    from mddag_executor import replay
    jobs = replay(trace, skip=WARM_UP_NS).explanation.result()['jobs']
    count = [is_counted(job) for job in jobs]
    return sum(count), len(count) - sum(count)


def is_counted(job: Mapping[str, Any]) -> bool:
    """Return whether a job would have missed its deadline without disturbances."""
    disturbed = sum(part['ns'] for part in job['parts'] if part['cause'] in DISTURBED)
    return job['late_ns'] is None or bool(job['late_ns'] > disturbed)


def show(result: dict[str, Any]) -> None:
    """Print the result."""
    short = short_names([row['callback'] for row in result['callbacks']])
    print(table(('callback', 'may take', f'missed at {HOLDS:g} of it', 'disturbed',
                 f'missed at {BREAKS:g}', 'disturbed', 'as predicted'), [
        [short[row['callback']], f'{row["factor"]:.2f} times', row['missed_below'],
         row['disturbed_below'], row['missed_above'], row['disturbed_above'],
         'yes' if row['as_predicted'] else 'no'] for row in result['callbacks']]))
    print(f'{result["as_predicted"]} of {len(result["callbacks"])} callbacks behave as predicted')
