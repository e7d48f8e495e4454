# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Stands in for nptest of np-schedulability-analysis: same arguments, same files, same answer.

It reads the tables as strictly as nptest does and runs the jobs once, with their largest costs,
in the order that nptest defines (priority, task ID, job ID), without preemption. So it finds some
misses of a job set and proves nothing; for costs that do not vary it is exact.
"""

from __future__ import annotations

import argparse
from heapq import heapify, heappop, heappush
from pathlib import Path
import sys

Id = tuple[int, int]


def rows(path: str, columns: int) -> list[list[int]]:
    """Return the numbers of a table, without its heading."""
    lines = Path(path).read_text().splitlines()[1:]
    table = [[int(field) for field in line.split(',')] for line in lines]
    assert all(len(row) == columns for row in table), path
    return table


def misses(jobs: list[list[int]], edges: list[list[int]], workers: int) -> bool:
    """Run the jobs; tell whether one is late."""
    at = {(task, job): row for row in jobs for task, job in [row[:2]]}
    assert len(at) == len(jobs), 'two jobs have one ID'
    waits: dict[Id, int] = dict.fromkeys(at, 0)
    after: dict[Id, list[Id]] = {}
    for task, job, then, its in edges:
        waits[then, its] += 1
        assert (task, job) in at
        after.setdefault((task, job), []).append((then, its))
    future = [(row[3], key) for key, row in at.items() if waits[key] == 0]
    heapify(future)
    ready: list[tuple[int, int, int]] = []
    running: list[tuple[int, Id]] = []
    left, now = len(at), 0
    while left:
        events = [first[0][0] for first in (future, running) if first]
        if not events:
            return True  # a cycle: nptest calls that unschedulable
        now = max(now, min(events))
        while running and running[0][0] <= now:
            end, key = heappop(running)
            left -= 1
            if end > at[key][6]:
                return True
            for then in after.get(key, ()):
                waits[then] -= 1
                if waits[then] == 0:
                    heappush(future, (max(now, at[then][3]), then))
        while future and future[0][0] <= now:
            _, key = heappop(future)
            heappush(ready, (at[key][7], *key))
        while ready and len(running) < workers:
            _, task, job = heappop(ready)
            heappush(running, (now + at[task, job][5], (task, job)))
    return False


def main() -> None:
    """Answer as nptest does."""
    parser = argparse.ArgumentParser()
    parser.add_argument('-m', type=int, required=True)
    parser.add_argument('-l', type=float, required=True)
    parser.add_argument('-p', required=True)
    parser.add_argument('jobs')
    args = parser.parse_args()
    jobs, edges = rows(args.jobs, 8), rows(args.p, 4)
    for _, _, earliest, latest, least, most, deadline, _ in jobs:
        assert 0 <= earliest <= latest <= deadline
        assert 0 <= least <= most
    late = misses(jobs, edges, args.m)
    timed_out = int(args.l < 2)
    print(f'{args.jobs},  {int(not late and not timed_out)},  {len(jobs)},  {len(jobs) + 1},  '
          f'{len(jobs)},  1,  0.000329,  820.000000,  {timed_out},  {args.m}')


if __name__ == '__main__':
    sys.exit(main())
