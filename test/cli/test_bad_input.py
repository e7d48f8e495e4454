# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Bad input of each command: one line on standard error, status 2, and nothing is written."""

import json

from mddag_executor.cli import main as program
import numpy as np
import pytest

GRAPH = """\
mddag: 1
workers: 1
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 20ms, publishes: [/a], dag: one, execution_time: 1ms}
      - {name: x, subscription: /a, deadline: 5ms, execution_time: 1ms}
  - {node: /m, callbacks: [{name: t, timer: 20ms, deadline: 9ms, execution_time: 1ms}]}
"""
TIMES = {'one': {'/n:t': 1, '/n:x': 1}, '/m': {'/m:t': 1}}


@pytest.fixture(scope='module')
def files(tmp_path_factory):
    """Give a folder with good and bad files."""
    folder = tmp_path_factory.mktemp('files')
    for name, text in {
            'g.yaml': GRAPH, 'empty.yaml': '', 'no_times.yaml': GRAPH.replace(
                ', execution_time: 1ms', ''),
            'wrong.yaml': GRAPH.replace('timer: 20ms, publishes', 'tmer: 20ms, publishes'),
            'unpublished.yaml': GRAPH.replace('subscription: /a', 'subscription: /b'),
            'busy.yaml': GRAPH.replace('execution_time: 1ms', 'execution_time: 90ms'),
            'other.yaml': GRAPH.replace('/n', '/other').replace('/m', '/another'),
            'nodes.yaml': 'processes: {p: [/x]}\n', 'times.json': json.dumps(TIMES),
            'no.json': '{', 'list.json': '[]', 'typo.json': json.dumps({'oen': TIMES['one']}),
            'few.json': json.dumps({'one': {'/n:t': 1}}),
            'more.json': json.dumps({'one': {**TIMES['one'], '/n:y': 1}}),
            'zero.json': json.dumps({**TIMES, 'one': {'/n:t': 0, '/n:x': 1}}),
            'hostile.json': json.dumps({'one': {'/n:t': '\x1b[31m\n', '/n:x': 1}})}.items():
        (folder / name).write_text(text)
    (folder / 'binary.yaml').write_bytes(bytes(range(256)))
    (folder / 'latin.yaml').write_bytes(b'mddag: 1\n# \xe4\n')
    np.savez(folder / 'few.npz', **{'/n:t': [1]})
    (folder / 'link').symlink_to('link')
    (folder / 'folder').mkdir()
    (folder / 'full').mkdir()
    (folder / 'full' / 'file').touch()
    assert program.main(['simulate', str(folder / 'g.yaml'), '-q', '--duration', '1s', '--trace',
                         str(folder / 'run.mcap')]) == 0
    return folder


@pytest.mark.parametrize(('command', 'line'), [
    # the command line
    ('graph check', 'mddag graph check: the following arguments are required: GRAPH: see '),
    ('simulate g.yaml --speed 3', "mddag simulate: there is no option '--speed': did you mean '-"),
    ('simulate g.yaml --workers 0',
     "mddag simulate: argument --workers: '0' is not an integer from 1 to 4096: see "),
    ('simulate g.yaml --workers 4097', 'mddag simulate: argument --workers: '),
    ('simulate g.yaml --duration 3',
     "mddag simulate: argument --duration: '3' has no unit: add one, as '3ms' or '3s' (ns, us, "),
    ('simulate g.yaml --duration=-3s', "mddag simulate: argument --duration: '-3s' is not a time"),
    ('simulate g.yaml --duration 0s', "mddag simulate: argument --duration: '0s' is too short"),
    ('simulate g.yaml --judge me', 'mddag simulate: argument --judge: invalid choice'),
    ('simulate g.yaml --utilisation nan',
     "mddag simulate: argument --utilisation: 'nan' is not a number above zero"),
    ('slack g.yaml --utilisation 1e300', "mddag slack: argument --utilisation: '1e300' is not a"),
    ('simulate g.yaml --policy edf',
     "policy 'edf': there is no such policy: choose one of rad, rm, wc, fifo, gedf, dm, "),
    ('evaluate g.yaml --seed -1',
     "mddag evaluate: argument --seed: '-1' is not an integer from 0 to 2**64 - 1"),
    ('evaluate g.yaml --policies rad,rad', "--policies: 'rad' is listed twice: name each once"),
    ('diff run.mcap run.mcap --tolerance 5', "mddag diff: argument --tolerance: '5' is no share"),
    # files to read
    ('graph check none.yaml', 'none.yaml: no such file or directory: check the path'),
    ('explain none.mcap', 'none.mcap: no such file or directory: check the path'),
    ('simulate g.yaml --execution-times none.json', 'none.json: no such file or directory: check'),
    ('simulate g.yaml --execution-times folder', 'folder: is a directory: name a file'),
    ('simulate - --execution-times -', '-: standard input can be only one of execution times and'),
    ('graph check empty.yaml',
     "empty.yaml: the file is empty: write a declaration that starts with 'mddag: 1'"),
    ('graph check binary.yaml', 'binary.yaml'),
    ('graph assign-deadlines latin.yaml', 'latin.yaml:2: this is not UTF-8 text: save the file'),
    ('graph check wrong.yaml',
     "wrong.yaml:6: callback 1 of node '/n': unknown key 'tmer': did you mean 'timer'?"),
    ('graph check unpublished.yaml',
     "unpublished.yaml:7: callback '/n:x': no callback publishes '/b': add it to a "),
    ('simulate no_times.yaml',
     'no_times.yaml:6: /n:t (and 2 more callbacks) declares no execution_time: add one, or gi'),
    ('graph analyse no_times.yaml',
     'no_times.yaml:6: /n:t (and 2 more callbacks) declares no execution_time: add one'),
    ('graph from-caret times.json', 'times.json: this is not an architecture file of CARET: '),
    # execution times
    ('simulate g.yaml --execution-times no.json', 'no.json:1: not usable JSON ('),
    ('simulate g.yaml --execution-times list.json', 'list.json: not an object of objects: write'),
    ('simulate g.yaml --execution-times typo.json', "typo.json: DAG 'oen' is not in g.yaml: its"),
    ('simulate g.yaml --execution-times few.json', 'few.json: no execution time for /n:x of DAG '),
    ('simulate g.yaml --execution-times more.json', "more.json: '/n:y' is not a vertex of DAG on"),
    ('simulate g.yaml --execution-times zero.json', 'zero.json: execution time of /n:t of DAG on'),
    ('simulate g.yaml --execution-times hostile.json', 'hostile.json: execution time of /n:t of'),
    # files to write
    ('graph check g.yaml --json none/out.json', 'none/out.json: there is no directory none: make'),
    ('graph check g.yaml --json link/out.json', 'link/out.json: there is no directory link: make'),
    ('graph check g.yaml --json folder', 'folder: this is a directory: name a file'),
    ('simulate g.yaml --trace -', '--trace -: it is not written to standard output: name a file'),
    ('graph assign-deadlines g.yaml --json -',
     '-: standard output can be only one of json and output: name a file for each other one'),
    ('graph draw g.yaml -o out.jpeg', 'out.jpeg: no ending that says what to draw: use one of .s'),
    ('replay run.mcap --report g.yaml', '--report g.yaml: a report is an HTML file: let its name'),
    ('export run.mcap -o out.xlsx', '-o out.xlsx: it is not known what to write: let the name en'),
    ('export run.mcap -o out.pftrace --rows jobs', '--rows: a .pftrace gets both, executions and'),
    ('export run.mcap -o none/out/', 'none/out/: there is no directory none: make it first'),
    # the laboratory
    ('evaluate g.yaml --first-run -1',
     "mddag evaluate: argument --first-run: '-1' is not an integer from 0 up"),
    ('evaluate g.yaml --runs 99999999999', 'runs: 99999999999 is too many: give at most '),
    ('evaluate folder', 'folder: there is no *.yaml in this folder: name a declaration, or make'),
    ('evaluate g.yaml --samples g.yaml', 'g.yaml: this is no .npz file: write one array of measu'),
    ('evaluate g.yaml --samples none.npz', 'none.npz: no such file or directory: check the path'),
    ('evaluate g.yaml --samples few.npz', 'few.npz: no values for /n:x: add an array of that nam'),
    ('evaluate g.yaml --plot out.gif', 'out.gif: the ending names no kind of picture: use one of'),
    ('evaluate g.yaml --dask nonsense', '--dask nonsense: '),
    ('graph place g.yaml --processes 2 --together /x -o out.yaml', "node '/x': g.yaml does not d"),
    ('graph place g.yaml --processes 1 --apart /n,/m -o out.yaml', '--apart /n,/m: these are 2 n'),
    ('graph assign-deadlines g.yaml --target 1', '--target 1: it is out of range: give a ratio '),
    ('graph assign-deadlines g.yaml --target 0.99 --runs 9', '--target 0.99: 9 runs cannot show'),
    ('graph assign-deadlines busy.yaml --target 0.95 --duration 200ms --runs 100',
     '--target 0.95: no scale with deadlines up to half of a run reaches it (the best '),
    ('generate --sets 3', '--sets: several declarations make a folder: name one with -o OUT'),
    ('generate --sets 9999999 -o out', '--sets 9999999: it is too many: give at most 100000'),
    ('generate --sets 3 -o full', 'full: this folder holds other files, for instance file: name'),
    ('generate --sets 3 -o none/out', 'none/out: there is no directory none: make it first'),
    ('generate --utilisation 0.6:0.2 --sets 3 -o out', '--utilisation 0.6:0.2: one task set has'),
    ('generate --utilisation 0.2:0.6', '--utilisation 0.2:0.6: one task set has one, and the sm'),
    ('generate --sinks 5 --vertices 5', '--sinks 5: a DAG of 5 vertices has at most 4: give few'),
    # placement
    ('graph place g.yaml --processes 4 -o out.yaml',
     '--processes 4: only 2 nodes, or groups of nodes, can be placed: give fewer processes'),
    ('graph place g.yaml --processes 1 --trace run.mcap --utilisation 0.2 -o out.yaml',
     '--utilisation: execution times are those of --trace: leave one of them out'),
    # recordings
    ('replay folder', 'folder: is a folder without a trace: give a trace, an .mcap file'),
    ('replay run.mcap other.yaml',
     'run.mcap: none of the callbacks of other.yaml is in it: it has /n:t, /n:x, /m:t: '),
    ('replay run.mcap --workers 2', '--workers: a run is replayed as it was recorded: add --resc'),
    ('replay run.mcap --reschedule --seed 1', '--seed: a trace has its own execution times: lea'),
    ('replay run.mcap --reschedule --callbacks', '--callbacks: it shows what was recorded: leave'),
    ('replay run.mcap --from 2s --to 1s', '--to: the part ends before it begins: give a time af'),
    ('replay run.mcap --to 1s --skip 1s', '--skip: the part begins with --from: leave one of the'),
    ('replay run.mcap --offset p=1ms', '--offset: one trace has one clock: give the traces of al'),
    ('diff - -', '-: standard input can be only one of first and second: name a file for each'),
    # running nodes
    ('run --synthetic sleep', '--synthetic: it is about the nodes of a declaration: give a GRAPH'),
    ('run g.yaml --node a/b --utilisation 1', '--utilisation: it scales synthetic nodes only: ad'),
    ('run g.yaml', 'mddag run: one of the arguments --node --synthetic is required'),
    ('run g.yaml --synthetic sleep --ros-args -r x', '--ros-args -r x: '),
    ('run g.yaml --node nowhere:main', '--node nowhere:main: there is no module'),
    ('run no_times.yaml --synthetic sleep --utilisation 0.5', 'no_times.yaml'),
    ('run --node a:b --processes 2', '--processes: it is about the nodes of a declaration'),
    ('run --node a:b --process x', '--process: it is about the nodes of a declaration'),
    ('run --node a:b --fail-on-miss', '--fail-on-miss: without a GRAPH no deadline is judged'),
    ('run --node nowhere:main --trace r.mcap', '--node nowhere:main: there is no module'),
    ('run g.yaml --synthetic sleep --diagnostics 1ms', 'diagnostics_period: 1000000 ns is too s'),
    ('run g.yaml --synthetic sleep --processes 0', '--processes 0: give 1 or more, or a file'),
])
def test_bad_input(files, call, monkeypatch, command, line):
    monkeypatch.chdir(files)
    before = sorted(files.rglob('*'))
    status, out, err = call(*command.split())
    assert (status, out) == (2, '')
    assert err.startswith(f'error: {line}'), err
    assert err.count('\n') == 1 and '\x1b' not in err
    assert sorted(files.rglob('*')) == before, 'nothing is left behind'
