# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Declarations from CARET architecture files, made up here in CARET's format."""

import re

from msg_graph import GraphError, loads
from msg_graph.caret import declaration_from_caret
from msg_graph.draft import MARK
import pytest

HEAD = 'executors: []\nnamed_paths: []\nnodes:\n'


def node(name, *callbacks, extra=''):
    """Return a node; each callback as `timer NS`, `subscription TOPIC` or `service NAME`."""
    lines = [f'- node_name: {name}', '  callbacks:']
    keys = {'timer': 'period_ns', 'subscription': 'topic_name', 'service': 'service_name'}
    for place, callback in enumerate(callbacks):
        kind, start = callback.split()
        lines += [f'  - callback_name: {name}/callback_{place}',
                  f'    callback_type: {kind}_callback', f'    {keys[kind]}: {start}',
                  '    symbol: A::A(std::vector<int,',
                  '      std::allocator<int> >)::{lambda()#1}']
    return '\n'.join(lines) + '\n' + extra


def publishes(topic, *names):
    items = ''.join(f'    - {name}\n' for name in names)
    return f'  publishes:\n  - topic_name: {topic}\n    callback_names:\n{items}'


CHAIN = HEAD.replace('named_paths: []', """\
named_paths:
- path_name: whole
  node_chain:
  - {node_name: /a, publish_topic_name: /x, subscribe_topic_name: UNDEFINED}
  - {node_name: /b, publish_topic_name: UNDEFINED, subscribe_topic_name: /x}
- path_name: open
  node_chain:
  - {node_name: /a, publish_topic_name: /none, subscribe_topic_name: UNDEFINED}""") + (
    node('/a', 'timer 33333333', extra=publishes('/x', '/a/callback_0'))
    + node('/b', 'subscription /x', 'subscription /outside', 'service /serve', extra="""\
  callback_groups:
  - callback_group_type: mutually_exclusive
    callback_group_name: /b/callback_group_0
    callback_names: [/b/callback_0, /b/callback_1]
  - callback_group_type: reentrant
    callback_group_name: /b/callback_group_1
    callback_names: [/b/callback_1, /b/callback_2]
  - callback_group_type: mutually_exclusive
    callback_group_name: /b/callback_group_2
    callback_names: [/b/callback_2]
  variable_passings:
  - callback_name_write: /b/callback_1
    callback_name_read: /b/callback_0
  - {callback_name_write: UNDEFINED, callback_name_read: UNDEFINED}
"""))


def accepted(text):
    """Return a declaration with all proposals accepted."""
    return re.sub(rf'^( +)# (\w+: .*# {MARK})', r'\1\2', text, flags=re.MULTILINE)


def test_a_chain():
    text = declaration_from_caret(CHAIN, 'arch.yaml')
    with pytest.raises(GraphError) as caught:
        loads(text)
    # All blanks at once, with their lines, instead of the errors that come of them.
    lines = text.splitlines()
    blanks = [n for n, line in enumerate(lines, 1) if f'# {MARK}: ' in line]
    assert [each.line for each in caught.value.errors] == blanks and len(blanks) > 4
    assert [each.problem.split(':')[0] for each in caught.value.errors] == [
        lines[n - 1].split('#')[1].split(':')[0].strip()
        if lines[n - 1].startswith(' ') else 'this is a blank to fill in (path open'
        for n in blanks]
    task_set = loads(accepted(text))
    assert [c.key for c in task_set.callbacks] == [
        '/a:callback_0', '/b:callback_0', '/b:callback_1', '/b:callback_2']
    assert [dag.name for dag in task_set.dags] == ['/a', '/b/callback_1', '/b/callback_2']
    timer, chained, outside, service = task_set.callbacks
    assert timer.timer_period_ns == chained.deadline_ns == 33_333_000
    assert (chained.topics, chained.group, chained.reads) == (
        ('/x',), 'callback_group_0', ('callback_1',))
    assert (outside.group, outside.period_ns) == ('callback_group_0', 100_000_000)
    assert (service.service, service.group) == ('/serve', None)
    assert [(p.name, p.callbacks) for p in task_set.paths] == [
        ('whole', ('/a:callback_0', '/b:callback_0'))]
    assert f'# {MARK}: path open: which callbacks? /a' in text


def test_an_unknown_publisher_is_a_blank_on_each_callback_that_may():
    text = declaration_from_caret(
        HEAD + node('/a', 'timer 1000000', 'timer 2000000', extra=publishes('/x', 'UNDEFINED'))
        + node('/b', 'subscription /x'), 'arch.yaml')
    assert text.count(f'# publishes: [/x]  # {MARK}: which callback publishes /x?') == 2
    assert '# /x has no known publisher yet' in text
    assert '# period' not in text
    assert text.count(f'{MARK}: if it is a sink') == 2


def test_message_contexts_become_queue_edges():
    contexts = """\
  subscribes:
  - {topic_name: /x, callback_name: /b/callback_0}
  - {topic_name: /y, callback_name: UNDEFINED}
  - {topic_name: /chained, callback_name: UNDEFINED}
  message_contexts:
  - context_type: use_latest_message
    subscription_topic_name: /x
    publisher_topic_name: /z
  - context_type: use_latest_message
    subscription_topic_name: /y
    publisher_topic_name: /z
  - context_type: callback_chain
    subscription_topic_name: /chained
    publisher_topic_name: /z
"""
    text = declaration_from_caret(
        HEAD + node('/a', 'timer 1000000', extra=publishes('/x', '/a/callback_0'))
        + node('/c', 'timer 1000000', extra=publishes('/y', '/c/callback_0'))
        + node('/b', 'subscription /x', 'timer 5000000',
               extra=publishes('/z', '/b/callback_1') + contexts), 'arch.yaml')
    task_set = loads(accepted(text))
    assert [(e.reader, e.topic, e.writers) for e in task_set.queue_edges] == [
        ('/b:callback_1', None, ('/b:callback_0',)), ('/b:callback_1', '/y', ('/c:callback_0',))]


OF_2021 = """\
path_name_aliases:
- path_name: whole
  callbacks: [/a/timer_callback_0, /b/subscription_callback_0, /b/timer_callback_0]
- path_name: lost
  callbacks: [/a/timer_callback_0, /b/gone]
nodes:
- node_name: /a
  callbacks:
  - {callback_name: timer_callback_0, type: timer_callback, period_ns: 20000000, symbol: s}
  publishes:
  - {topic_name: /x, callback_name: timer_callback_0}
- node_name: /b
  callbacks:
  - {callback_name: subscription_callback_0, type: subscription_callback, topic_name: /x}
  - {callback_name: timer_callback_0, type: timer_callback, period_ns: 50000000, symbol: s}
  variable_passings:
  - {callback_name_write: subscription_callback_0, callback_name_read: timer_callback_0}
  publishes:
  - {topic_name: /y, callback_name: timer_callback_0}
"""


def test_a_file_of_2021():
    text = declaration_from_caret(OF_2021, 'arch.yaml')
    assert (f'# {MARK}: path lost: which callbacks? /a:timer_callback_0 -> /b:gone'
            in text.splitlines())
    task_set = loads(accepted(text))
    assert [c.publishes for c in task_set.callbacks] == [('/x',), (), ('/y',)]
    assert [path.name for path in task_set.paths] == ['whole']
    whole = ['/a:timer_callback_0', '/b:subscription_callback_0', '/b:timer_callback_0']
    assert [c.key for c in task_set.callbacks] == whole


@pytest.mark.parametrize(('text', 'problem'), [
    ('', 'this is not an architecture file'),
    ('[1]', 'this is not an architecture file'),
    ('mddag: 1\nworkers: 2\n', "this is not an architecture file of CARET: 'nodes' is missing"),
    ('nodes: 3\n', 'this is not an architecture file'),
    ('nodes: [{}]\n', "'node_name' is missing"),
    ('nodes: []\nnamed_paths: [{path_name: [a], node_chain: []}]', 'not an architecture file'),
    (HEAD + node('no/slash', 'timer 1'), 'is not an absolute node name'),
    (HEAD + node('/a', 'timer soon'), "'period_ns' of '/a/callback_0' is 'soon'"),
    (HEAD + node('/a', 'timer 5000').replace('timer_callback', 'magic'), "'magic' of '/a/callbac"),
    (HEAD + node('/a', 'timer 5000').replace('/callback_0', '/c 0'), 'not a valid callback name'),
    (HEAD + node('/a', 'timer 5000', 'timer 5000').replace('/callback_1', '/callback_0'),
     "two callbacks of /a are called '/a/callback_0'"),
])
def test_what_is_no_architecture_file(text, problem):
    with pytest.raises(GraphError, match=re.escape(problem)) as caught:
        declaration_from_caret(text, 'arch.yaml')
    assert str(caught.value).startswith('arch.yaml')
    assert '\n' not in str(caught.value)


def test_blanks_hide_other_errors():
    text = """\
mddag: 1
nodes:
  - node: /a
    callbacks:
      - name: tick
        # timer: 100ms  # FILL IN: what starts it?
        publishes: [/x]
      - {name: wrong, timer: 5, deadline: 1ms}
  - node: /b
    callbacks:
      - name: take
        subscription: /x
        # deadline: 100ms  # FILL IN: a sink
"""
    with pytest.raises(GraphError) as caught:
        loads(text, 'g.yaml')
    assert [str(each) for each in caught.value.errors] == [
        f"g.yaml:{place}): correct the value and take the '# ' away" for place in (
            '6: timer: is a blank to fill in (what starts it?',
            '13: deadline: is a blank to fill in (a sink')]
    # what is filled in is no blank, and one that does no harm is no error
    filled = text.replace('# timer', 'timer').replace('# deadline', 'deadline').replace(
        'timer: 5,', 'timer: 5ms, dag: wrong,') + '        # paths: []  # FILL IN: a path\n'
    assert len(loads(filled).dags) == 2
