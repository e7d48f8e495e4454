# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What README and documentation show works, and the documentation builds, offline."""

import ast
import contextlib
import importlib
import inspect
import io
import json
import os
import re
import shlex
import subprocess
import sys

from mddag_executor.cli import main as program
import pytest

from .doc_blocks import blocks, Folder, pages, TOP

PAGES = pages()
LARGEST_IMAGE = 150_000
COMMON = """
mddag: 1
nodes:
  - node: /vehicle
    callbacks:
      - {name: report, timer: 20ms, publishes: [/vehicle/twist], deadline: 20ms}
"""
# The declaration of the first page, which others use.
VISION = next(block.text for block in blocks('docs/start.md')
              if block.mark('file') == 'graph.yaml')
FILES = {
    'docs/declare.md': {'common.yaml': COMMON},
    'docs/laboratory.md': {'graph.yaml': VISION},
    'docs/model.md': {'graph.yaml': VISION},
    'docs/run.md': {'graph.yaml': VISION},
}

# What its commands need besides what every installation has.
EXTRAS = {
    'README.md': ('rclpy',),
    'docs/laboratory.md': ('matplotlib', 'distributed'),
    'docs/figures.md': ('matplotlib',),
    'docs/from_multithreaded.md': ('rclpy',),
    'docs/notebook.md': ('pyarrow', 'pandas', 'duckdb'),
    'docs/patterns.md': ('rclpy',),
    'docs/run.md': ('rclpy',),
    'docs/start.md': ('rclpy',),
    'docs/tables.md': ('pyarrow',),
}


@pytest.mark.timeout(600)
@pytest.mark.parametrize('page', PAGES)
def test_what_a_page_shows_works(page, tmp_path):
    for name in EXTRAS.get(page, ()):
        pytest.importorskip(name)
    found = blocks(page)
    fences = re.findall(r'^ *```', (TOP / page).read_text(encoding='utf-8'), re.MULTILINE)
    assert len(fences) == 2 * len(found), 'a block is overlooked'
    Folder(tmp_path, FILES.get(page)).try_all(found)


# --- commands ------------------------------------------------------------------------------------


def command_lines(page):
    """Return every command line of `mddag` in blocks and between backquotes."""
    text, found = (TOP / page).read_text(encoding='utf-8'), []
    for block in blocks(page):
        if block.language == 'sh':
            lines = block.text.replace('\\\n', ' ').splitlines()
            found += [part.strip() for line in lines
                      for part in re.split(r'&&|\|\|?|;', line.partition(' #')[0])]
    text = re.sub(r'^ *```.*?^ *```$', '', text, flags=re.MULTILINE | re.DOTALL)
    found += [line.replace('\n', ' ') for line in re.findall(r'`([^`]+)`', text)]
    return {re.sub(r'^.*?\bmddag ', '', line) for line in found
            if re.match(r'(\S+=\S+ |chrt \S+ \S+ |ros2 )*(\.venv/bin/)?mddag ', line)}


def known_options(words):
    """Return the options of the verb that a command line names."""
    line = ' '.join([*words, ''])
    verb = next((verb for verb in program.VERBS if line.startswith(f'{verb} ')), None)
    assert verb is not None, f'there is no such verb: {" ".join(words[:2])}'
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        program.run([*verb.split(), '--help'])
    return set(re.findall(r'(?<![\w-])--?[a-z][\w-]*', out.getvalue()))


@pytest.mark.parametrize('page', [page for page in PAGES if page != 'CHANGELOG.md'])
def test_commands_and_options_exist(page):
    for line in command_lines(page):
        words = shlex.split(re.split(r' [|>] ?', line)[0].replace('…', ' '), comments=True)
        if words[0].startswith('-') or words[0].isupper():
            continue  # mddag --help, mddag VERB --help
        used = {word.partition('=')[0].strip('[]') for word in words
                if re.match(r'\[?--?[a-z]', word)}
        if '--ros-args' in used:
            used.discard('-r')
        assert used - known_options(words) - {'--help'} == set(), line


OF_OTHERS = {
    '--dual-session', '--log-level', '--part', '--show-args', '--use-sim-time', '--version'}


def test_messages_name_options_that_exist():
    """A message that advises a removed option sends its reader in a circle."""
    known = {option for verb in program.VERBS for option in known_options(verb.split())}
    for package in ('mddag_executor', 'msg_graph'):
        for path in (TOP / package).rglob('*.py'):
            for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
                text = node.value if isinstance(node, ast.Constant) else None
                if isinstance(text, str) and ' ' in text.strip():
                    named = re.findall(r'(?<![\w-])--[a-z][a-z-]*', text)
                    assert {*named} <= known | OF_OTHERS, f'{path}:{node.lineno}: {text}'


def test_the_page_of_commands_has_the_groups_of_the_help():
    text = (TOP / 'docs' / 'commands.md').read_text(encoding='utf-8')
    groups = {title: re.findall(r'^\* `mddag ((?:(?:graph|import) )?[a-z-]+)', part, re.MULTILINE)
              for title, part in re.findall(r'^### \[(\w+)\]\S+\n(.*?)(?=^##)', text,
                                            re.MULTILINE | re.DOTALL)}
    assert {title: sorted(verbs) for title, verbs in groups.items()} == {
        title: sorted(verbs) for title, verbs in program.TASKS.items()}


def test_pages_of_reference_are_complete(tmp_path):
    from mddag_executor.trace.schema import EVENTS
    trace = (TOP / 'docs' / 'trace.md').read_text(encoding='utf-8')
    assert not [event for event in EVENTS.values()
                if event.provider == 'mddag' and f'`{event.name}`' not in trace]
    out = tmp_path / 'result.json'
    program.run(['replay', str(TOP / 'bags' / 'demo_short.mcap'), '--json', str(out), '-q'])
    result = json.loads(out.read_text(encoding='utf-8'))
    page = (TOP / 'docs' / 'json.md').read_text(encoding='utf-8')
    sink = next(iter(result['dags']['control']['sinks'].values()))
    assert not [key for key in (*result, *sink) if f'`{key}`' not in page]


API = TOP / 'docs' / 'api.md'
API_TABLE = re.compile(r'(?<=<!-- the table -->\n)(?:\|.*\n)*')


def named(path):
    """Return the object that a dotted name means."""
    module, rest = path.split('.'), []
    while True:
        try:
            found = importlib.import_module('.'.join(module))
            break
        except ImportError:
            rest.insert(0, module.pop())
    for name in rest:
        found = getattr(found, name)
    return found


def api_table():
    """Return the names of the page of the API with the first sentences of their texts."""
    rows = []
    for path, options in re.findall(r'^::: (\S+)\n((?:    .*\n)*)',
                                    API.read_text(encoding='utf-8'), re.MULTILINE):
        members = re.search(r'members: \[([^\]]*)\]', options)
        for name in ['', *(members[1].split(', ') if members else ())]:
            full = f'{path}.{name}'.rstrip('.')
            text = (inspect.getdoc(named(full)) or '').partition('\n\n')[0].replace('``', '`')
            rows.append(f'| `{full}` | {" ".join(text.split())} |')
    return '\n'.join(('| name | what it is |', '| --- | --- |', *rows)) + '\n'


def test_the_page_of_the_api_lists_its_names():
    """With UPDATE_GOLDEN in the environment, write the table: readers of a checkout see it."""
    pytest.importorskip('rclpy')
    text = API.read_text(encoding='utf-8')
    if os.environ.get('UPDATE_GOLDEN'):
        text = API_TABLE.sub(lambda match: api_table(), text, count=1)
        API.write_text(text, encoding='utf-8')
    assert API_TABLE.search(text)[0] == api_table(), 'run it with UPDATE_GOLDEN=1'


# --- the site ------------------------------------------------------------------------------------


def test_the_site_builds_without_warnings_and_needs_no_network(tmp_path):
    for name in ('material', 'mkdocs', 'mkdocstrings'):
        pytest.importorskip(name, reason='the extra `docs` is not installed')
    result = subprocess.run(
        [sys.executable, '-m', 'mkdocs', 'build', '--strict', '-d', str(tmp_path / 'site')],
        cwd=TOP, env={**os.environ, 'NO_MKDOCS_2_WARNING': '1'}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False, timeout=150)
    assert result.returncode == 0, result.stdout
    assert 'WARNING' not in result.stdout
    found = list((tmp_path / 'site').rglob('*.html'))
    assert len(found) > len(list((TOP / 'docs').rglob('*.md'))) - 1
    fetched = re.compile(
        r'<(?:script|img|iframe)[^>]*\ssrc="?(?:https?:)?//'
        r'|<link(?![^>]*rel="?(?:canonical|next|prev))[^>]*\shref="?(?:https?:)?//'
        r'|@import|fonts\.g', re.IGNORECASE)
    for path in found:
        hit = fetched.search(path.read_text(encoding='utf-8'))
        assert hit is None, f'{path.name} fetches {hit}'
    api = (tmp_path / 'site' / 'api.html').read_text(encoding='utf-8')
    for name in ('MultiDeadlineExecutor', 'DeadlineMiss', 'read_events', 'TaskSet'):
        assert f'{name}' in api


def test_the_readme_leads_to_every_page():
    links = set(re.findall(r'\]\(docs/(\w+\.md)', (TOP / 'README.md').read_text(encoding='utf-8')))
    pages_of_the_site = {page.name for page in (TOP / 'docs').glob('*.md')}
    assert pages_of_the_site - links == {'index.md'}


def test_the_page_of_the_layout_names_files_that_exist():
    """Those with a folder are there, and the others somewhere."""
    named = set(re.findall(r'`((?:\w+/)*\w+\.(?:py|txt|yaml))`', (
        TOP / 'docs' / 'layout.md').read_text(encoding='utf-8')))
    files = {path.relative_to(TOP).as_posix() for root in ('mddag_executor', 'msg_graph', 'test')
             for path in (TOP / root).rglob('*')}
    assert len(named) > 100
    assert [name for name in sorted(named)
            if not any(f'/{file}'.endswith(f'/{name}') for file in files)] == []


def test_images_and_links():
    texts = {page: (TOP / page).read_text(encoding='utf-8') for page in PAGES}
    for path in (TOP / 'docs' / 'images').iterdir():
        assert path.stat().st_size <= LARGEST_IMAGE, f'{path.name} is too large'
        assert path.name in ''.join(texts.values()), f'{path.name} is on no page'
    for page, text in texts.items():
        for name, anchor in re.findall(r'\]\(([^)#:]+)(?:#([^)]*))?\)', text):
            # those between pages of the site are checked when that is built
            path = (TOP / page).parent / name
            assert page.startswith('docs/') or path.exists(), f'{page}: {name}'
            assert page.startswith('docs/') or not anchor or anchor in anchors(path), (
                f'{page}: {name}#{anchor}')


def anchors(path):
    """Return the anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r'^#+ (.*)$', path.read_text(encoding='utf-8'), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', each).strip().lower().replace(' ', '-') for each in headings}


@pytest.mark.parametrize('page', PAGES)
def test_blocks_begin_after_an_empty_line(page):
    """Else Python-Markdown, which makes the site, shows them as text of the paragraph."""
    text = re.sub(r'^( *)```.*?^\1```$', '', (TOP / page).read_text(encoding='utf-8'),
                  flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r'^ *<!--.*-->$', '', text, flags=re.MULTILINE)
    for paragraph in re.split(r'\n(?: *\n)+', text):
        first, *lines = paragraph.strip('\n').split('\n')
        assert [line for line in lines for begin in (r'#+ ', r'\|', r' *(?:[*-]|\d+\.) ')
                if re.match(begin, line) and not re.match(begin, first)] == []
