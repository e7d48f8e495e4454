# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A service or action is as urgent as the callback with a deadline that has sent the request."""

import ctypes
from functools import partial
import threading
import time
from types import SimpleNamespace

from mddag_executor.core import NEVER, Tables
from mddag_executor.executor import compat, request_ids
from mddag_executor.executor.bounds import MOST
from mddag_executor.executor.kinds import ListenerEntity
from mddag_executor.executor.request_ids import id_of_client, sender_of
from mddag_executor.executor.sent_requests import SentRequests
from mddag_executor.sources.open import open_recording
from mddag_executor.whatif.load import LoadBuilder
import pytest
from rclpy.action import ActionClient, ActionServer
from rclpy.exceptions import InvalidHandle
from rclpy.task import Future
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

from .asking import Asking, OTHERS, URGENT
from .conftest import Spinning
from .declared import graph
from .inside import engine_of


async def await_answer(each):
    await each.request('ask')


def test_a_service_goes_before_what_is_less_urgent_than_its_client(
        make_executor, make_node, spinning):
    each = Asking(make_executor, make_node, await_answer)
    each.serve('ask')
    assert each.run(spinning) == ['ask', 'control', *OTHERS]


def test_a_request_of_a_callback_without_a_deadline_waits_for_its_turn(make_executor, make_node):
    each = Asking(make_executor, make_node, await_answer, text=None)
    each.serve('ask')
    assert each.run() == [*OTHERS, 'ask', 'control']


@pytest.mark.parametrize('policy', ['gedf', 'llf', 'fifo', 'rm'])
def test_requests_inherit_times_only(make_executor, make_node, policy):
    each = Asking(make_executor, make_node, await_answer, policy=policy)
    each.serve('ask')
    order = each.run()
    assert order[0] == ('ask' if policy in ('gedf', 'llf') else 0)


def test_a_callback_that_waits_in_a_call_waits_for_no_less_urgent_one(make_executor, make_node):
    """But for the one that begins before the request has arrived."""
    each = Asking(make_executor, make_node, lambda each: each.call('ask'), pause_s=0.1)
    each.serve('ask')
    order = each.run()
    assert order.index('ask') < order.index(OTHERS[-1])
    assert order.index('control') < order.index(OTHERS[-1])


def test_a_service_that_asks_another_one_passes_it_on(make_executor, make_node):
    async def answer(request, response):
        each.ran.append('ask')
        await each.request('further')
        each.ran.append('answer')
        return response

    each = Asking(make_executor, make_node, await_answer)
    each.serve('ask', answer)
    each.serve('further', client_node=each.serving)
    assert each.run() == ['ask', 'further', 'answer', 'control', *OTHERS]


def test_the_callback_of_a_response_is_as_urgent(make_executor, make_node):
    """Also if it is added when the response has come."""
    def ask(each):
        for name in ('ask', 'late'):
            each.futures.append(each.request(name))
        each.futures[0].add_done_callback(lambda future: each.ran.append('answered'))

    async def add_late(each):
        ask(each)
        await each.futures[1]
        each.futures[1].add_done_callback(lambda future: each.ran.append('answered late'))

    each = Asking(make_executor, make_node, add_late)
    each.futures = []
    each.serve('ask')
    each.serve('late')
    order = each.run(names=('control', 'answered', 'answered late'))
    assert {*order[:5]} == {'ask', 'late', 'answered', 'control', 'answered late'}


def test_requests_of_threads_and_of_other_executors_are_not_urgent(make_executor, make_node):
    """They may come while an urgent one of the same client does."""
    def ask(each):
        thread = threading.Thread(target=lambda: each.requests.append(each.request('ask')))
        thread.start()
        thread.join()

    each = Asking(make_executor, make_node, ask)
    each.requests = []
    each.serve('ask')
    assert each.run(names=('ask', 'control')) == ['control', *OTHERS, 'ask']


def test_requests_of_one_service_keep_their_order(make_executor, make_node):
    """Those before an urgent one are not overtaken by it: they go before less urgent work."""
    def ask(each):
        thread = threading.Thread(target=each.request, args=('ask',))
        thread.start()
        thread.join()
        each.request('ask')

    def answer(request, response):
        each.ran.append(('ask', len(each.ran)))
        return response

    each = Asking(make_executor, make_node, ask)
    each.serve('ask', answer)
    order = each.run(names=('control', ('ask', 2)))
    assert order == ['control', ('ask', 1), ('ask', 2), *OTHERS]


def test_a_service_with_a_deadline_of_its_own_keeps_it(make_executor, make_node):
    text = URGENT + """
  - node: /serving
    callbacks:
      - {name: ask, service: /ask, period: 1s, sporadic: true, deadline: 400s}
"""
    each = Asking(make_executor, make_node, await_answer, text=text)
    each.serve('ask')
    assert each.run() == [*OTHERS, 'ask', 'control']


def test_a_request_of_a_late_callback_waits_for_its_turn(make_executor, make_node):
    """Its deadline is over: nothing that can be in time waits for it."""
    async def ask(each):
        time.sleep(0.05)
        await each.request('ask')

    text = graph(urgent='name: control, subscription: /go, period: 30s, deadline: 20ms')
    each = Asking(make_executor, make_node, ask, text=text)
    each.serve('ask')
    assert each.run() == [*OTHERS, 'ask', 'control']


def test_an_action_is_as_urgent_as_its_client(make_executor, make_node):
    """Goal, result and cancellation, and all that they start."""
    async def ask(each):
        goal = await each.action.send_goal_async(Fibonacci.Goal(order=1))
        each.ran.append('accepted')
        result = await goal.get_result_async()
        each.ran.append(tuple(result.result.sequence))
        await goal.cancel_goal_async()
        each.ran.append('not canceled')

    def execute(goal):
        each.ran.append('goal')
        goal.succeed()
        return Fibonacci.Result(sequence=[7])

    each = Asking(make_executor, make_node, ask)
    server = ActionServer(each.serving, Fibonacci, 'count', execute, callback_group=each.group)
    each.action = ActionClient(each.node, Fibonacci, 'count', callback_group=each.group)
    each.clients = {'count': each.action}
    each.action.wait_for_service = each.action.wait_for_server
    order = each.run()
    assert sorted(map(str, order[:5])) == sorted(
        ['accepted', 'goal', '(7,)', 'not canceled', 'control'])
    assert order[5:] == OTHERS
    server.destroy()
    each.action.destroy()


def test_requests_are_forgotten(make_executor, make_node):
    """Also those that are not answered."""
    async def ask(each):
        for _ in range(20 * MOST):
            each.request('silent')
        for _ in range(3):
            await each.request('ask')

    each = Asking(make_executor, make_node, ask)
    each.serve('ask')
    each.clients['silent'] = each.node.create_client(Trigger, '/silent')
    each.clients['silent'].wait_for_service = lambda timeout: True
    each.run()
    assert len(engine_of(each.executor).sent_requests._notes) <= 4 * MOST


def test_a_request_to_another_executor_is_forgotten_with_its_response(make_executor, make_node):
    async def ask(each):
        for _ in range(30):
            await each.request('elsewhere')

    each = Asking(make_executor, make_node, ask)
    elsewhere = make_node('elsewhere')
    elsewhere.create_service(Trigger, '/elsewhere', lambda request, response: response)
    each.clients['elsewhere'] = each.node.create_client(Trigger, '/elsewhere')
    with Spinning(make_executor(None, nodes=[elsewhere])):
        each.run()
    assert engine_of(each.executor).sent_requests.is_empty()


def test_a_request_that_is_taken_before_it_is_noted_is_forgotten_with_its_response():
    requests, found = SentRequests(), []

    def send():
        found.append(requests.of_request(b'client', 7, time.time_ns()))
        return 7

    requests.send(send, b'client', '/ask', 'handle', (5, 0))
    assert found == [(5, 0)] and not requests.is_empty()
    assert requests.of_response('handle', 7) == (5, 0)
    assert requests.is_empty()


def test_an_older_request_is_not_the_one_that_is_just_being_sent():
    """An ordinary one of the same client, which was taken late, inherits nothing."""
    requests, found = SentRequests(), []
    before = time.time_ns() - 1_000_000

    def send():
        found.append(requests.of_request(b'client', 6, before))
        return 7

    requests.send(send, b'client', '/ask', 'handle', (5, 0))
    assert found == [None]
    assert requests.of_request(b'client', 7, time.time_ns()) == (5, 0)


@pytest.mark.parametrize('send', [
    lambda requests, fails: requests.send(fails, b'client', '/ask', 'handle', (5, 0)),
    lambda requests, fails: requests.send_to_action(fails, 'goal', b'goal', 'handle', (5, 0))],
    ids=['service', 'action'])
def test_a_request_that_cannot_be_sent_is_forgotten(send):
    def fails():
        raise InvalidHandle('its client was destroyed')

    requests = SentRequests()
    with pytest.raises(InvalidHandle):
        send(requests, fails)
    assert requests.is_empty()


def test_the_thread_that_sends_a_request_takes_it_before_it_goes_on():
    """So it is known before something less urgent begins, and what it inherits is found then."""
    requests, found = SentRequests(), []
    requests.add_receiver('/ask', lambda: found.append(requests.of_request(b'client', 7, 0)))
    requests.add_receiver('/other', lambda: found.append('other'))
    assert requests.send(lambda: 7, b'client', '/ask', 'handle', (5, 0)) == 7
    assert found == [(5, 0)]


READER = bytes(15) + b'\4'
WRITER = bytes(15) + b'\3'


@pytest.mark.parametrize(('middleware', 'shown', 'memory', 'expected'), [
    (b'rmw_fastrtps_cpp', READER, b'', READER),
    (b'rmw_fastrtps_cpp', WRITER, b'head' + WRITER + READER, READER),
    (b'rmw_cyclonedds_cpp', READER, b'', None),
    (b'rmw_fastrtps_cpp', WRITER, b'head' + WRITER + WRITER, None),
    (b'rmw_fastrtps_cpp', WRITER, b'head' + WRITER + b'other process' + READER[13:], None),
    (b'rmw_fastrtps_cpp', WRITER, b'nothing', None)],
    ids=['reader', 'writer', 'other_middleware', 'no_reader', 'other_participant', 'not_found'])
def test_the_id_of_a_client_is_unknown_if_the_rest_in_memory_does_not_agree(
        monkeypatch, middleware, shown, memory, expected):
    """A wrong one would let an ordinary request inherit."""
    data = ctypes.create_string_buffer(memory.ljust(256, b'\xff'), 256)
    client = request_ids._Client(middleware, ctypes.addressof(data), b'/ask')

    def give_id(_, gid):
        ctypes.memmove(ctypes.addressof(gid._obj) + request_ids._Gid.data.offset, shown, 16)
        return 0

    monkeypatch.setattr(request_ids, '_rmw_client', lambda _: ctypes.addressof(client))
    monkeypatch.setattr(request_ids, '_id_of_writer', give_id)
    found = id_of_client(SimpleNamespace(pointer=0))
    assert found == (None if expected is None else (expected, '/ask'))


def test_the_client_of_a_header_is_unknown_if_the_rest_in_memory_does_not_agree():
    """As of a header that is laid out in another way than rclpy's."""
    header = SimpleNamespace(
        source_timestamp=1, received_timestamp=2, request_id=SimpleNamespace(sequence_number=3))
    assert sender_of(header) is None


def test_a_response_that_comes_before_its_request_is_noted_is_as_urgent(make_executor):
    """The sending thread has the client's lock until then."""
    requests, future = SentRequests(), Future()

    def pending(number):
        requests.send(lambda: number, b'client', '/ask', 'handle', (5, 0))
        return future

    compat.complete_request(
        SimpleNamespace(get_pending_request=pending), 7, Trigger.Response(), make_executor(),
        partial(requests.of_response, 'handle', 7))
    assert compat.heritage_of_response((future,)) == (5, 0)
    assert requests.is_empty()


def test_a_service_that_is_destroyed_before_it_listens_receives_no_requests(
        make_executor, make_node, monkeypatch):
    def destroyed(entity, *_):
        raise InvalidHandle('the node destroys it')

    node = make_node()
    executor = make_executor(nodes=[node])
    service = node.create_service(Trigger, '/brief', lambda request, response: response)
    with monkeypatch.context() as patch:
        patch.setattr(ListenerEntity, 'listen_in', destroyed)
        executor.set_judging(True)  # it notices the service
    node.destroy_service(service)
    executor.spin_once(0)
    assert '/brief' not in engine_of(executor).sent_requests._receivers


def test_a_recording_says_what_a_request_has_inherited(make_executor, make_node, tmp_path):
    """And its load as well, for rescheduling."""
    path = tmp_path / 'run.mcap'
    each = Asking(make_executor, make_node, await_answer, trace=path)
    each.serve('ask')
    each.run()
    each.executor.shutdown()
    recording = open_recording(path)
    table = recording.executions
    inherits = table['inherited'] > 0
    assert [recording.callback_name(callback) for callback in table['callback'][inherits].tolist()
            ] == ['/serving: answer (service /ask)']
    deadline = int(recording.jobs.release[0]) + 30 * 10 ** 9
    assert table['inherited'][inherits].tolist() == [deadline]
    assert not inherits[table['vertex'] >= 0].any()
    load = LoadBuilder(recording, Tables.build(recording.task_set), (1,)).build().load
    inherited = [*map(int, load.inherited)]
    assert sorted(inherited)[:2] == [deadline, NEVER]
    assert load.inherits_from[inherited.index(deadline)] == 0
