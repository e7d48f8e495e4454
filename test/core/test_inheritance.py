# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Rule 15: what requests inherit, alone and compared with a plain model; the order without it."""

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core import NEVER, POLICIES, Scheduler, Tables
from mddag_executor.core.queues import overtaking_pays
from mddag_executor.simulate import Settings, START
from mddag_executor.simulate.schedule import schedule
from mddag_executor.simulate.workload import Workload
import pytest

from ..conftest import examples
from ..invariants import broken_in_core
from .task_sets import declaration, single, TICK

DEFAULT = 1000 * TICK
TASK_SET = declaration([single('a', 20), single('b', 50)])


def new_core(default=DEFAULT, policy='rad', workers=1, on_late='demote'):
    tables = Tables.build(TASK_SET, legs=True, default_deadline=default, on_late=on_late)
    return Scheduler(tables, workers, policy)


class Requests:
    """
    Queues of undeclared executions, and which one a plain model runs next.

    In the model, nothing is ever late.  A queue comes by the least of: what its executions
    inherit, as far as that is not over, and the own priority of its first one.
    """

    def __init__(self, n_queues):
        self.core = new_core(default=10 ** 9)
        self.queues = [(self.core.new_queue(), []) for _ in range(n_queues)]
        self.now = 0
        self.started = []

    def arrive(self, queue, inherited):
        number, waiting = self.queues[queue]
        x = self.core.ready_undeclared(0, -1, 0, number, self.now)
        own = self.now + 10 ** 9
        if inherited is not None:
            self.core.inherit(x, inherited, 0)
        waiting.append((x, own, own if inherited is None else inherited))

    def place(self, waiting):
        valid = [inherited for _, own, inherited in waiting
                 if own != inherited and inherited >= self.now]
        return min([waiting[0][1], *valid])

    def start(self):
        several = [waiting for _, waiting in self.queues if waiting]
        x = self.core.take(0, self.now)
        assert not [*broken_in_core(self.core.tables, self.core.state)]
        if not several:
            assert x == -1
            return
        first = min(map(self.place, several))
        candidates = [each for each in several if self.place(each) == first]
        mine, = (each for each in candidates if each[0][0] == x)
        mine.pop(0)
        self.core.complete(x, self.now)


@examples(400)
@given(st.integers(1, 4), st.lists(st.one_of(
    st.integers(1, 30), st.none(), st.tuples(st.integers(0, 3), st.one_of(
        st.none(), st.integers(-5, 40)))), max_size=40))
def test_requests_run_in_the_order_of_a_plain_model(n_queues, steps):
    """A number lets time pass, None starts the next one, a pair is a request that arrives."""
    each = Requests(n_queues)
    for step in (*steps, *[None] * 41):
        if step is None:
            each.start()
        elif isinstance(step, int):
            each.now += step
        else:
            queue, inherited = step
            each.arrive(
                queue % n_queues, None if inherited is None else each.now + inherited)


def started(core, now, count):
    """Start executions one after the other; return them."""
    found = []
    for _ in range(count):
        found.append(core.take(0, now))
        core.complete(found[-1], now)
    return found


def sender(core, deadline_of=0):
    """Release a job of a DAG at time 0 and start its source; return that."""
    source = core.source(core.release(deadline_of, 0, 0, 0))
    core.ready(source, 0)
    assert core.take(0, 0) == source
    return source


def test_a_request_goes_before_what_was_ready_before_it():
    """The bound: it waits for what runs, and for its queue, but for nothing less urgent."""
    core = new_core()
    source = sender(core)
    others = [core.ready_undeclared(0, -1, 0, core.new_queue(), 1) for _ in range(5)]
    request = core.ready_undeclared(0, -1, 0, core.new_queue(), 2)
    core.inherit(request, *core.heritage(source))
    core.suspend(source)
    assert core.take(0, 3) == request
    # a request that it sends inherits the same
    further = core.ready_undeclared(0, -1, 0, core.new_queue(), 4)
    core.inherit(further, *core.heritage(request))
    core.suspend(request)
    assert core.take(0, 5) == further
    core.complete(further, 6)
    core.resume(request, 0, 0, 6)
    assert core.take(0, 6) == request
    core.complete(request, 7)
    core.resume(source, 0, 0, 7)
    assert core.take(0, 7) == source
    core.complete(source, 8)
    assert started(core, 8, 5) == others


def test_without_a_job_nothing_is_inherited():
    core = new_core()
    first = core.ready_undeclared(0, -1, 0, core.new_queue(), 0)
    core.take(0, 0)
    assert core.heritage(first) is None


def test_a_less_urgent_sender_changes_nothing():
    core = new_core(default=10 * TICK)
    source = sender(core, 1)
    other, request = (core.ready_undeclared(0, -1, 0, core.new_queue(), time) for time in (1, 2))
    core.inherit(request, *core.heritage(source))
    core.complete(source, 3)
    assert started(core, 3, 1) == [other]
    assert core.take(0, 3) == request
    assert core.heritage(request) is None   # its own requests have the default deadline as well


def test_a_sender_that_is_as_urgent_changes_nothing():
    core = new_core()
    for number, queue in enumerate((core.new_queue(), -1)):     # -1: it goes on
        request = core.ready_undeclared(0, -1, 0, queue, number)
        core.inherit(request, number + DEFAULT, 0)
        assert core.take(0, number) == request
        assert core.heritage(request) is None
        core.complete(request, number)


def test_requests_of_a_service_keep_their_order():
    """Those before an urgent one go before everything that is less urgent as well."""
    core = new_core()
    source = sender(core)
    other = core.ready_undeclared(0, -1, 0, core.new_queue(), 1)
    queue = core.new_queue()
    before, request = (core.ready_undeclared(0, -1, 0, queue, 2) for _ in range(2))
    core.inherit(request, *core.heritage(source))
    core.complete(source, 3)
    assert started(core, 3, 3) == [before, request, other]


def test_an_urgent_request_comes_to_a_late_queue():
    core = new_core(default=10 * TICK)
    queue, now = core.new_queue(), 11 * TICK
    late = [core.ready_undeclared(0, -1, 0, queue, 0) for _ in range(3)]
    other = core.ready_undeclared(0, -1, 0, core.new_queue(), now)
    assert core.take(0, now) == other
    request = core.ready_undeclared(0, -1, 0, queue, now)
    core.inherit(request, now + 5 * TICK, 0)
    core.complete(other, now)
    third = core.ready_undeclared(0, -1, 0, core.new_queue(), now)
    assert started(core, now, 5) == [*late, request, third]


def test_a_late_queue_stays_late_when_an_inherited_deadline_is_over():
    core = new_core(default=10 * TICK)
    queue, now = core.new_queue(), 11 * TICK
    late = core.ready_undeclared(0, -1, 0, queue, 0)
    other = core.ready_undeclared(0, -1, 0, core.new_queue(), now)
    assert core.take(0, now) == other
    request = core.ready_undeclared(0, -1, 0, queue, now)
    core.inherit(request, now + 2 * TICK, 0)
    core.complete(other, now)
    assert started(core, now, 1) == [late]
    now += 3 * TICK     # with its own deadline, the request would be in time
    other = core.ready_undeclared(0, -1, 0, core.new_queue(), now)
    assert started(core, now, 2) == [other, request]


def test_a_fresh_execution_of_a_late_queue_passes_on_what_it_inherits():
    core = new_core(default=10 * TICK)
    queue, now = core.new_queue(), 11 * TICK
    late = core.ready_undeclared(0, -1, 0, queue, 0)
    other = core.ready_undeclared(0, -1, 0, core.new_queue(), now)
    fresh = core.ready_undeclared(0, -1, 0, queue, now)
    core.take(0, now)
    core.complete(other, now)
    assert started(core, now, 1) == [late]
    request = core.ready_undeclared(0, -1, 0, queue, 15 * TICK)
    core.inherit(request, 23 * TICK, 1)
    assert core.take(0, 16 * TICK) == fresh and core.heritage(fresh) == (23 * TICK, 1)


def test_the_first_one_inherits_from_the_request_that_is_not_over():
    """The priority, and the vertex that has it."""
    core = new_core()
    queue = core.new_queue()
    first, *requests = (core.ready_undeclared(0, -1, 0, queue, 0) for _ in range(3))
    core.inherit(requests[1], 20 * TICK, 1)
    core.inherit(requests[0], 10 * TICK, 0)
    assert core.take(0, 15 * TICK) == first and core.heritage(first) == (20 * TICK, 1)


def test_what_an_execution_has_inherited_is_not_of_the_next_one_in_its_slot():
    core = new_core()
    request = core.ready_undeclared(0, -1, 0, core.new_queue(), 0)
    core.inherit(request, 50 * TICK, 0)
    assert started(core, 0, 1) == [request]
    queue = core.new_queue()
    first = core.ready_undeclared(0, -1, 0, queue, TICK)
    assert first == request     # the slot is used again
    other = core.ready_undeclared(0, -1, 0, core.new_queue(), 0)
    core.inherit(core.ready_undeclared(0, -1, 0, queue, TICK), 30 * TICK, 0)
    assert started(core, 31 * TICK, 2) == [other, first]


def test_an_execution_that_goes_on_is_not_late():
    """Though what it has inherited is over, and its own deadline as well."""
    core = new_core(default=10 * TICK)
    request = core.ready_undeclared(0, -1, 0, core.new_queue(), 0)
    core.inherit(request, 8 * TICK, 0)
    assert core.take(0, 0) == request
    core.suspend(request)
    core.resume(request, 0, 0, 5 * TICK)
    other = core.ready_undeclared(0, -1, 0, core.new_queue(), 29 * TICK)
    assert started(core, 30 * TICK, 2) == [request, other]


def test_a_queue_stays_late_until_it_is_empty():
    """Though its first execution is not late, and one more becomes ready."""
    core = new_core(default=10 * TICK)
    queue, now = core.new_queue(), 11 * TICK
    late, fresh = (core.ready_undeclared(0, -1, 0, queue, time) for time in (0, now))
    other = core.ready_undeclared(0, -1, 0, core.new_queue(), now)
    assert started(core, now, 2) == [other, late]
    newest = core.ready_undeclared(0, -1, 0, queue, 12 * TICK)
    other = core.ready_undeclared(0, -1, 0, core.new_queue(), 13 * TICK)
    assert started(core, 13 * TICK, 3) == [other, fresh, newest]


def test_a_queue_stays_late_though_its_late_execution_is_dropped():
    core = new_core(default=10 * TICK)
    queue = core.new_queue()
    late, fresh = (core.ready_undeclared(0, -1, 0, queue, time) for time in (0, 11 * TICK))
    other = core.ready_undeclared(0, -1, 0, core.new_queue(), 12 * TICK)
    core.drop(late, 12 * TICK)
    assert started(core, 12 * TICK, 2) == [other, fresh]


@pytest.mark.parametrize('preempts', [False, True])
def test_nothing_overtakes_a_callback_that_ends_before_python_switches(preempts):
    core = new_core(default=1)
    urgent = core.ready_undeclared(0, -1, 0, core.new_queue(), 1)
    assert [overtaking_pays(core.tables, core.state, urgent, 0, usual, preempts)
            for usual in (999_999, 1_000_000)] == [False, True]


@pytest.mark.parametrize('suspends', [False, True])
def test_what_is_over_is_not_inherited_any_more(suspends):
    """A late job takes nothing down by its requests; they are like any other then."""
    core = new_core()
    source = sender(core)
    request = core.ready_undeclared(0, -1, 0, core.new_queue(), 1)
    core.inherit(request, *core.heritage(source))
    core.suspend(source)
    if suspends:
        assert core.take(0, 2) == request
        core.suspend(request)
    now = 21 * TICK
    other = core.ready_undeclared(0, -1, 0, core.new_queue(), 3)
    if suspends:
        core.resume(request, 0, 0, now)
    expected = [other, request] if suspends else [request, other]
    assert started(core, now, 2) == expected
    assert core.state.x_like[request] == -1


def test_a_demoted_jobs_requests_are_not_urgent():
    core = new_core(default=100 * TICK)
    source = core.source(core.release(0, 0, 0, 0))
    core.ready(source, 0)
    now = 21 * TICK
    assert core.take(0, now) == source
    other, request = (core.ready_undeclared(0, -1, 0, core.new_queue(), now) for _ in range(2))
    core.inherit(request, *core.heritage(source))
    core.complete(source, now)
    assert started(core, now, 2) == [other, request]


@pytest.mark.parametrize('policy', sorted(POLICIES))
def test_only_times_are_inherited(policy):
    core = new_core(policy=policy)
    source = sender(core)
    other, request = (core.ready_undeclared(0, -1, 0, core.new_queue(), 1) for _ in range(2))
    core.inherit(request, *core.heritage(source))
    core.complete(source, 1)
    is_first = policy in ('rad', 'gedf', 'llf')
    assert started(core, 1, 2) == ([request, other] if is_first else [other, request])


def test_what_inherits_may_overtake_as_what_it_inherits_from():
    """A wait of ten ticks is long for a deadline of 20 ticks, and short for the default one."""
    core = new_core(default=10 ** 9)
    source = sender(core)
    request = core.ready_undeclared(0, -1, 0, core.new_queue(), 1)
    wait = 2_000_000
    assert not overtaking_pays(core.tables, core.state, request, 0, wait, False)
    core.inherit(request, *core.heritage(source))
    assert overtaking_pays(core.tables, core.state, request, 0, wait, False)


@pytest.mark.parametrize('compiled', [False, True])
def test_a_simulated_request_goes_before_what_is_less_urgent(compiled):
    """Three undeclared executions wait for a worker; the last one inherits a deadline."""
    load = Workload(
        times=[0, 1, 2, 3], dags=[0, 2, 2, 2], jobs=[0, 0, 1, 2], costs=[10, 5, 5, 5],
        cost_base=[0, 0, 1], cost_stride=[0, 0, 1], inherited=[NEVER, NEVER, 20 * TICK],
        inherits_from=[0, 0, 0])
    settings = Settings(policy='rad', pools=(1,), duration_ns=100, preemptive=False)
    run = schedule(Tables.build(TASK_SET), load, settings, log=True, compiled=compiled)
    log = [[int(value) for value in row] for row in run.log]
    assert [row[5] for row in log if row[1] == START and row[3] == 2] == [2, 0, 1]
