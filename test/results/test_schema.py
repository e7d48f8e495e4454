# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The types of results, their JSON Schema and the page about them.

The fixtures `call` and `mddag` check every result that a test writes; here is what that needs.
"""

import copy
import json
import os
from pathlib import Path
import subprocess
import sys

import jsonschema
from mddag_executor.cli import verbs
from mddag_executor.cli.parsing import verb_parser
from mddag_executor.results import schema as module
from mddag_executor.results.schema import RESULTS, schema
import pytest

from ..json_results import result_errors

DOCS = Path(__file__).resolve().parents[2] / 'docs'
BAG = DOCS.parent / 'bags' / 'demo_short.mcap'
MARK = '<!-- the keys -->\n'


@pytest.fixture
def result(call):
    return call('replay', BAG, '--json', '-').result


def test_every_verb_with_json_has_a_type():
    """So that the fixtures check the results of all verbs."""
    with_json = [verb for verb in verbs.VERBS if '--json' in verb_parser(
        f'mddag {verb}', verbs.load(verb), verbs.VERBS[verb]).format_help()]
    assert sorted(with_json) == sorted(RESULTS)


@pytest.mark.parametrize('verb', [None, *RESULTS])
def test_it_is_a_schema_in_which_all_is_described(verb):
    found = schema(verb)
    jsonschema.Draft7Validator.check_schema(found)
    for name, kind in found['definitions'].items():
        assert kind['description'].endswith('.'), name
        for key, about in kind['properties'].items():
            assert about['description'][-1] in '.…', (name, key)


def spoiled(result, change):
    result = copy.deepcopy(result)
    change(result)
    return result_errors('replay', result)


@pytest.mark.parametrize(('change', 'about'), [
    (lambda r: r.pop('dags'), "$: 'dags' is a required property"),
    (lambda r: r.update(extra=1), "'extra' was unexpected"),
    (lambda r: r['recording'].update(trace=1), "$.recording.trace: 1 is not of type 'string'"),
    (lambda r: next(iter(r['dags']['control']['sinks'].values())).pop('slack_ns'),
     "'slack_ns' is a required property"),
    (lambda r: r.update(workers='7'), "$.workers: '7' is not of type 'integer'"),
    (lambda r: r['worker_use']['over_time']['busy_ns'].append(0.5), 'not of type'),
    (lambda r: r['misses']['causes'].update(waited=None), 'not of type'),
])
def test_a_result_of_another_form_is_found(result, change, about):
    assert result_errors('replay', result) == []
    wrong = spoiled(result, change)
    assert about in ' '.join(wrong)


def test_a_user_may_ignore_new_keys(result):
    jsonschema.validate({**result, 'new': 1}, schema('replay'))
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**result, 'new': 1}, schema('replay', closed=True))


def test_the_page_and_the_schema_in_the_docs():
    """With UPDATE_GOLDEN in the environment, write them."""
    page, file = DOCS / 'json.md', DOCS / 'results.schema.json'
    before, mark, keys = page.read_text(encoding='utf-8').partition(MARK)
    assert mark
    wanted, tables = json.dumps(schema(), indent=1) + '\n', f'\n{module.page()}'
    if os.environ.get('UPDATE_GOLDEN'):
        page.write_text(before + mark + tables, encoding='utf-8')
        file.write_text(wanted)
        keys = tables
    assert keys == tables, 'run it with UPDATE_GOLDEN=1'
    assert file.read_text() == wanted, 'run it with UPDATE_GOLDEN=1'


def test_the_schema_of_a_verb_as_a_user_prints_it(result):
    done = subprocess.run(
        [sys.executable, '-m', 'mddag_executor.results.schema', 'replay'], check=True,
        capture_output=True, text=True)
    jsonschema.validate(result, json.loads(done.stdout))
    done = subprocess.run(
        [sys.executable, '-m', 'mddag_executor.results.schema', 'draw'], check=False,
        capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith('error: draw: no such verb has a JSON result: choose one of run')
