# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The live writer: many threads, kills, full buffers, full disks."""

from contextlib import closing
import errno
import os
import signal
import subprocess
import sys
import threading
import time

from mddag_executor.trace import TraceError, TraceWriter
from mddag_executor.trace.groups import EXECUTION, PUBLICATION
import pytest

from ..conftest import run_program
from .helpers import mixture, read, read_back, START

FAST = 0.01     # flush interval of tests that need not wait


def wait_for_file(path, size):
    """Wait until the writer thread has written more than some bytes."""
    deadline = time.monotonic() + 10
    while path.stat().st_size <= size:
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_a_live_trace_is_readable(tmp_path):
    path = tmp_path / 'a.mcap'
    recorded = [*mixture(1000), ('ros2:callback_end', 7, 8, 9)]
    expected = read_back(recorded, os.getpid())
    with closing(TraceWriter(path, flush_interval_s=FAST)) as writer:
        for entry in recorded[:-1]:
            writer.record(*entry)
        writer.record('callback_end', 7, 8, 9)      # by its short name
        deadline = time.monotonic() + 10
        while len(read(path)[0]) < len(recorded):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        events, warnings = read(path)
        assert events == expected
        assert len(warnings) == 1 and 'without a finish record' in warnings[0]
    assert read(path) == (expected, [])
    assert writer.dropped == 0 and writer.error is None
    writer.close()
    writer.record('callback_end', 7, 8, 9)          # after the end: counted, nothing else
    assert writer.dropped == 1


def test_every_event_is_in_the_file_or_counted(tmp_path):
    path = tmp_path / 'a.mcap'
    writer = TraceWriter(path, capacity=500, flush_interval_s=0.001)

    def run():
        for number in range(20_000):
            writer.record('callback_end', START + number, 1, number)

    workers = [threading.Thread(target=run) for _ in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    writer.close()
    events, _ = read(path)
    lost = sum(event[4] for event in events if event[0] == 'mddag:lost')
    there = sum(event[0] == 'ros2:callback_end' for event in events)
    assert writer.dropped == lost > 0
    assert there + lost == 80_000


def test_what_cannot_be_written_costs_nothing_else(tmp_path, caplog):
    path = tmp_path / 'a.mcap'
    bad = [
        ('nonsense', START, 1, 2), ('callback_end', START, 1), ('callback_end', START, 1, -1),
        ('callback_end', START, 1, 'text'), ('callback_end', -START, 1, 2), (), ([], START, 1),
        ('callback_end', START, 1, object()), ('callback_end', None, 1, 2),
        ('task_set', START, 1, b'bytes', 'f', 'rad', 1, 1, 1, True),
        (EXECUTION, START, 1), (PUBLICATION, START, 1, 'text', 2, 3), (PUBLICATION,),
        (EXECUTION, START, 1, -1, 0, 0, 0, 0, 0, 0, 0, 0, True, 0, 0, False)]
    lost = len(bad) + 1 + 2 * 3 + 2 * 1  # two groups of four events, and two of two
    with closing(TraceWriter(path, flush_interval_s=FAST)) as writer:
        for number, entry in enumerate(bad):
            writer.record('callback_end', START + number, 1, number)
            writer.record(*entry)
        wait_for_file(path, 100)
        writer.record(*bad[0])
    assert writer.dropped == lost
    writer.record()
    assert writer.dropped == lost + 1
    events, warnings = read(path)
    assert not warnings
    assert [event[4] for event in events if event[0] == 'ros2:callback_end'] == (
        list(range(len(bad))))
    assert sum(event[4] for event in events if event[0] == 'mddag:lost') == lost
    assert len(caplog.records) == 1
    assert "event 'nonsense' cannot be written (no such event)" in caplog.text


@pytest.mark.parametrize('name', ['missing/a.mcap', '.', 'a\0b'])
def test_a_path_that_cannot_be_written(tmp_path, name):
    with pytest.raises(TraceError, match='cannot be written') as caught:
        TraceWriter(str(tmp_path / name))
    assert '\n' not in str(caught.value)
    assert str(caught.value).startswith(str(tmp_path / name))


def test_a_full_disk_at_the_start():
    threads = threading.active_count()
    with pytest.raises(TraceError, match='/dev/full: writing failed .*No space left'):
        TraceWriter('/dev/full')
    assert threading.active_count() == threads


KILLED = """
import sys, time
from mddag_executor.trace import TraceWriter
writer = TraceWriter(sys.argv[1])
number = 0
while True:
    writer.record('callback_end', writer.now(), 1, number)
    number += 1
    if number % 10 == 0:
        time.sleep(0.001)
    if number % 100 == 0:
        print(number, flush=True)
"""


def test_a_killed_process_loses_at_most_the_last_second(tmp_path):
    path = tmp_path / 'a.mcap'
    with subprocess.Popen([sys.executable, '-c', KILLED, str(path)],
                          stdout=subprocess.PIPE) as child:
        child.stdout.readline()
        time.sleep(1.1)
        child.send_signal(signal.SIGKILL)
        killed = time.monotonic_ns()
        output = child.stdout.read().split()
    events, warnings = read(path)
    assert [event[4] for event in events] == list(range(len(events)))     # from the first on
    assert killed - events[-1][1] < 1_000_000_000
    assert int(output[-1]) - len(events) < len(events) + 20_000
    assert len(warnings) == 1 and 'without a finish record' in warnings[0]
    assert read(path, in_time_order=True) == (events, warnings)


LIMITED = """
import os, resource, sys, time
from mddag_executor.trace import TraceError, TraceWriter
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
writer = TraceWriter(sys.argv[1], flush_interval_s=0.005)
empty = os.path.getsize(sys.argv[1])
writer.record('callback_end', writer.now(), 1, 0)
number = 1
while os.path.getsize(sys.argv[1]) == empty:    # a busy machine may begin with a large chunk
    time.sleep(0.001)
while writer.error is None:
    writer.record('callback_end', writer.now(), 1, number * 7919 * 2**20 % 2**64)
    number += 1
    if number % 50 == 0:
        time.sleep(0.001)
for _ in range(10):
    writer.record('callback_end', writer.now(), 1, 0)
assert not writer._thread.is_alive() or writer._thread.join(5) is None
try:
    writer.close()
except TraceError as error:
    print(error)
writer.close()
print(number + 10, writer.dropped)
"""


def test_a_disk_that_gets_full(tmp_path):
    path = tmp_path / 'a.mcap'
    output = run_program(LIMITED, path)[0].splitlines()
    assert output[0] == (f'{path}: writing failed ({os.strerror(errno.EFBIG)}): what was written '
                         'before is there; free space, then try again')
    recorded, dropped = map(int, output[1].split())
    events, warnings = read(path)
    there = [event for event in events if event[0] == 'ros2:callback_end']
    reported = sum(event[4] for event in events if event[0] == 'mddag:lost')
    assert 0 < len(there) == recorded - dropped
    assert reported == 0
    assert path.stat().st_size < 20_000         # cut back to whole chunks
    assert len(warnings) == 1 and 'the file ends without a finish record' in warnings[0]


FORKED = """
import os, sys, threading
from mddag_executor.trace import TraceWriter
writer = TraceWriter(sys.argv[1], flush_interval_s=60)
writer.record('callback_end', 1, 2, 3)
child = os.fork()
if child == 0:
    writer.record('callback_end', 2, 2, 3)
    writer.close()
    sys.exit(0)
os.waitpid(child, 0)
writer.record('callback_end', 3, 2, 3)
"""


def test_a_forgotten_writer_completes_its_file_at_exit_and_a_forked_child_leaves_it(tmp_path):
    run_program(FORKED, tmp_path / 'a.mcap')
    events, warnings = read(tmp_path / 'a.mcap')
    assert [event[1] for event in events] == [1, 3] and not warnings
