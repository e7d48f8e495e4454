# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Endurance: a declared workload under one executor for as long as it takes, with random faults.

    python test/endurance/soak.py config/autoware.yaml --seconds 600

Theory of operation
-------------------
The nodes are synthetic ones, each destroyed and made again by itself.  After a warm-up there is
one fault after the other, chosen at random, and after each of them a second to recover, time to
work off the backlog (at most ``BACKLOG_S``), and a *clean* window:

* ``destroy``: a node is destroyed while its callbacks run, and made again;
* ``raise``: a callback raises, which ends ``spin``; it is called again;
* ``stop``: a source stops for a second;
* ``burst``: a source releases ten times as often for a second;
* ``clock``: the simulated time, which an additional node follows, jumps back and forth.

At the end these have to hold: memory in use within 5 % of what it was after the warm-up; as many
threads and file handles; every execution that became ready ran, was dropped, or is one of those
that wait; every job ended or is open; and no deadline is missed by a job that was released in a
clean window.
It does not judge sinks whose critical path in this draw leaves less than ``LEAST_SLACK`` of the
deadline for waits (``unjudged_sinks`` in the result: no policy keeps these), and windows in which
the machine stood still: another process, which only sleeps, was woken more than ``STALL_S`` late,
or the host of a virtual machine took ``STOLEN_S`` or more from its CPUs (*steal* in
``/proc/stat``).  With ``--trace``, ``clean_causes`` in the result counts what ``mddag explain``
says of the misses in clean windows, and one by the *machine* is not a failure.
"""

import argparse
from collections import Counter, deque
from contextlib import suppress
import ctypes
import gc
import json
import os
from pathlib import Path
import random
import subprocess
import sys
import tempfile
import threading
import time

from mddag_executor.executor import current_job
from mddag_executor.executor.executor import MultiDeadlineExecutor
from mddag_executor.executor.quiet_nodes import quiet_node
from mddag_executor.synthetic.measure import ExecutionPlan
from mddag_executor.synthetic.workload import SyntheticWorkload
from msg_graph import load
from msg_graph.model import path_lengths
import rclpy
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException
from rclpy.utilities import try_shutdown
from rosgraph_msgs.msg import Clock as ClockMessage

FAULTS = ('destroy', 'raise', 'stop', 'burst', 'clock')
FAULT_S, RECOVERY_S, BACKLOG_S, CLEAN_S = 1.0, 1.0, 5.0, 1.5
BURST = 10
DRAIN_S = 3.0
MEMORY_RATIO = 0.05
MATCH_S = 30.0
MOST_LISTED = 50
STALL_S, STOLEN_S = 0.01, 0.02
LEAST_SLACK = 0.1

_SLEEPER = f"""
import os, time
def stolen():
    with open('/proc/stat') as file:
        return int(file.readline().split()[8]) / os.sysconf('SC_CLK_TCK')
last = stolen()
while True:
    for _ in range(50):
        before = time.monotonic()
        time.sleep(0.002)
        if time.monotonic() - before > 0.002 + {STALL_S}:
            print(time.time_ns(), 'late', flush=True)
    now = stolen()
    if now > last:
        print(time.time_ns(), now - last, flush=True)
    last = now
"""


class MachineWatch:
    """Notes when a process that only sleeps was woken late, and what the host took away."""

    def __init__(self):
        self._file = tempfile.TemporaryFile('w+')
        self._process = subprocess.Popen([sys.executable, '-c', _SLEEPER], stdout=self._file)

    def stop(self):
        """End it; return when it was woken late, ns, and (when, ns; seconds stolen)."""
        self._process.kill()
        self._process.wait()
        with self._file as file:
            file.seek(0)
            noted = [(int(when), what) for when, what in map(str.split, file)]
        return ([when for when, what in noted if what == 'late'],
                [(when, float(what)) for when, what in noted if what != 'late'])


class SoakFault(Exception):
    """What a callback raises on purpose."""


class SoakNodes:
    """The synthetic nodes of a declaration; each can be destroyed and made again."""

    def __init__(self, task_set, plan):
        self.workload = SyntheticWorkload(task_set, plan, current_job=current_job)
        self.started = 0  # callbacks
        self.raise_next = False  # lets the next one raise
        self._lock = threading.Lock()
        self.nodes = {node.get_fully_qualified_name(): node for node in self.workload.nodes}
        for node in self.workload.nodes:
            self._watch(node)

    def make_again(self, name):
        """Make a node that was destroyed, and start its timers."""
        node = self.nodes[name] = self.workload.make(name)
        self._watch(node)
        for dag, timer in self.workload.timers.items():
            if timer in node.timers:
                self.workload.start_timer(dag)
        return node

    def _watch(self, node):
        for entity in (*node.timers, *node.subscriptions):
            entity.callback = self._watched(entity.callback)

    def _watched(self, callback):
        def timer():
            run()

        def subscription(message):
            run(message)

        def run(*message):
            with self._lock:
                self.started += 1
                raises, self.raise_next = self.raise_next, False
            if raises:
                raise SoakFault('on purpose')
            with suppress(InvalidHandle):  # the node was destroyed meanwhile
                callback(*message)

        return timer if callback.__code__.co_argcount == 0 else subscription


class SimulatedTime:
    """A node with a timer that follows simulated time, and a thread that publishes that."""

    def __init__(self):
        self.node = quiet_node('/soak_simulated', use_sim_time=True)
        self._sender = quiet_node('/soak_clock')
        self._publisher = self._sender.create_publisher(ClockMessage, '/clock', 10)
        self.ticks = 0
        self.node.create_timer(0.1, self._tick)
        self._now_ns = 1_000_000_000_000
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name='soak-clock')
        self._thread.start()

    def _tick(self):
        self.ticks += 1

    def _run(self):
        while not self._ending.wait(0.02):
            self._now_ns += 20_000_000
            message = ClockMessage()
            message.clock.sec, message.clock.nanosec = divmod(self._now_ns, 1_000_000_000)
            self._publisher.publish(message)

    def jump(self, nanoseconds):
        self._now_ns = max(1_000_000_000, self._now_ns + nanoseconds)

    def stop(self):
        self._ending.set()
        self._thread.join()
        self._sender.destroy_node()
        self.node.destroy_node()


def usage():
    """
    Return the process' memory (bytes), threads and file handles.

    glibc keeps what was freed, for each thread separately.  A spin that begins again after an
    exception has new threads.  So garbage and free memory go back to the system first.
    """
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return {
        'memory': pages * os.sysconf('SC_PAGE_SIZE'),
        'threads': len(os.listdir('/proc/self/task')), 'handles': len(os.listdir('/proc/self/fd'))}


def unjudged_sinks(plan):
    """Return the sinks whose critical path leaves too little of their deadline for waits."""
    found = []
    for dag in plan.task_set.dags:
        paths = path_lengths(dag, [plan.execution_ns(vertex) for vertex in dag.vertices])
        found += [sink.name for sink in map(dag.vertices.__getitem__, dag.sinks)
                  if paths[sink.index] > (1 - LEAST_SLACK) * sink.deadline_ns]
    return sorted(found)


class Soak:
    """One endurance run; ``say`` receives what happens, one line each."""

    def __init__(self, task_set, seconds, utilisation, workers, seed, say, trace=None):
        self._seconds = seconds
        self._say = say
        self._random = random.Random(seed)
        plan = ExecutionPlan(task_set, seed, utilisation, workers, 'sleep')
        self._unjudged = unjudged_sinks(plan)
        self._missed = deque()
        self._clean_missed = []  # fault, release and vertex: there may be thousands
        self._settle_s = min(2.0, max(v.deadline_ns or 0 for v in task_set.vertices) / 1e9)
        self._trace = trace
        self.executor = MultiDeadlineExecutor(
            task_set, num_workers=workers, trace=trace, on_deadline_miss=self._on_miss)
        self.nodes = SoakNodes(task_set, plan)
        self._simulated = SimulatedTime()
        self._machine = MachineWatch()
        self.counts = dict.fromkeys((*FAULTS, 'raised'), 0)
        self._errors = []
        self._clean = []  # start, end, and the fault before
        self._ending = False
        self._thread = threading.Thread(target=self._spin, name='soak-spin', daemon=True)

    def _on_miss(self, miss):
        if miss.vertex not in self._unjudged:
            self._missed.append(miss)

    def _sort_out(self):
        """Keep of the misses only those in clean windows."""
        while self._missed:  # others append meanwhile
            miss = self._missed.popleft()
            self._clean_missed += [
                (fault, miss.release_ns, miss.vertex) for start, end, fault in self._clean
                if start <= miss.release_ns < end]

    def _spin(self):
        while not self._ending:
            try:
                self.executor.spin()
            except SoakFault:
                self.counts['raised'] += 1
            except ExternalShutdownException:
                return
            except BaseException as error:
                self._errors.append(f'{type(error).__name__}: {error}')
                if len(self._errors) > 100:
                    return

    def run(self):
        """Run, and return the result; its ``failed`` has what should not be, one line each."""
        for node in (*self.nodes.nodes.values(), self._simulated.node):
            self.executor.add_node(node)
        self._thread.start()
        end = time.monotonic() + MATCH_S
        while self.nodes.workload.unmatched() and time.monotonic() < end:
            time.sleep(0.05)
        self.nodes.workload.start(self.executor.wake)
        begin = time.monotonic()
        warm_up = min(60.0, self._seconds / 3)
        time.sleep(warm_up)
        self._misuse_once()
        before = usage()
        self._say(f'warm after {warm_up:.0f} s: {before}')
        slot = FAULT_S + RECOVERY_S + CLEAN_S + self._settle_s
        while time.monotonic() - begin + slot <= self._seconds:
            self._one_fault()
        after = usage()
        return self._end(before, after, time.monotonic() - begin)

    def _misuse_once(self):
        """
        Inject each fault once before the first measurement: the memory that it needs is kept.

        Bursts of all sources at once: each DAG keeps room for as many jobs as were ever open.
        """
        for fault in FAULTS:
            if fault != 'burst':
                getattr(self, f'_{fault}')(0.1)
        time.sleep(RECOVERY_S)  # a new timer is known by its period: that is not altered yet
        self._burst(FAULT_S, list(self.nodes.workload.timers.values()))
        time.sleep(RECOVERY_S)

    def _one_fault(self):
        fault = self._random.choice(FAULTS)
        self.counts[fault] += 1
        getattr(self, f'_{fault}')(FAULT_S)
        time.sleep(RECOVERY_S)
        end = time.monotonic() + BACKLOG_S
        while self._has_backlog() and time.monotonic() < end:
            time.sleep(0.05)
        start = time.time_ns()
        time.sleep(CLEAN_S)
        self._clean.append((start, time.time_ns(), fault))
        time.sleep(self._settle_s)  # the last jobs end before the next fault
        self._sort_out()
        self._say(f'{fault}: {len(self._clean_missed)} misses in clean windows up to now')

    def _has_backlog(self):
        callbacks = self.executor.statistics()['callbacks'].values()
        return any(counts['waiting'] > 1 for counts in callbacks)

    def _destroy(self, seconds):
        name = self._random.choice(list(self.nodes.nodes))
        self.nodes.nodes[name].destroy_node()
        self.executor.remove_node(self.nodes.nodes[name])
        time.sleep(seconds / 4)
        self.executor.add_node(self.nodes.make_again(name))
        time.sleep(seconds * 3 / 4)

    def _raise(self, seconds):
        self.nodes.raise_next = True
        time.sleep(seconds)

    def _stop(self, seconds):
        timer = self._random.choice(list(self.nodes.workload.timers.values()))
        timer.cancel()
        time.sleep(seconds)
        timer.reset()
        self.executor.wake()

    def _burst(self, seconds, timers=None):
        timers = timers or [self._random.choice(list(self.nodes.workload.timers.values()))]
        periods = [timer.timer_period_ns for timer in timers]
        for timer, period in zip(timers, periods):
            timer.timer_period_ns = max(1_000_000, period // BURST)
            timer.reset()
        time.sleep(seconds)
        for timer, period in zip(timers, periods):
            timer.timer_period_ns = period
            timer.reset()

    def _clock(self, seconds):
        for _ in range(4):
            self._simulated.jump(self._random.choice((-1, 1)) * self._random.randrange(10 ** 11))
            time.sleep(seconds / 4)

    def _end(self, before, after, elapsed):
        ticks = self._simulated.ticks
        time.sleep(2.0)
        simulated_goes_on = self._simulated.ticks > ticks
        for timer in self.nodes.workload.timers.values():
            timer.cancel()
        time.sleep(DRAIN_S)
        self._ending = True
        ended = self.executor.shutdown(10.0)
        self._thread.join(10.0)
        statistics = self.executor.statistics()
        n_open = list(self.executor._engine.scheduler.state.n_open)
        self._simulated.stop()
        self.nodes.workload.destroy()
        stalls, stolen = self._machine.stop()

        def disturbed(start, stop):
            # the last jobs of a window run on beyond it, and may wait for work from before
            start, stop = start - 500_000_000, stop + 200_000_000
            return any(start <= stall < stop for stall in stalls) or sum(
                seconds for when, seconds in stolen if start <= when < stop) >= STOLEN_S

        judged = [(start, stop) for start, stop, _ in self._clean if not disturbed(start, stop)]
        self._sort_out()
        clean_misses = [
            {'after': fault, 'release_ns': release, 'vertex': vertex}
            for fault, release, vertex in self._clean_missed
            if any(start <= release < stop for start, stop in judged)]
        result = {
            'seconds': elapsed, 'faults': self.counts, 'before': before, 'after': after,
            'jobs': sum(d['jobs'] for d in statistics['dags'].values()),
            **{key: sum(counts[key] for counts in statistics['callbacks'].values())
               for key in ('ready', 'ran', 'dropped', 'skipped', 'unattributed')},
            'clean_windows': len(self._clean),
            'disturbed_windows': len(self._clean) - len(judged),
            'stalls': len(stalls), 'stolen_s': sum(seconds for _, seconds in stolen),
            'clean_misses': len(clean_misses), **self._explained(clean_misses),
            'clean_missed': clean_misses[:MOST_LISTED],
            'unjudged_sinks': self._unjudged, 'simulated_ticks': ticks}
        result['failed'] = [*self._failures(result, statistics, n_open), *self._errors]
        if not simulated_goes_on:
            result['failed'].append('the timer on simulated time has stopped')
        if not ended or self._thread.is_alive():
            result['failed'].append('the executor did not end')
        return result

    def _explained(self, misses):
        """Give each of the misses its cause, as the recording shows it; count the causes."""
        if not self._trace:
            return {}
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / 'causes.json'
            subprocess.run(
                [sys.executable, '-m', 'mddag_executor', 'explain', self._trace, '-q', '--json',
                 path], check=False, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
            causes = {(job['sink'], job['release_ns']): job['cause']
                      for job in json.loads(path.read_text())['jobs']}
        for miss in misses:
            miss['cause'] = causes.get((miss['vertex'], miss['release_ns']), 'not recorded')
        return {'clean_causes': Counter(miss['cause'] for miss in misses)}

    def _failures(self, result, statistics, n_open):
        before, after = result['before'], result['after']
        failed = []
        growth = result['memory_growth'] = after['memory'] / before['memory'] - 1
        if growth > MEMORY_RATIO:
            failed.append(f'memory grew by {growth:.1%}')
        for what in ('threads', 'handles'):
            if after[what] > before[what]:
                failed.append(f'{what}: {before[what]} before, {after[what]} after')
        for name, counts in statistics['callbacks'].items():
            left = counts['ready'] - counts['ran'] - counts['dropped'] - counts['waiting']
            if left:
                failed.append(f'{name}: {left} executions are unaccounted for')
        declared = sum(c['ran'] for c in statistics['callbacks'].values() if c['declared'])
        if declared != self.nodes.started:
            failed.append(f'{declared} executions counted, {self.nodes.started} callbacks ran')
        for (name, dag), still_open in zip(statistics['dags'].items(), n_open):
            if dag['jobs'] != sum(dag['ends'].values()) + still_open:
                failed.append(f'{name}: {dag["jobs"]} jobs, {dag["ends"]}, {still_open} open')
        by_the_machine = result.get('clean_causes', {}).get('machine', 0)
        if result['clean_misses'] > by_the_machine:
            sinks = sorted({miss['vertex'] for miss in result['clean_missed']})
            failed.append(
                f'{result["clean_misses"] - by_the_machine} deadlines missed in clean windows, '
                f'more than {RECOVERY_S:g} s after the fault: {", ".join(sinks[:5])}')
        return failed


def main():
    """Run from the command line; return 1 when something does not hold."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[1])
    parser.add_argument('graph', help='the declaration')
    parser.add_argument('--seconds', type=float, default=600.0)
    parser.add_argument('--utilisation', type=float, default=0.8)
    parser.add_argument('--workers', type=int, default=7)
    parser.add_argument('--seed', type=int, default=2)
    parser.add_argument(
        '--trace', help='record the run to this file; say why deadlines were missed')
    args = parser.parse_args()
    rclpy.init(args=[])
    try:
        result = Soak(
            load(args.graph), args.seconds, args.utilisation, args.workers, args.seed,
            lambda text: print(text, file=sys.stderr, flush=True), args.trace).run()
    finally:
        try_shutdown()
    print(json.dumps(result, indent=1))
    return 1 if result['failed'] else 0


if __name__ == '__main__':
    sys.exit(main())
