# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Every example runs to its end as its README says, and does what it claims."""

import json
import os
from pathlib import Path
import re
import subprocess
import sys

EXAMPLES = Path(__file__).resolve().parents[2] / 'examples'
README = (EXAMPLES / 'README.md').read_text(encoding='utf-8')
COMMAND = re.compile(r'^\| \[(\w+)\]\((\S+)\) \| `(python|sh) examples/(\S+)` \|', re.MULTILINE)
COMMANDS = {name: (program, file) for name, _, program, file in COMMAND.findall(README)}


def run(example, *arguments):
    """Run an example as the README says, from elsewhere; return what it printed."""
    file = EXAMPLES / COMMANDS[example][1]
    program = [sys.executable] if file.suffix == '.py' else ['sh']
    done = subprocess.run(
        [*program, str(file), *map(str, arguments)], capture_output=True, text=True, timeout=90,
        stdin=subprocess.DEVNULL, check=False,
        env={**os.environ, 'MDDAG': f'{sys.executable} -m mddag_executor'})
    assert done.returncode == 0, done.stderr
    assert 'Traceback' not in done.stderr, done.stderr
    return done.stdout


def result(example, tmp_path):
    """Run an example that is a `mddag run`; return its result."""
    run(example, '--json', tmp_path / 'result.json')
    return json.loads((tmp_path / 'result.json').read_text())


def test_the_readme_has_every_example():
    assert sorted(COMMANDS) == sorted(path.name for path in EXAMPLES.iterdir() if path.is_dir())
    for program, file in COMMANDS.values():
        assert (EXAMPLES / file).suffix == {'python': '.py', 'sh': '.sh'}[program]
    links = re.findall(r'\]\(([^)]+)\)', README)
    assert [link for link in links if not (EXAMPLES / link).is_file()] == []


def test_hello_deadline():
    printed = re.fullmatch(r'(\d+) images, (\d+) later than 40 ms\n', run('hello_deadline'))
    assert int(printed[1]) >= 29  # of the thirty, one may be open when the future is done


def test_sensor_fusion(tmp_path):
    found = result('sensor_fusion', tmp_path)
    sinks = found['dags']['fusion']['sinks']
    assert set(sinks) == {'/brake:decide', '/map:update', '/viewer:show'}
    # The sync completes once for each pulse, with the leg that made it whole.
    for sink in sinks.values():
        assert 20 <= sink['completed'] <= found['dags']['fusion']['jobs']
    assert sinks['/brake:decide']['response_ns']['min'] >= 45_000_000  # 30 + 10 + 5 ms
    assert found['never_ran'] == []


def test_overload():
    """A short queue has more results in time than a long one, whose images wait too long."""
    ends = {}
    for size, block in re.findall(r'queue of (\d+):\n(.*\n.*\n.*)', run('overload')):
        counts = {name: {end: int(count) for count, end in re.findall(r'(\d+) (\w+)', line)}
                  for name, line in re.findall(r'^  (control|perception): (.*)$', block, re.M)}
        for dag in counts.values():
            assert 0 <= 2 * dag['jobs'] - sum(dag.values()) <= 6  # at most six are open at the end
        # a busy machine may skip a release
        assert 10 * counts['control']['expired'] <= counts['control']['jobs']
        ends[size] = counts['perception']
        # Each is reported as overdue, before it expires.
        reported = re.findall(r'(\d+) perception \w+', block.split('misses:')[1])
        assert sum(map(int, reported)) >= ends[size]['expired']
    assert ends['10']['expired'] + ends['10']['late'] > ends['1']['expired'] + ends['1']['late']
    assert ends['10']['completed'] < ends['1']['completed']


def test_services_and_actions():
    service, action, control = run('services_and_actions').splitlines()
    assert service == 'service: calibrated'
    assert action == 'action: [0, 1, 1, 2, 3, 5, 8, 13, 21, 34, 55, 89]'
    steps, undeclared = re.fullmatch(
        r'control: (\d+) steps, \d+ late; (\d+) undeclared callbacks', control).groups()
    # The service takes 100 ms and the action 200: control went on every 20 ms meanwhile.
    assert int(steps) >= 10
    assert int(undeclared) >= 13


def test_asyncio_service():
    *answers, beats = run('asyncio_service').splitlines()
    assert answers == [
        'rest: slept for 0.2 s', 'read: in a thread of asyncio: True',
        'ask: the other service slept for 0.2 s', 'requests that slept at once: 3']
    # The timer went on while callbacks slept for 0.6 s.
    count, in_time = map(int, re.fullmatch(r'beats: (\d+), in time: (\d+)', beats).groups())
    assert in_time <= count and count >= 10


def test_two_processes(tmp_path):
    found = result('two_processes', tmp_path)
    chain = found['dags']['chain']
    assert set(chain['sinks']) == {'/control:step'}
    sink = chain['sinks']['/control:step']
    assert sink['completed'] >= 20
    # As jobs of the other process' timer, but what waited 0.1 s to be announced: a busy machine.
    assert found['undeclared'] == found['callbacks']['/control:step']['unattributed']
    assert found['undeclared'] < sink['completed'] / 2
    assert '/sensor:read' not in found['callbacks']


def test_numpy_pipeline():
    one, right, two, right_too = run('numpy_pipeline').splitlines()
    assert right == right_too == 'the results are right'
    for workers, line in ((1, one), (2, two)):
        printed = re.fullmatch(
            rf'{workers} workers: (\d+) images, \d+ late; at most (\d+) filters at once, '
            r'(\d+\.\d+) on average', line)
        assert printed is not None, line
        assert int(printed[1]) >= 7
        assert int(printed[2]) == workers  # with two of them, two filters at once


def test_robot():
    *sinks, computing = run('robot').splitlines()
    found = {m[1]: int(m[2]) for m in (re.match(r'(\S+): (\d+) times', s) for s in sinks) if m}
    # on a busy machine, what is overloaded gets a turn in ten deadlines: the operator in 5 s
    assert {*found, 'operator:adjust'} == {
        'brake:check', 'fusion:keep', 'planner:locate', 'controller:locate', 'controller:follow',
        'controller:control', 'operator:adjust'}
    assert min(found.values()) >= 1
    assert computing.startswith('computing in Python: /')


def test_ordinary_robot():
    """The verdicts are what the nodes' own time stamps say."""
    *lines, age, reaction = run('ordinary_robot').splitlines()
    outputs, oldest, judged, judged_oldest = map(int, re.findall(r'\d+', age))
    # the nodes stamp a message a little after the callback began
    assert 0 <= outputs - judged <= 1 and abs(judged_oldest - oldest) <= 60
    assert all(int(n) >= 3 for n in re.findall(r'\d+', reaction))
    found = {m[1]: tuple(map(int, m.groups()[1:])) for m in map(re.compile(
        r'(\S+): itself (\d+) results, (\d+) late; judged (\d+) results, (\d+) late, '
        r'(\d+) not due, (\d+) expired in (\d+) jobs').fullmatch, lines)}
    assert set(found) == {
        '/brake:stop', '/planner:plan', '/tracker:track', '/panel:lamp', '/panel:pressed'}
    own, own_late, completed, late, *_ = found.pop('/tracker:track')
    # on a busy machine the fusion skips a scan, which completes with the next one
    assert own >= 3 and abs(own - completed) <= 2 and own_late <= late
    for own, own_late, completed, late, *_ in found.values():
        assert 0 <= own - completed <= 1    # one may have expired on a busy machine
        assert own_late <= late     # the verdicts also count how late a timer was
    own, own_late, _, _, not_due, expired, jobs = found['/brake:stop']
    assert own_late >= 1
    # releases that the camera skips on a busy machine expire; up to three are open at the end
    assert -1 <= jobs - own - not_due - expired <= 3 and not_due >= own
    assert found['/panel:lamp'][0] == found['/panel:lamp'][-1] == 1
    assert found['/panel:pressed'][0] >= 1


def test_third_party(tmp_path):
    output = run('third_party', '--json', tmp_path / 'result.json')
    heard = re.search(r'^heard (\d+) messages$', output, re.MULTILINE)
    found = json.loads((tmp_path / 'result.json').read_text())
    sink = found['dags']['talk']['sinks']['/listener:heard']
    assert 15 <= sink['completed'] <= int(heard[1])
    assert found['never_ran'] == []
    for program in (EXAMPLES / 'third_party' / 'install' / 'lib').rglob('*.py'):
        assert 'mddag' not in program.read_text(encoding='utf-8').split('"""', 1)[1]


def test_rerun():
    """A changed constant changes contents, a slower callback only times."""
    _, constant, slower = run('rerun').split(':\n')[1:]
    assert re.findall(r'^(/\w+): (\w+), first', constant, re.MULTILINE) == [('/track', 'content')]
    assert re.findall(r'^(/\w+): (\w+), first', slower, re.MULTILINE) == [
        ('/brake', 'timing'), ('/track', 'timing')]
