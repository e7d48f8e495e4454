# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Random systems with a path over several DAGs, and their simulation."""

from mddag_executor.simulate import draw_execution_times, periodic_workload, Settings, simulate
from mddag_executor.whatif.computed import ComputedRun

from ..sources.helpers import MS


def random_system(chance):
    """Return a declaration: chains of callbacks, each of which reads what the one before wrote."""
    lines, callbacks = ['mddag: 1', f'workers: {chance.randint(1, 3)}', 'nodes:'], []
    reads = ''
    for segment in range(chance.randint(1, 3)):
        period = chance.choice((10, 20, 33, 50))
        length = chance.randint(1, 3)
        for place in range(length):
            start = f'timer: {period}ms' if not place else f'subscription: /s{segment}t{place}'
            ends = place == length - 1
            deadline = max(1, int(period * chance.uniform(0.3, 1.5)))
            end = f'deadline: {deadline}ms' if ends else f'publishes: [/s{segment}t{place + 1}]'
            if ends and chance.random() < 0.5:
                end += f', publishes: [/s{segment}out]'
            cost = chance.randint(50, 2000)
            lines.append(
                f'  - {{node: /s{segment}n{place}, callbacks: [{{name: cb, {start}, group: g, '
                f'{end}{reads if not place else ""}, execution_time: {cost}us}}]}}')
            callbacks.append(f"'/s{segment}n{place}:cb'")
            if ends and 'publishes' not in end:
                return '\n'.join([*lines, *path_of(callbacks)])
        reads = f', reads: [/s{segment}out]'
    return '\n'.join([*lines, *path_of(callbacks)])


def path_of(callbacks):
    if len(callbacks) < 2:
        return []
    return ['paths:', f'  - {{name: p, callbacks: [{", ".join(callbacks)}], reaction: 40ms, '
            'age: 30ms}']


def simulated_run(task_set):
    settings = Settings(pools=(task_set.workers,), duration_ns=600 * MS)
    load = periodic_workload(task_set, draw_execution_times(task_set, 0), settings.duration_ns)
    run = simulate(task_set, load, settings, log=True)
    return run.result(), ComputedRun.of_run(task_set, load, run)
