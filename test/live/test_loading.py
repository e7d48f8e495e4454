# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Resolving and hosting of ``--node``.

The programs are what people write: scripts installed in an ament prefix, console scripts of a
distribution, modules.  None of them knows of this executor.
"""

from __future__ import annotations

from collections.abc import Callable
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import textwrap
import time
from typing import Any

from mddag_executor.live.hosting import Host
from mddag_executor.live.loading import LoadingError, resolve
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import Executor, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node

TALKER = """\
#!/usr/bin/env python3
import sys

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import String


class Talker(Node):

    def __init__(self):
        super().__init__('talker')
        self.pub = self.create_publisher(String, 'chatter', 10)
        self.create_timer(0.05, self.tick)

    def tick(self):
        self.pub.publish(String(data='hello'))


def main(args=None):
    rclpy.init(args=args)
    node = Talker()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == '__main__':
    main(sys.argv)
"""

LISTENER = """\
import rclpy
from rclpy.node import Node
from std_msgs.msg import String


class Listener(Node):

    def __init__(self):
        super().__init__('listener')
        self.create_subscription(String, 'chatter', self.heard, 10)
        self.n = 0

    def heard(self, message):
        self.n += 1


def main():
    rclpy.init()
    node = Listener()
    rclpy.spin(node)
    node.destroy_node()
    rclpy.shutdown()
    print('listener ended after its spin')


def two():
    return [Listener(), Node('idle')]


def with_arguments(args):
    assert args[1:] == [], args
    return Listener()


def own_executor():
    from rclpy.executors import MultiThreadedExecutor
    rclpy.init()
    node = Listener()
    executor = MultiThreadedExecutor(num_threads=4)
    executor.add_node(node)
    try:
        executor.spin()
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown()
    print('own executor ended')


def events_executor():
    from rclpy.experimental.events_executor import EventsExecutor
    with rclpy.init() or __import__('contextlib').nullcontext():
        executor = EventsExecutor()
        executor.add_node(Listener())
        executor.spin()


def spins_in_thread():
    import threading
    rclpy.init()
    executor = rclpy.executors.SingleThreadedExecutor()
    node = Listener()
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    while rclpy.ok() and node.n < 5:
        __import__('time').sleep(0.01)
    print('heard five')
    rclpy.shutdown()
    thread.join()
    print('thread joined')


def spins_once():
    rclpy.init()
    node = Listener()
    while rclpy.ok() and node.n < 5:
        rclpy.spin_once(node, timeout_sec=0.1)
    print('heard', 'enough' if node.n >= 5 else 'too little')
    node.destroy_node()
    rclpy.shutdown()


def calls_a_service():
    from std_srvs.srv import Trigger
    rclpy.init()
    node = Listener()
    node.create_service(Trigger, 'own', answer)
    client = node.create_client(Trigger, 'own')
    assert client.wait_for_service(5.0)
    future = client.call_async(Trigger.Request())
    rclpy.spin_until_future_complete(node, future, timeout_sec=5.0)
    print('answer:', future.result().message)


def answer(request, response):
    response.message = 'forty-two'
    return response


def shuts_down_in_a_callback():
    rclpy.init()
    node = Listener()
    node.create_timer(0.3, lambda: rclpy.shutdown())
    rclpy.spin(node)
    print('shut down')


def catches_signals():
    import signal
    rclpy.init()
    signal.signal(signal.SIGTERM, lambda *_: None)
    rclpy.spin(Listener())


def leaves_a_thread():
    import threading
    import time
    threading.Thread(target=time.sleep, args=(60,), name='stubborn', daemon=False).start()
    main()


def never_ends():
    main()
    __import__('time').sleep(60)


def prints():
    print('not JSON')
    main()


def blocks_in_a_callback():
    rclpy.init()
    node = Listener()
    node.create_timer(0.2, lambda: __import__('time').sleep(60))
    rclpy.spin(node)


def fails():
    rclpy.init()
    raise RuntimeError('no camera\\nfound')


def exits():
    raise SystemExit(3)


def fails_later():
    rclpy.init()
    rclpy.spin_once(Listener(), timeout_sec=0.2)
    raise RuntimeError('later')


def raises_in_a_callback():
    rclpy.init()
    node = Listener()
    node.create_timer(0.2, lambda: 1 / 0)
    rclpy.spin(node)


def own_context():
    context = rclpy.context.Context()
    rclpy.init(context=context)
    rclpy.spin(Node('alone', context=context))


def other_domain():
    rclpy.init(domain_id=7)


def returns_text():
    return 'text'


def returns_nothing():
    pass


def needs_two(one, two):
    pass


class NoNode:
    pass


NUMBER = 3
"""

GRAPH = """\
mddag: 1
nodes:
  - node: /talker
    callbacks: [{name: tick, timer: 50ms, publishes: [/chatter]}]
  - node: /listener
    callbacks: [{name: heard, subscription: /chatter, deadline: 50ms}]
"""


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a workspace: an ament package, a distribution with a console script, a module."""
    prefix = tmp_path / 'ws'
    index = prefix / 'share' / 'ament_index' / 'resource_index' / 'packages'
    index.mkdir(parents=True)
    (index / 'chat_nodes').touch()
    (index / 'empty_nodes').touch()
    library = prefix / 'lib' / 'chat_nodes'
    library.mkdir(parents=True)
    for name, text in {
        'talker': TALKER, 'shell': '#!/bin/sh\nexit 0\n', 'broken.py': 'def (\n',
        'native': '\x7fELF\x02\x01',
    }.items():
        (library / name).write_text(text)
        (library / name).chmod(0o755)
    site = tmp_path / 'site'
    info = site / 'pip_nodes-1.0.dist-info'
    info.mkdir(parents=True)
    (info / 'METADATA').write_text('Metadata-Version: 2.1\nName: pip-nodes\nVersion: 1.0\n')
    (info / 'entry_points.txt').write_text(
        '[console_scripts]\nlistener = chat:main\nstale = chat:gone\n[other]\nx = chat:main\n')
    (site / 'chat.py').write_text(LISTENER)
    (site / 'half.py').write_text('import not_installed_anywhere\n')
    (site / 'wrong.py').write_text('x = 1\nraise RuntimeError("no licence\\nhere")\n')
    (tmp_path / 'graph.yaml').write_text(GRAPH)
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(prefix))
    monkeypatch.setenv('PYTHONPATH', str(site))
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.chdir(tmp_path)
    for name in ('chat', 'half', 'wrong'):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return tmp_path


# --- resolving -----------------------------------------------------------------------------------

@pytest.mark.parametrize(('spec', 'argv0'), [
    ('chat_nodes/talker', '{world}/ws/lib/chat_nodes/talker'),
    ('pip-nodes/listener', 'listener'),
    ('pip_nodes/listener', 'listener'),
    ('chat:main', 'chat'),
    ('chat:Listener', 'chat'),
])
def test_what_exists_is_found(world: Path, spec: str, argv0: str) -> None:
    program = resolve(spec)
    assert (program.spec, program.argv0) == (spec, argv0.format(world=world))


@pytest.mark.parametrize(('spec', 'message'), [
    ('talker', 'this names no node: write package/executable, module:function'),
    ('', 'this names no node'),
    ('a/b/c', 'this names no node'),
    ('/talker', 'this names no node'),
    ('chat:', 'this names no node'),
    (':main', 'this names no node'),
    ('chat:main()', 'this names no node'),
    ('chat_node/talker', "there is no package 'chat_node': did you mean 'chat_nodes'"),
    ('zzzzzzzz/talker', "there is no package 'zzzzzzzz': source its workspace's setup file"),
    ('chat_nodes/talkr', "package 'chat_nodes' has no executable 'talkr': did you mean 'talker'?"),
    ('chat_nodes/zzz', "has no executable 'zzz': it has broken.py, native, shell, talker"),
    ('empty_nodes/x', "package 'empty_nodes' has no executable 'x': it has none"),
    ('pip-nodes/lisener', "has no executable 'lisener': did you mean 'listener'?"),
    ('pip-nodes/stale', "its entry point 'chat:gone' can't be imported"),
    ('chat_nodes/native', 'native is no Python program, and only Python nodes can run in this '),
    ('chat_nodes/shell', "no Python program, and only Python nodes can run in this process: start "
                         "it by itself with 'ros2 run'"),
    ('chat_nodes/broken.py', 'broken.py is not valid Python (SyntaxError'),
    ('nowhere:main', "there is no module 'nowhere'"),
    ('chat.sub:main', "there is no module 'chat.sub'"),
    ('half:main', "'half' needs the module 'not_installed_anywhere', which is not installed"),
    ('wrong:main', "'wrong' can't be imported (RuntimeError: no licence here, {site}/wrong.py:2)"),
    ('chat:mian', "module 'chat' has no 'mian': did you mean 'main'"),
    ('chat:NoNode', "'NoNode' is a class, but no rclpy node"),
    ('chat:NUMBER', "'NUMBER' is no function and no class, but of type int"),
])
def test_what_does_not_exist_is_said_on_one_line(world: Path, spec: str, message: str) -> None:
    with pytest.raises(LoadingError) as error:
        resolve(spec)
    text = str(error.value)
    assert text.startswith(f'--node {spec}: ')
    assert message.format(site=world / 'site') in text
    assert '\n' not in text


def test_no_ament_index_at_all_is_no_crash(
    world: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv('AMENT_PREFIX_PATH')
    with pytest.raises(LoadingError, match="there is no package 'chat_nodes'"):
        resolve('chat_nodes/talker')
    assert resolve('pip-nodes/listener')


def test_a_module_of_the_current_folder_is_found(
    world: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (world / 'mine_here.py').write_text('def main(): pass\n')
    monkeypatch.setattr(sys, 'path', [p for p in sys.path if p not in ('', str(world))])
    assert resolve('mine_here:main')
    sys.modules.pop('mine_here')


# --- hosting -------------------------------------------------------------------------------------

Mddag = Callable[..., 'subprocess.CompletedProcess[str]']


def run(mddag: Mddag, *specs: str, seconds: float = 1.5) -> tuple[dict[str, Any], str]:
    """Run programs; return the result, and what they printed."""
    nodes = [argument for spec in specs for argument in ('--node', spec)]
    process = mddag(
        'run', 'graph.yaml', *nodes, '--duration', f'{seconds}s', '--json', 'result.json')
    assert process.returncode == 0, process.stderr
    assert 'Traceback' not in process.stderr, process.stderr
    result: dict[str, Any] = json.loads(Path('result.json').read_text())
    return result, process.stdout


def heard(result: dict[str, Any]) -> int:
    sink = result['dags']['/talker']['sinks']['/listener:heard']
    return int(sink['completed'])


@pytest.mark.parametrize(('listener', 'said'), [
    ('pip-nodes/listener', 'listener ended after its spin'),
    ('chat:main', 'listener ended after its spin'),
    ('chat:Listener', ''),
    ('chat:two', ''),
    ('chat:with_arguments', ''),
    ('chat:own_executor', 'own executor ended'),
    ('chat:events_executor', ''),
    ('chat:catches_signals', ''),
])
def test_unmodified_programs_run_on_our_executor(
    world: Path, mddag: Mddag, listener: str, said: str
) -> None:
    result, output = run(mddag, 'chat_nodes/talker', listener)
    assert heard(result) >= 15
    assert result['never_ran'] == []
    assert result['callbacks']['/talker:tick']['ran'] >= heard(result)
    # Every message was attributed to a job of the talker's timer.
    assert result['undeclared'] <= 2
    assert said in output


@pytest.mark.parametrize(('spec', 'lines'), [
    ('chat:spins_in_thread', ['heard five', 'thread joined']),
    ('chat:spins_once', ['heard enough']),
    ('chat:calls_a_service', ['answer: forty-two']),
])
def test_a_program_goes_on_while_its_callbacks_run(
    world: Path, mddag: Mddag, spec: str, lines: list[str]
) -> None:
    _, output = run(mddag, 'chat_nodes/talker', spec, seconds=2.0)
    for line in lines:
        assert line in output.splitlines()


def test_the_run_ends_when_a_callback_shuts_rclpy_down(world: Path, mddag: Mddag) -> None:
    begin = time.monotonic()
    _, output = run(mddag, 'chat_nodes/talker', 'chat:shuts_down_in_a_callback', seconds=30)
    assert time.monotonic() - begin < 10
    assert 'shut down' in output


def test_the_run_ends_when_all_programs_have_ended(world: Path, mddag: Mddag) -> None:
    begin = time.monotonic()
    _, output = run(mddag, 'chat:calls_a_service', seconds=30)
    assert time.monotonic() - begin < 10
    assert 'answer: forty-two' in output


@pytest.mark.parametrize(('spec', 'message'), [
    ('chat:fails', 'it failed while starting (RuntimeError: no camera found, '),
    ('chat:exits', 'it failed while starting (SystemExit: 3'),
    ('chat:own_context', 'node /alone has a context of its own: let it use the default context'),
    ('chat:other_domain', 'it asks for ROS domain 7, and this process is in another: set '),
    ('chat:returns_text', 'it returned a str, which is no rclpy node'),
    ('chat:returns_nothing', 'it ended and neither returned a node nor let one spin'),
    ('chat:needs_two', 'the function requires the arguments one, two'),
])
def test_a_program_that_can_not_start_ends_the_run_with_one_line(
    world: Path, mddag: Mddag, spec: str, message: str
) -> None:
    process = mddag('run', 'graph.yaml', '--node', spec, '--trace', 'out.mcap')
    assert process.returncode == 2
    assert process.stderr.startswith(f'error: --node {spec}: {message}')
    assert process.stderr.count('\n') == 1
    assert not Path('out.mcap').exists()


@pytest.mark.parametrize(('spec', 'message'), [
    ('chat:fails_later', 'RuntimeError: later'),
    ('chat:raises_in_a_callback', 'ZeroDivisionError'),
])
def test_an_exception_during_the_run_comes_out_behind_the_summary(
    world: Path, mddag: Mddag, spec: str, message: str
) -> None:
    process = mddag(
        'run', 'graph.yaml', '--node', 'chat_nodes/talker', '--node', spec, '--duration', '2s')
    assert process.returncode == 70
    assert message in process.stderr.splitlines()[-1]
    assert 'sink jobs due' in process.stdout


@pytest.mark.parametrize(('spec', 'warning'), [
    ('chat:leaves_a_thread', 'threads that nodes started still run and are left behind: stubborn'),
    ('chat:never_ends', '--node chat:never_ends: its main() has not ended in time'),
    ('chat:blocks_in_a_callback', 'a callback has not ended in time; it is left behind'),
])
def test_what_does_not_end_is_left_behind(
    world: Path, mddag: Mddag, spec: str, warning: str
) -> None:
    begin = time.monotonic()
    process = mddag(
        'run', 'graph.yaml', '--node', 'chat_nodes/talker', '--node', spec, '--duration', '1s')
    assert time.monotonic() - begin < 15
    assert process.returncode == 0
    assert warning in process.stderr
    assert 'sink jobs due' in process.stdout


def test_what_nodes_print_stays_out_of_the_json(world: Path, mddag: Mddag) -> None:
    process = mddag('run', 'graph.yaml', '--node', 'chat:prints', '--duration', '0.2s',
                    '--json', '-')
    assert json.loads(process.stdout)['nodes'] == ['chat:prints']
    assert 'not JSON' in process.stderr


def test_ros_arguments_reach_the_nodes(world: Path, mddag: Mddag) -> None:
    (world / 'graph.yaml').write_text(GRAPH.replace('/chatter', '/talk'))
    process = mddag(
        'run', 'graph.yaml', '--node', 'chat_nodes/talker', '--node', 'chat:Listener',
        '--duration', '1s', '--json', '-', '--ros-args', '-r', 'chatter:=talk')
    assert process.returncode == 0, process.stderr
    assert heard(json.loads(process.stdout)) >= 8


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_within_a_second(world: Path, number: int) -> None:
    process = subprocess.Popen(
        [sys.executable, '-m', 'mddag_executor', 'run', 'graph.yaml',
         '--node', 'chat_nodes/talker', '--node', 'chat:main', '--json', 'result.json'],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    time.sleep(3.0)
    begin = time.monotonic()
    os.kill(process.pid, number)
    out, err = process.communicate(timeout=20)
    assert time.monotonic() - begin < 1.5  # with the interpreter's own end
    assert process.returncode == 0
    assert err == ''
    assert 'sink jobs due' in out
    assert 'listener ended after its spin' in out
    assert heard(json.loads(Path('result.json').read_text())) > 5


def test_rclpy_is_as_before_when_the_host_is_left() -> None:
    def parts() -> list[Any]:
        return [
            rclpy.init, rclpy.shutdown, rclpy.spin, rclpy.spin_once, signal.signal,
            *(vars(c).get(name) for c in (Executor, SingleThreadedExecutor, MultiThreadedExecutor)
              for name in ('spin', 'spin_once', 'add_node', 'create_task', 'shutdown'))]

    before = parts()
    context = Context()
    rclpy.init(context=context)
    executor = SingleThreadedExecutor(context=context)
    with Host(executor, lambda: None):
        assert parts() != before
        other = MultiThreadedExecutor(2, context=context)
        node = Node('given', context=context)
        other.add_node(node)
        other.spin_once(timeout_sec=0.01)
        assert executor.get_nodes() == [node]
        assert node.executor is executor
        other.shutdown()
    assert parts() == before
    executor.shutdown()
    context.try_shutdown()


def test_the_scripts_of_these_tests_know_nothing_of_us() -> None:
    assert 'mddag' not in textwrap.dedent(TALKER + LISTENER)
