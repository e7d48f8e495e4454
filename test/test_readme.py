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

"""What the README shows works."""

from __future__ import annotations

from pathlib import Path
import re
import signal
import subprocess
import sys

from mddag_executor.cli import main as program
import msg_graph
import pytest

TOP = Path(__file__).resolve().parent.parent
TEXT = (TOP / 'README.md').read_text(encoding='utf-8')

# The nodes that the example takes for granted.
NODES = """
from rclpy.node import Node
from std_msgs.msg import Header


class Camera(Node):

    def __init__(self):
        super().__init__('camera')
        self.images = self.create_publisher(Header, '/image', 1)
        self.timer = self.create_timer(0.1, self.capture)

    def capture(self):
        self.images.publish(Header(stamp=self.get_clock().now().to_msg()))


class Detector(Node):

    def __init__(self):
        super().__init__('detector')
        self.create_subscription(Header, '/image', self.detect, 1)
        self.seen = 0

    def detect(self, image):
        self.seen += 1
        print('seen', self.seen, flush=True)
"""


def block(language: str) -> str:
    found = re.findall(rf'^```{language}\n(.*?)^```$', TEXT, re.MULTILINE | re.DOTALL)
    assert len(found) == 1
    return str(found[0])


def test_the_declaration_is_right() -> None:
    task_set = msg_graph.loads(block('yaml'), name='README.md')
    dag, = task_set.dags
    assert [vertex.name for vertex in dag.vertices] == ['/camera:capture', '/detector:detect']
    assert dag.vertices[1].deadline_ns == 80_000_000


def test_the_example_runs(tmp_path: Path) -> None:
    (tmp_path / 'graph.yaml').write_text(block('yaml'))
    (tmp_path / 'my_robot.py').write_text(NODES)
    (tmp_path / 'example.py').write_text(block('python'))
    with subprocess.Popen([sys.executable, 'example.py'], cwd=tmp_path, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        try:
            lines = [process.stdout.readline() for _ in range(3)]
            process.send_signal(signal.SIGINT)  # as a user ends it
            _, errors = process.communicate(timeout=10)
        finally:
            process.kill()
    assert lines == ['seen 1\n', 'seen 2\n', 'seen 3\n'], errors
    # As with rclpy's own executors, spin() ends with one of these after Ctrl-C.
    last = errors.strip().splitlines()[-1:]
    assert not last or re.match(r'KeyboardInterrupt|.*ExternalShutdownException', last[0]), errors
    assert (tmp_path / 'run.mcap').stat().st_size > 0


def test_every_command_exists() -> None:
    verbs = set(re.findall(r'mddag ([a-z]+)\b', ' '.join(re.findall(r'`([^`]+)`', TEXT))))
    assert {'run', 'replay'} <= verbs
    assert verbs - set(program.available()) == set()


def test_set_up_is_two_commands() -> None:
    part = TEXT.split('## Set up\n')[1].split('###')[0]
    commands = re.findall(r'```sh\n(.*?)```', part, re.DOTALL)
    assert commands == ['make demo\nmake test\n']
    makefile = (TOP / 'Makefile').read_text(encoding='utf-8')
    assert re.search(r'^demo:', makefile, re.MULTILINE)
    assert re.search(r'^test:', makefile, re.MULTILINE)


@pytest.mark.parametrize('name', re.findall(r'\]\(([^)#:]+)\)', TEXT))
def test_links_lead_somewhere(name: str) -> None:
    assert (TOP / name).exists()


def test_launch_arguments_exist() -> None:
    line, = re.findall(r'ros2 launch mddag_executor (.*)', TEXT)
    file, *arguments = line.split()
    launch_file = (TOP / 'launch' / file).read_text(encoding='utf-8')
    for argument in arguments:
        assert f"('{argument.split(':=')[0]}'," in launch_file
