# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
How much memory a process has in use, and how much the middleware keeps of nodes made again.

Theory of operation
-------------------
glibc keeps what was freed, for each thread apart: a spin that begins again after an exception has
new threads, and leaves a megabyte or two behind that are not used.  So ``in_use`` collects
garbage and gives free memory back to the system (``malloc_trim``) before it looks.

rclpy and the middleware keep something of each node that is destroyed and made again.  A process
of its own (this module, run) tells how much: the same nodes, made again without any executor.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import os
from pathlib import Path
import random
import subprocess
import sys
import time

from mddag_executor.hosting.measure import ExecutionPlan
from msg_graph import load
import rclpy
from rclpy.utilities import try_shutdown
from soak_nodes import SoakNodes

WARM_UP_REMADE = 100
TIMEOUT_S = 120.0


def resident() -> int:
    """Return the memory that the process occupies, bytes."""
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE')


def in_use() -> int:
    """Collect garbage, give free memory back, and return what the process still occupies."""
    gc.collect()
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except AttributeError:
        pass  # another C library
    return resident()


def kept_by_middleware(graph: str, remade: int) -> float:
    """
    Return how many bytes remain of each node made again, without an executor.

    :param graph: the declaration.
    :param remade: how many nodes to make again.
    """
    done = subprocess.run(
        [sys.executable, __file__, graph, str(remade)],
        capture_output=True, text=True, timeout=TIMEOUT_S + remade, check=True)
    return float(done.stdout)


def measure(graph: str, remade: int, seed: int = 0) -> float:
    """Make nodes again, in this process; return the bytes that remain of each."""
    task_set = load(graph)
    nodes = SoakNodes(task_set, ExecutionPlan(task_set))
    names = list(nodes.nodes)
    chosen = random.Random(seed)

    def make_again(times):
        for _ in range(times):
            name = chosen.choice(names)
            nodes.nodes[name].destroy_node()
            nodes.make_again(name)
        time.sleep(1.0)  # for the middleware's threads
        return in_use()

    before = make_again(WARM_UP_REMADE)
    after = make_again(remade)
    nodes.workload.destroy()
    return (after - before) / remade


def main(arguments: list[str] | None = None) -> int:
    """Measure, and print the bytes that remain of each node."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument('graph', help='the declaration')
    parser.add_argument('remade', type=int, help='how many nodes to make again')
    args = parser.parse_args(arguments)
    rclpy.init(args=[])
    try:
        print(measure(args.graph, args.remade))
    finally:
        try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
