# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The declaration language: what entries mean, and what each is refused for."""

from __future__ import annotations

from msg_graph import loads, WeaklyHard
import pytest

from .helpers import error, graph, MARK, nodes_error

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
        publishes: [/image, /info]
        execution_time: 3ms
        group: io
  - node: /detector
    callbacks:
      - name: call-1.x
        sync: [/image, /info]
        reads: [/set, settings]
        publishes: [/boxes]
        execution_time: {quantiles_us: [1, 2.5, 1e3]}
  - node: /detector
    callbacks:
      - name: settings
        service: /detector/set
        period: 1 s
        publishes: [/set]
        deadline: 2s
      - {name: tick, timer: 20ms, dag: tick, deadline: 1min}
  - node: /sink
    callbacks:
      - name: show
        subscription: /boxes
        deadline: 120ms
        execution_time: {quantiles_us: [0, 5], percent: [10, 99.9]}
paths:
  - name: frame_to_show
    callbacks: ['/camera/driver:frame', '/detector:call-1.x', '/sink:show']
  - name: set_to_show
    callbacks: ['/detector:settings', '/detector:call-1.x', '/sink:show']
"""


def test_every_key():
    tasks = loads(EVERYTHING, 'all.yaml')
    assert (tasks.workers, tasks.file, tasks.text) == (7, 'all.yaml', EVERYTHING)
    frame, call, settings, tick, show = tasks.callbacks
    assert (frame.node, frame.name, frame.key) == (
        '/camera/driver', 'frame', '/camera/driver:frame')
    assert (frame.kind, frame.topics, frame.period_ns, frame.timer_period_ns) == (
        'subscription', ('/camera/raw',), 50_000_000, None)
    assert (frame.release_from, frame.dag, frame.on_late, frame.max_active_jobs) == (
        'header_stamp', 'camera', 'abort', 3)
    assert (frame.publishes, frame.group, frame.line) == (('/image', '/info'), 'io', 6)
    assert (frame.execution_time.quantiles_ns, frame.execution_time.percent) == (
        (3_000_000,), (50.0,))
    assert (call.kind, call.topics, call.reads) == (
        'sync', ('/image', '/info'), ('/set', 'settings'))
    assert call.execution_time.quantiles_ns == (1_000, 2_500, 1_000_000)
    assert call.execution_time.percent == (0.0, 50.0, 100.0)
    assert (call.period_ns, call.deadline_ns, call.group, call.dag) == (None, None, None, None)
    assert (call.release_from, call.on_late, call.max_active_jobs) == ('arrival', None, None)
    assert (settings.kind, settings.service, settings.topics, settings.period_ns) == (
        'service', '/detector/set', (), 1_000_000_000)
    assert (tick.kind, tick.timer_period_ns, tick.period_ns, tick.deadline_ns, tick.line) == (
        'timer', 20_000_000, 20_000_000, 60_000_000_000, 30)
    assert show.execution_time.quantiles_ns == (0, 5_000)
    assert show.execution_time.percent == (10.0, 99.9)
    assert [(d.name, d.release_from, d.on_late, d.max_active_jobs) for d in tasks.dags] == [
        ('camera', 'header_stamp', 'abort', 3), ('/detector', 'arrival', None, None),
        ('tick', 'arrival', None, None)]
    assert [(e.reader, e.topic, e.writers) for e in tasks.queue_edges] == [
        ('/detector:call-1.x', '/set', ('/detector:settings',)),
        ('/detector:call-1.x', None, ('/detector:settings',))]
    assert [(p.name, len(p.callbacks)) for p in tasks.paths] == [
        ('frame_to_show', 3), ('set_to_show', 3)]


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


HEAD = 'nodes:\n- node: /a\n  callbacks:\n  - {name: t, timer: 1ms, deadline: 1ms}\n'


@pytest.mark.parametrize('text, says', [
    (HEAD + '', "'mddag' is missing: add 'mddag:'"),
    (f'mddag: 2 {MARK}\n' + HEAD, "'2' is no known version"),
    (f'mddag: {MARK}\n' + HEAD, "'mddag' has no value"),
    ('mddag: 1\n', "'nodes' is missing"),
    (f'mddag: 1\nnodes: {MARK}\n', "'nodes' has no value"),
    (f'mddag: 1\nnodes: [] {MARK}\n', "'nodes': the list is empty"),
    (f'mddag: 1\nnodes:\n- /a {MARK}\n',
     "node 1: the text '/a' is no mapping: write one with the keys node, callbacks"),
    (f'mddag: 1\nnode: [] {MARK}\n', "unknown key 'node': did you mean 'nodes'?"),
    (f'mddag: 1\nxyz: [] {MARK}\n',
     "unknown key 'xyz': use mddag, arguments, include, workers, nodes, processes, paths"),
    (f'mddag: 1\nworkers: 0 {MARK}\n' + HEAD, 'from 1 to 4096'),
    (f'mddag: 1\nworkers: 4097 {MARK}\n' + HEAD, 'from 1 to 4096'),
    (f'mddag: 1\nworkers: seven {MARK}\n' + HEAD, "'workers': 'seven' is no integer from 1"),
    (f'mddag: 1\nworkers: "7" {MARK}\n' + HEAD, "'7' is in quotes: remove them"),
    (f'mddag: 1\nworkers: {"9" * 5000} {MARK}\n' + HEAD, 'is no integer'),
])
def test_head(text, says):
    # Without a line of its own to blame, the mapping that lacks something starts at the top.
    if MARK not in text:
        text = text.replace('\n', f' {MARK}\n', 1)
    assert says in str(error(text))


@pytest.mark.parametrize('entry, says', [
    (f'node: a {MARK}', ["'a' is not an absolute node name: write it in full, as '/a'"]),
    (f'node: /a//b {MARK}', ["'/a//b' is not a valid node name"]),
    (f'node: /a-b {MARK}', ['not a valid node name']),
    (f'node: "/a\\nb" {MARK}', ["'/a\\nb' is not a valid"]),
    (f'node: /{"a" * 300} {MARK}', ['too long']),
    (f'node: [/a] {MARK}', ["node 1: 'node': a list is no single value: write a text"]),
    (f'node: {MARK}', ["'node' has no value"]),
    (f'nod: /a {MARK}', ["unknown key 'nod': did you mean 'node'?"]),
])
def test_node_names(entry, says):
    nodes_error(
        f'- {entry}\n  callbacks:\n  - {{name: t, timer: 1ms, deadline: 1ms}}\n', *says)


@pytest.mark.parametrize('entries, says', [
    # names
    ([f'timer: 1ms {MARK}'], ["callback 1 of node '/a': 'name' is missing"]),
    ([f'name: "a b" {MARK}'], ["'a b' is not a valid callback name"]),
    ([f'name: {"n" * 300} {MARK}'], ['too long']),
    # unknown keys
    (['name: t', f'subscribtion: /x {MARK}'],
     ["callback 1 of node '/a': unknown key 'subscribtion': did you mean 'subscription'?"]),
    (['name: t', f'deadine: 1ms {MARK}'], ["did you mean 'deadline'?"]),
    (['name: t', f'qqq: 1ms {MARK}'], ["unknown key 'qqq': use name, timer, subscription"]),
    (['name: t', f'"tim\\ner": 1ms {MARK}'], ["'tim\\ner': did you mean 'timer'?"]),
    (['name: t', f'{"k" * 1000}: 1ms {MARK}'], ['unknown key']),
    # what starts it
    ([f'name: t {MARK}', 'deadline: 1ms'],
     ["callback '/a:t': nothing says what starts the callback: add one of timer, subscription"]),
    (['name: t', 'timer: 1ms', f'subscription: /x {MARK}'],
     ["'timer', 'subscription' exclude each other"]),
    (['name: t', f'subscription: x {MARK}'], ["'subscription': 'x' is not an absolute topic"]),
    (['name: t', f'subscription: [/x, /y] {MARK}'], ["'subscription': a list is no single value"]),
    (['name: t', f'subscription: {MARK}'], ["'subscription' has no value"]),
    (['name: t', f'subscription: /{"x" * 247} {MARK}'], ['at most 247']),
    (['name: t', f'sync: /x {MARK}'], ["'sync': the text '/x' is no list: write a list"]),
    (['name: t', f'sync: [/x] {MARK}'],
     ["the list is too short: give at least 2, or write 'subscription:'"]),
    (['name: t', f'sync: [/x, /x] {MARK}'], ["'/x' is listed twice"]),
    (['name: t', 'sync:', '- /x', f'- [/y] {MARK}'], ["'sync': a list is no single"]),
    (['name: t', f'service: /x/ {MARK}'], ['not a valid service name']),
    # times
    (['name: t', f'timer: 100 {MARK}'],
     ["callback '/a:t': 'timer': '100' has no unit: add one, as '100ms' or '100s'"]),
    (['name: t', f'timer: often {MARK}'], ['not a time']),
    (['name: t', f'timer: [1ms] {MARK}'], ["'timer': a list is no single value"]),
    (['name: t', f'timer: {MARK}'], ["'timer' has no value"]),
    (['name: t', 'timer: 1ms', f'period: 2ms {MARK}'],
     ['period of 2ms is not that of its timer, 1ms']),
    (['name: t', 'timer: 1ms', f'deadline: {{}} {MARK}'], ["'deadline': a mapping is no single"]),
    # execution times
    (['name: t', 'timer: 1ms', f'execution_time: [3ms] {MARK}'],
     ["callback '/a:t': 'execution_time': a list is no mapping: write one with"]),
    (['name: t', 'timer: 1ms', f'execution_time: {{}} {MARK}'], ["'quantiles_us' is missing"]),
    (['name: t', 'timer: 1ms', f'execution_time: {{quantiles: [1]}} {MARK}'],
     ["did you mean 'quantiles_us'?"]),
    (['name: t', 'timer: 1ms', f'execution_time: {{quantiles_us: []}} {MARK}'], ['is empty']),
    (['name: t', 'timer: 1ms', f'execution_time: {{quantiles_us: [1, x]}} {MARK}'],
     ["'x' is not a number"]),
    (['name: t', 'timer: 1ms', f'execution_time: {{quantiles_us: [1, .nan]}} {MARK}'],
     ["'.nan' is not a number"]),
    (['name: t', 'timer: 1ms', f'execution_time: {{quantiles_us: [1, 1e999]}} {MARK}'],
     ["'1e999' is not a number"]),
    (['name: t', 'timer: 1ms', f'execution_time: {{quantiles_us: [2, 1]}} {MARK}'],
     ['rising order']),
    (['name: t', 'timer: 1ms', f'execution_time: {{quantiles_us: [-1, 1]}} {MARK}'],
     ['negative']),
    (['name: t', 'timer: 1ms', f'execution_time: {{quantiles_us: [1, 1e12]}} {MARK}'],
     ['makes no sense']),
    (['name: t', 'timer: 1ms', f'execution_time: {{quantiles_us: [1, 2], percent: [1]}} {MARK}'],
     ['the number of shares is 1, that of quantiles 2']),
    (['name: t', 'timer: 1ms',
      f'execution_time: {{quantiles_us: [1, 2], percent: [5, 5]}} {MARK}'], ['do not rise']),
    (['name: t', 'timer: 1ms',
      f'execution_time: {{quantiles_us: [1, 2], percent: [1, 101]}} {MARK}'], ['0 and 100']),
    (['name: t', 'timer: 1ms', 'execution_time:', '  quantiles_us: [1,', f'    x] {MARK}'],
     ["'x' is not a number"]),
    # lists of names
    (['name: t', 'timer: 1ms', f'publishes: /x {MARK}'], ['write a list, as [a, b]']),
    (['name: t', 'timer: 1ms', 'publishes:', '- /x', f'- x {MARK}'], ["'publishes': 'x' is not"]),
    (['name: t', 'timer: 1ms', 'publishes:', '- /x', f'- /x {MARK}'], ["'/x' is listed twice"]),
    (['name: t', 'timer: 1ms', f'reads: [a b] {MARK}'], ["'a b' is not a valid callback name"]),
    (['name: t', 'timer: 1ms', f'reads: ["/b:c"] {MARK}'], ['names a callback with its node']),
    (['name: t', 'timer: 1ms', f'reads: [/b c] {MARK}'], ['not a valid topic name']),
    # words
    (['name: t', 'timer: 1ms', f'release_from: arival {MARK}'], ["did you mean 'arrival'?"]),
    (['name: t', 'timer: 1ms', f'release_from: 7 {MARK}'],
     ["'7' is not known: use arrival, source_timestamp, header_stamp"]),
    (['name: t', 'timer: 1ms', f'on_late: stop {MARK}'], ['use continue, demote, abort']),
    (['name: t', 'timer: 1ms', f'on_miss: abort {MARK}'],
     ["unknown key 'on_miss': write 'on_late:' instead"]),
    (['name: t', 'timer: 1ms', f'keep: last {MARK}'], ['use all, newest']),
    (['name: t', 'timer: 1ms', f'importance: hgh {MARK}'], ["did you mean 'high'?"]),
    (['name: t', 'timer: 1ms', f'tolerate: 5% {MARK}'],
     ["'tolerate': '5%' is no tolerance", "write how many of how many, as '1 of 100'"]),
    (['name: t', 'timer: 1ms', f'tolerate: 3 of 3 {MARK}'], ['and fewer than all']),
    (['name: t', 'timer: 1ms', f'tolerate: 0 of 3 {MARK}'], ['at least 1 miss']),
    (['name: t', 'timer: 1ms', f'max_active_jobs: 0 {MARK}'], ['from 1 to 1000000']),
    (['name: t', 'timer: 1ms', f'group: a/b {MARK}'], ['not a valid callback group name']),
    (['name: t', 'timer: 1ms', f'dag: a@b {MARK}'], ['not a valid DAG name']),
    (['name: t', 'timer: 1ms', f'dag: [a] {MARK}'], ["'dag': a list is no single"]),
])
def test_callback_entries(entries, says):
    lines = '\n'.join(f'    {entry}' for entry in entries)
    nodes_error(f'- node: /a\n  callbacks:\n  - {lines[4:]}\n', *says)


def test_overload_keys():
    tasks = loads("""
        mddag: 1
        nodes:
          - node: /n
            callbacks:
              - {name: t, timer: 10ms, publishes: [/a], keep: newest, on_late: demote}
              - {name: s, subscription: /a, deadline: 10ms, keep: newest, importance: high,
                 tolerate: 2 of 50}
    """)
    source, sink = tasks.callbacks
    assert (source.keep, source.importance, source.tolerate) == ('newest', 'normal', None)
    assert (sink.keep, sink.importance, sink.tolerate) == ('newest', 'high', WeaklyHard(2, 50))
    assert (str(sink.tolerate), tasks.dags[0].on_late) == ('2 of 50', 'demote')


PATHS = """\
mddag: 1
nodes:
  - node: /a
    callbacks:
      - {name: t, timer: 1ms, publishes: [/x]}
      - {name: s, subscription: /x, deadline: 1ms}
      - {name: u, timer: 1ms, dag: u, deadline: 1ms, reads: [s, /x]}
paths:
"""


@pytest.mark.parametrize('text, says', [
    (f'- name: p\n  callbacks: ["/a:t", "/a:n"] {MARK}', "unknown callback '/a:n'"),
    (f'- name: p\n  callbacks:\n  - /a:t\n  - /aa:s {MARK}', "did you mean '/a:s'?"),
    (f'- name: p\n  callbacks: ["/a:s", "/a:t"] {MARK}',
     "path 'p': no trigger or queue edge leads from '/a:s' to '/a:t'"),
    (f'- name: p\n  callbacks:\n  - /a:t\n  - /a:s\n  - /a:u\n  - /a:t {MARK}',
     "'/a:t' is listed twice"),
    (f'- name: p\n  callbacks:\n  - /a:u\n  - /a:s {MARK}', "from '/a:u' to '/a:s'"),
    (f'- name: p\n  callbacks: [t, "/a:s"] {MARK}', "'t' names no callback"),
    (f'- name: p\n  callbacks: ["/a:t"] {MARK}', 'too short: give at least 2'),
    (f'- name: p\n  callbacks: [] {MARK}', 'is empty'),
    (f'- name: p {MARK}', "'callbacks' is missing"),
    (f'- callbacks: ["/a:t", "/a:s"] {MARK}', "'name' is missing"),
    (f'- name: p\n  callback: x {MARK}', "did you mean 'callbacks'?"),
    (f'- name: p\n  callbacks: ["/a:t", "/a:s"]\n'
     f'- name: p {MARK}\n  callbacks: ["/a:t", "/a:s"]', "path 'p': this name is taken"),
    (f'- p {MARK}', "path 1: the text 'p' is no mapping"),
])
def test_paths(text, says):
    assert says in str(error(PATHS + text + '\n'))


def test_paths_run_over_trigger_and_queue_edges():
    tasks = loads(PATHS + """
  - {name: variable, callbacks: ['/a:t', '/a:s', '/a:u']}
  - {name: take, callbacks: ['/a:t', '/a:u']}
""")
    assert [path.name for path in tasks.paths] == ['variable', 'take']
