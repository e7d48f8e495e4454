# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the README says of declaration, commands and set-up (`test_docs` tries its blocks)."""

from __future__ import annotations

from pathlib import Path
import re

from mddag_executor.cli import main as program
import msg_graph

TOP = Path(__file__).resolve().parent.parent
TEXT = (TOP / 'README.md').read_text(encoding='utf-8')


def block(language: str) -> str:
    found = re.findall(rf'^```{language}\n(.*?)^```$', TEXT, re.MULTILINE | re.DOTALL)
    assert len(found) == 1
    return str(found[0])


def test_the_declaration_is_right() -> None:
    task_set = msg_graph.loads(block('yaml'), name='README.md')
    dag, = task_set.dags
    assert {vertex.name: vertex.deadline_ns for vertex in dag.vertices} == {
        '/camera:capture': None, '/detector:detect': None, '/tracker:track': 90_000_000,
        '/brake:stop': 40_000_000}


def test_it_is_one_page() -> None:
    """What more there is to say stands in docs/."""
    assert len(TEXT.split()) < 1000
    assert len(re.findall(r'^\| --- ', TEXT, re.MULTILINE)) == 1    # a table
    assert len(re.findall(r'^!\[', TEXT, re.MULTILINE)) == 1        # a picture


def test_every_command_exists() -> None:
    verbs = set(re.findall(r'\bmddag ([a-z]+)\b', TEXT))
    assert {'run', 'replay'} <= verbs
    assert verbs - set(program.VERBS) == set()


def test_set_up_is_two_commands() -> None:
    part = TEXT.split('## Try it\n')[1].split('\n## ')[0]
    commands = re.findall(r'```sh\n(.*?)```', part, re.DOTALL)
    assert commands == ['make demo\nmake test\n']
    makefile = (TOP / 'Makefile').read_text(encoding='utf-8')
    assert re.search(r'^demo:', makefile, re.MULTILINE)
    assert re.search(r'^test:', makefile, re.MULTILINE)


def test_launch_arguments_exist() -> None:
    text = (TOP / 'docs' / 'start.md').read_text(encoding='utf-8')
    line, *_ = re.findall(r'^ros2 launch mddag_executor (.*)', text, re.MULTILINE)
    file, *arguments = line.split()
    launch_file = (TOP / 'launch' / file).read_text(encoding='utf-8')
    for argument in arguments:
        assert f"('{argument.split(':=')[0]}'," in launch_file
