# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The paper's workload through the core: 11 DAGs, 86 vertices, at the nanosecond."""

from functools import cache
from pathlib import Path

from mddag_executor.core.state import SINK_COMPLETED, SINK_LATE
from mddag_executor.simulate import draw_execution_times, periodic_load, Settings, simulate
from msg_graph import load
import pytest

AUTOWARE = Path(__file__).resolve().parents[2] / 'config' / 'autoware.yaml'
DURATION_NS = 3_000_000_000
WORKERS = 7


@cache
def autoware():
    return load(AUTOWARE)


# What the paper's own program (github.com/atsushi421/2024_RTSS_WiP_Evaluation) gave on 2026-11-22
# for draws of this project, by seed and policy: when the first late sink completed, and the worst
# response time of each sink until then, DAG by DAG, us.
PAPER = {
    (2, 'rad'): (None, [
        5998, 5967, 1995, 2216, 34988, 250, 251, 4401, 140938, 231479, 122722, 212577, 188155, 669,
        2889, 79032, 316, 314]),
    (2, 'rm'): (None, [
        5998, 5967, 1995, 2216, 47589, 250, 251, 42276, 154585, 253775, 136369, 238556, 193595,
        40455, 42176, 95793, 316, 314]),
    (2, 'wc'): (246381, [
        27427, 28065, 46381, 19384, 1022, 7070, 7068, 24540, 137314, 221830, 115863, 204491,
        175345, 23881, 24440, 79020, 7076, 7072]),
    (3, 'rad'): (None, [
        2410, 2439, 444, 757, 42939, 331, 331, 2330, 139084, 243956, 102674, 214008, 174158, 637,
        2433, 93197, 1488, 1488]),
    (3, 'rm'): (301085, [
        2410, 2439, 444, 757, 5711, 331, 331, 32706, 137484, 235300, 99541, 205538, 166578, 32527,
        33954, 101085, 1488, 1488]),
    (3, 'wc'): (239240, [
        28420, 28516, 39240, 9888, 783, 7349, 7346, 35902, 137351, 235723, 98151, 209200, 165680,
        32024, 36002, 92988, 10060, 10058]),
    (4, 'rad'): (None, [
        2388, 2420, 1394, 1643, 2161, 220, 220, 2663, 118909, 201827, 97510, 189373, 94850, 620,
        2081, 99630, 376, 378]),
    (4, 'rm'): (400823, [
        2388, 2420, 1394, 1643, 2120, 220, 220, 3670, 121794, 203706, 99454, 191252, 93678, 3419,
        3618, 100823, 376, 378]),
    (4, 'wc'): (None, [
        8526, 8606, 4260, 4509, 881, 6876, 6874, 2932, 121704, 203706, 99454, 191252, 93387, 1785,
        2638, 99654, 7878, 7876]),
    (9, 'rad'): (None, [
        2761, 2816, 1536, 1712, 3039, 305, 306, 2408, 122508, 161066, 91511, 155124, 84655, 27151,
        5569, 64639, 314, 314]),
    (9, 'rm'): (None, [
        2761, 2816, 1536, 1712, 3277, 305, 306, 5184, 129765, 167026, 97476, 161084, 87969, 31857,
        6729, 71180, 314, 314]),
    (9, 'wc'): (None, [
        10303, 17232, 9240, 9416, 1214, 14542, 14540, 3945, 128773, 167632, 98082, 161690, 81548,
        28595, 5737, 67424, 14666, 14663]),
}


@pytest.mark.parametrize(('seed', 'policy'), PAPER)
def test_the_paper_s_program_gives_the_same(seed, policy):
    task_set = autoware()
    times = [[-(-time // 1000) * 1000 for time in row]
             for row in draw_execution_times(task_set, seed)]
    run = simulate(task_set, periodic_load(task_set, times, DURATION_NS), Settings(
        policy=policy, workers=WORKERS, duration_ns=DURATION_NS, preemptive=None,
        judge='completions', stop_at_first_miss=True))
    worst = {}
    first_miss = None
    for kind, dag, vertex, job, _, time in run.decisions:
        if kind in SINK_COMPLETED and first_miss is None:
            response = (time - job * task_set.dags[dag].period_ns) // 1000
            worst[vertex] = max(response, worst.get(vertex, 0))
            first_miss = time // 1000 if kind == SINK_LATE else None
    assert (first_miss, [worst[vertex] for vertex in sorted(worst)]) == PAPER[seed, policy]
