# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The declaration language: what entries mean; parser and JSON Schema refuse the same."""

from pathlib import Path

import jsonschema
from msg_graph import ExecutionTime, language, loads, Process, WeaklyHard
import pytest
import yaml

from .helpers import graph, refusal

CONFIG = Path(__file__).resolve().parents[2] / 'config'
EVERYTHING = """\
mddag: 1
workers: 7
nodes:
  - node: /camera/driver
    callbacks:
      - name: frame
        subscription: /camera/raw
        period: 50ms
        release_from: header_stamp
        dag: camera
        on_late: abort
        max_active_jobs: 3
        keep: newest
        publishes: [/image, /info]
        execution_time: 3ms
        group: io
        holds_interpreter: true
  - node: /detector
    callbacks:
      - name: call-1.x
        sync: [/image, /info]
        reads: [/set, settings]
        publishes: [/boxes]
        execution_time: {quantiles_us: [1, 2.5, 1.0e+3]}
  - node: /detector
    callbacks:
      - name: settings
        service: /detector/set
        period: 1 s
        publishes: [/set]
        deadline: 2s
      - {name: 7, timer: 20ms, dag: tick, deadline: 1min}
  - node: /sink
    callbacks:
      - name: show
        subscription: /boxes
        deadline: 120ms
        importance: high
        tolerate: 2 of 50
        execution_time: {quantiles_us: [0, 5], percent: [10, 99.9]}
paths:
  - name: frame_to_show
    callbacks: ['/camera/driver:frame', '/detector:call-1.x', '/sink:show']
  - name: set_to_show
    callbacks: ['/detector:settings', '/detector:call-1.x', '/sink:show']
processes: {eyes: ['/camera/driver'], rest: [/sink]}
"""


def test_every_key():
    tasks = loads(EVERYTHING, 'all.yaml')
    assert (tasks.workers, tasks.file, tasks.text) == (7, 'all.yaml', EVERYTHING)
    frame, call, settings, tick, show = tasks.callbacks
    assert (frame.node, frame.name, frame.key, frame.line) == (
        '/camera/driver', 'frame', '/camera/driver:frame', 6)
    assert (frame.kind, frame.topics, frame.period_ns, frame.timer_period_ns) == (
        'subscription', ('/camera/raw',), 50_000_000, None)
    assert (frame.release_from, frame.dag, frame.on_late, frame.max_active_jobs, frame.keep) == (
        'header_stamp', 'camera', 'abort', 3, 'newest')
    assert (frame.publishes, frame.group, frame.holds_interpreter, frame.execution_time) == (
        ('/image', '/info'), 'io', True, ExecutionTime((3_000_000,), (50.0,)))
    assert (call.kind, call.topics, call.reads) == (
        'sync', ('/image', '/info'), ('/set', 'settings'))
    assert call.execution_time == ExecutionTime((1_000, 2_500, 1_000_000), (0.0, 50.0, 100.0))
    assert (call.period_ns, call.deadline_ns, call.group, call.dag, call.holds_interpreter) == (
        None, None, None, None, None)
    assert (call.release_from, call.on_late, call.max_active_jobs, call.keep) == (
        'arrival', None, None, 'all')
    assert (call.importance, call.tolerate) == ('normal', None)
    assert (settings.kind, settings.service, settings.topics, settings.period_ns) == (
        'service', '/detector/set', (), 1_000_000_000)
    assert (tick.kind, tick.timer_period_ns, tick.period_ns, tick.deadline_ns, tick.line) == (
        'timer', 20_000_000, 20_000_000, 60_000_000_000, 32)
    assert (show.importance, show.tolerate, str(show.tolerate), show.execution_time) == (
        'high', WeaklyHard(2, 50), '2 of 50', ExecutionTime((0, 5_000), (10.0, 99.9)))
    assert [(d.name, d.release_from, d.on_late, d.max_active_jobs) for d in tasks.dags] == [
        ('camera', 'header_stamp', 'abort', 3), ('/detector', 'arrival', None, None),
        ('tick', 'arrival', None, None)]
    assert [(e.reader, e.topic, e.writers) for e in tasks.queue_edges] == [
        ('/detector:call-1.x', '/set', ('/detector:settings',)),
        ('/detector:call-1.x', None, ('/detector:settings',))]
    assert [(p.name, len(p.callbacks)) for p in tasks.paths] == [
        ('frame_to_show', 3), ('set_to_show', 3)]
    assert tasks.processes == (
        Process('eyes', ('/camera/driver', '/detector')), Process('rest', ('/sink',)))
    words = EVERYTHING.replace('{', ' ').replace(',', ' ').split()
    keys = {*language.FILE, *language.NODE_KEYS, *language.CALLBACK_KEYS,
            *language.PATH_KEYS, *language.QUANTILES}
    assert {f'{key}:' for key in keys} - {'arguments:', 'include:'} <= set(words)


@pytest.mark.parametrize('count', [2, 28, 29, 30])
def test_quantiles_without_shares_are_evenly_spaced(count):
    numbers = ', '.join(str(100 * i / (count - 1)) for i in range(count))
    tasks = graph(f"""
        - node: /a
          callbacks:
            - name: t
              timer: 10ms
              deadline: 10ms
              execution_time: {{quantiles_us: [{numbers}]}}
    """)
    time = tasks.callbacks[0].execution_time
    assert time.percent == pytest.approx([100 * i / (count - 1) for i in range(count)])
    assert (time.mean_ns, time.draw(0.99)) == (50_000, 99_000)


def schema_errors(text):
    validator = jsonschema.Draft7Validator(language.schema())
    return [error.message for error in validator.iter_errors(yaml.safe_load(text))]


# What replaces what in the declaration above, and what is said of it in the line that differs.
BOTH = [
    # the file
    ('mddag: 1', 'mddag: 2', "'2' is not a known version of the format: write 'mddag: 1'"),
    ('mddag: 1\n', '', "the declaration: 'mddag' is missing: add 'mddag:'"),
    ('workers: 7', 'workers: 4097', "'workers': '4097' is not an integer from 1 to 4096"),
    ('workers: 7', 'wokers: 7', "unknown key 'wokers': did you mean 'workers'?"),
    ('workers: 7', 'xyz: 7', "unknown key 'xyz': use mddag, arguments, include, workers"),
    ('workers: 7', '"wor\\nkers": 7', "'wor\\nkers'"),
    ('workers: 7', 'workers:', "'workers' has no value"),
    # names
    ('node: /sink', 'node: sink', "'sink' is not an absolute node name: write it in full, as "
     "'/sink'"),
    ('node: /sink', 'node: /a-b', "'/a-b' is not a valid node name"),
    ('node: /sink', f'node: /{"a" * 300}', 'too long'),
    ('node: /sink', 'node: [/a]', "node 4: 'node': a list is not a single value: write a text"),
    ('- node: /sink', '- /sink\n  - node: /sink',
     "node 4: the text '/sink' is not a mapping: write one with the keys node, callbacks"),
    ('name: show', 'name: "a b"', "'a b' is not a valid callback name"),
    ('name: show', 'nme: show', "callback 1 of node '/sink': unknown key 'nme': did you mean"),
    ('name: show\n        ', '', "callback 1 of node '/sink': 'name' is missing"),
    ('group: io', 'group: a/b', 'not a valid callback group name'),
    ('dag: camera', 'dag: a@b', 'not a valid DAG name'),
    ('{eyes:', '{"eyes/ears":', 'not a valid process name'),
    # what starts a callback
    ('subscription: /boxes', 'subscription: boxes', 'is not an absolute topic name'),
    ('subscription: /boxes', f'subscription: /{"x" * 247}', 'at most 247'),
    ('subscription: /boxes', 'subscription: [/x, /y]', 'a list is not a single value'),
    ('timer: 20ms, ', 'timer: 20ms, subscription: /x, ', "'timer', 'subscription' exclude each"),
    ('timer: 20ms, ', '', "callback '/detector:7': nothing says what starts the callback"),
    ('sync: [/image, /info]', 'sync: /image', "the text '/image' is not a list: write a list, as"),
    ('sync: [/image, /info]', 'sync: [/x]', "too short: give at least 2, or write 'subscr"),
    ('sync: [/image, /info]', 'sync: []', 'the list is empty: add an entry'),
    ('sync: [/image, /info]', 'sync: [/x, /x]', "'/x' is listed twice"),
    ('service: /detector/set', 'service: /x/', 'not a valid service name'),
    # values
    ('timer: 20ms', 'timer: 20', "'timer': '20' has no unit: add one, as '20ms' or '20s'"),
    ('timer: 20ms', 'timer: -20ms', "'-20ms' is not a time: write a number and a unit"),
    ('deadline: 120ms', 'deadline: {}', "'deadline': a mapping is not a single value"),
    ('publishes: [/boxes]', 'publishes: [/boxes, x]', "'publishes': 'x' is not an absolute"),
    ('reads: [/set', 'reads: ["/b:c"', 'names a callback with its node'),
    ('on_late: abort', 'on_late: stop', "'stop' is not known: use continue, demote, abort"),
    ('release_from: header_stamp', 'release_from: arival', "did you mean 'arrival'?"),
    ('keep: newest', 'keep: last', 'use all, newest'),
    ('importance: high', 'importance: vital', 'use high, normal, low'),
    ('max_active_jobs: 3', 'max_active_jobs: many', 'from 1 to 1000000'),
    ('holds_interpreter: true', 'holds_interpreter: maybe', 'is neither true nor'),
    ('2 of 50', '5%', "'5%' is not a tolerance: write how many of how many, as '1 of 100'"),
    ('{quantiles_us: [0, 5], percent: [10, 99.9]}', '[3ms]', 'a list is not a mapping'),
    ('quantiles_us: [0, 5], ', '', "'quantiles_us' is missing"),
    ('quantiles_us: [0, 5]', 'quantiles_us: [1, x]', "'x' is not a number"),
    ('quantiles_us: [0, 5]', 'quantiles_us: [-1, 5]', 'not from 0 to a day and rising'),
    ('percent: [10, 99.9]', 'percent: [1, 101]', 'not from 0 to 100 and rising'),
    # paths
    ("'/camera/driver:frame', '/detector:call-1.x', '/sink:show'", "'/sink:show'", 'too short'),
    ("'/camera/driver:frame'", 'frame', "'frame' does not name a callback: write '/node:ca"),
    ('name: frame_to_show', 'nam: p', "path 1: unknown key 'nam'"),
]
# What the schema does not know: relations between values, and what is no JSON.
PARSER = [
    ('workers: 7', f'workers: {"9" * 5000}', 'is not an integer'),
    ('2 of 50', '3 of 3', 'is not a tolerance'),
    ('quantiles_us: [0, 5]', 'quantiles_us: [5, 1]', 'not from 0 to a day and rising'),
    ('quantiles_us: [0, 5]', 'quantiles_us: [1, 1e12]', 'not from 0 to a day and rising'),
    ('quantiles_us: [0, 5]', 'quantiles_us: [1, .nan]', "'.nan' is not a number"),
    ('percent: [10, 99.9]', 'percent: [5]', 'one for each quantile'),
    ('percent: [10, 99.9]', 'percent: [5, 5]', 'not from 0 to 100 and rising'),
    ('timer: 20ms', 'timer: 20ms, period: 2ms', 'period of 2ms is not that of its timer, 20ms'),
    ('name: set_to_show', 'name: frame_to_show', "path 'frame_to_show': this name is taken"),
    ("'/camera/driver:frame'", "'/camera/driver:fram'", "did you mean '/camera/driver:frame'?"),
    ("'/camera/driver:frame', ", "'/sink:show', ", "'/sink:show' is listed twice"),
    ("'/camera/driver:frame', '/detector:call-1.x', ", "'/camera/driver:frame', ",
     "path 'frame_to_show': no trigger or queue edge leads from '/camera/driver:frame' to"),
    ('rest: [/sink]', 'rest: [/d]', "there is no node '/d'"),
    ('rest: [/sink]', 'rest: [/camera/driver]', "is in process 'eyes', too"),
    ("eyes: ['/camera/driver'], rest: [/sink]", "eyes: [/sink, /detector, '/camera/driver'], "
     'x: []', "no node runs in process 'x'"),
]


@pytest.mark.parametrize(('right', 'wrong', 'says'), BOTH + PARSER)
def test_what_the_parser_refuses(right, wrong, says):
    assert says in str(refusal(EVERYTHING, right, wrong))


@pytest.mark.parametrize(('right', 'wrong'), [each[:2] for each in BOTH])
def test_the_schema_refuses_the_same(right, wrong):
    assert schema_errors(EVERYTHING.replace(right, wrong, 1))


def test_the_schema_allows_what_is_right():
    jsonschema.Draft7Validator.check_schema(language.schema())
    assert schema_errors(EVERYTHING) == []
    for name in ('autoware.yaml', 'autoware_multi.yaml'):
        assert schema_errors((CONFIG / name).read_text(encoding='utf-8')) == []
    text = """\
mddag: 1
arguments: {period: 10ms, workers: }
include:
  - other.yaml
  - {file: one.yaml, namespace: /front, remap: {/a: /b}, set: {period: $(period), on: 3}}
workers: $(workers)
nodes:
  - node: /$(period)
    callbacks: [{name: $(period)_x, timer: $(period), deadline: 1ms, on_late: $(period)}]
"""
    assert schema_errors(text) == []
    assert schema_errors(text.replace('namespace', 'name_space')) != []
    assert schema_errors(text.replace('remap: {/a: /b}', 'remap: {/a: b}')) != []


def test_numbers_and_truth_values_may_be_quoted():
    text = EVERYTHING.replace('7\n', '"7"\n').replace('true', "'true'").replace('2.5', '"2.5"')
    assert loads(text).callbacks == loads(EVERYTHING).callbacks and loads(text).workers == 7
