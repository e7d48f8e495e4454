# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The JSON Schema of the results, and the tables of docs/json.md: both are made from the types.

``python -m mddag_executor.results.schema replay`` prints the schema of the result of `replay`;
without a verb it prints that of all results.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
import inspect
import json
import re
import sys
from types import NoneType, UnionType
from typing import Any, cast, get_args, get_origin, get_type_hints, Union

from mddag_executor.results.comparisons import DiffResult, RerunResult, TopResult
from mddag_executor.results.graphs import AssignResult, CheckResult, PlaceResult
from mddag_executor.results.head import Head
from mddag_executor.results.replays import ExplainResult, ReplayResult, RescheduleResult
from mddag_executor.results.runs import DemoResult, RunOfProcessesResult, RunResult
from mddag_executor.results.simulations import EvaluateResult, SimulateResult, SlackResult

Schema = dict[str, Any]

RESULTS: dict[str, tuple[type, ...]] = {
    'run': (RunResult, RunOfProcessesResult),
    'replay': (ReplayResult, RescheduleResult),
    'explain': (ExplainResult,),
    'diff': (DiffResult,),
    'slack': (SlackResult,),
    'top': (TopResult,),
    'rerun': (RerunResult,),
    'demo': (DemoResult,),
    'simulate': (SimulateResult,),
    'evaluate': (EvaluateResult,),
    'graph check': (CheckResult,),
    'graph place': (PlaceResult,),
    'graph assign-deadlines': (AssignResult,)}
"""By verb the types of its results."""

_ROOT = 'TypedDict'
_PLAIN = {str: 'string', int: 'integer', float: 'number', bool: 'boolean', NoneType: 'null'}


def schema(verb: str | None = None, closed: bool = False) -> Schema:
    """
    Return the JSON Schema (draft 7) of a verb's result, or of all results.

    :param closed: whether keys that are not described are errors; otherwise they are ignored, so
        that results of later versions are valid as well.
    :raises KeyError: if a verb has no result.
    """
    verbs = RESULTS if verb is None else {verb: RESULTS[verb]}
    types = tuple(dict.fromkeys(each for kinds in verbs.values() for each in kinds))
    found = schema_of(types, closed)
    found['title'] = f'mddag {verb} --json' if verb is not None else 'Results of mddag --json'
    for kind in types:
        one, head = found['definitions'][kind.__name__], _object(Head, closed)
        one['properties'] = {**head['properties'], **one['properties']}
        one['required'] = [*head['required'], *one['required']]
    return found


def schema_of(types: Sequence[type], closed: bool = False) -> Schema:
    """Return the JSON Schema of a value that has one of these types; see ``schema``."""
    return {
        '$schema': 'http://json-schema.org/draft-07/schema#',
        'anyOf': [{'$ref': f'#/definitions/{kind.__name__}'} for kind in types],
        'definitions': {kind.__name__: _object(kind, closed) for kind in _reachable(types)}}


def _object(kind: type, closed: bool) -> Schema:
    hints, texts = get_type_hints(kind), descriptions(kind)
    required: set[str] = set(cast(Any, kind).__required_keys__)
    return {
        'type': 'object', 'description': _plain(inspect.getdoc(kind) or ''),
        'properties': {key: {**_value(hint), 'description': _plain(texts[key])}
                       for key, hint in hints.items()},
        'required': [key for key in hints if key in required],
        **({'additionalProperties': False} if closed else {})}


def _value(hint: Any) -> Schema:
    """Return the schema of a value of a type."""
    if hint is Any:
        return {}
    if hint in _PLAIN:
        return {'type': _PLAIN[hint]}
    origin, of = get_origin(hint), get_args(hint)
    if origin is list:
        return {'type': 'array', 'items': _value(of[0])}
    if origin is dict:
        return {'type': 'object', 'additionalProperties': _value(of[1])}
    if origin in (Union, UnionType):
        return {'anyOf': [_value(each) for each in of]}
    return {'allOf': [{'$ref': f'#/definitions/{hint.__name__}'}]}


def _inner(hint: Any) -> Iterator[type]:
    """Yield the types of dictionaries that a type consists of."""
    for each in get_args(hint):
        yield from _inner(each)
    if isinstance(hint, type) and hasattr(hint, '__required_keys__'):
        yield hint


def _reachable(types: Iterable[type]) -> list[type]:
    """Return types and those that they consist of, each once, the containing one first."""
    found = list(types)
    for kind in found:
        for hint in get_type_hints(kind).values():
            found += [each for each in _inner(hint) if each not in found]
    return found


def descriptions(kind: type) -> dict[str, str]:
    """Return the text below each key of a type, inherited keys included."""
    found: dict[str, str] = {}
    source = _classes(kind.__module__)[kind.__name__]
    for base in source.bases:   # the type itself does not know them
        if isinstance(base, ast.Name) and base.id != _ROOT:
            found.update(descriptions(getattr(sys.modules[kind.__module__], base.id)))
    for key, text in zip(source.body, source.body[1:]):
        if isinstance(key, ast.AnnAssign) and isinstance(key.target, ast.Name) and isinstance(
                text, ast.Expr) and isinstance(text.value, ast.Constant):
            found[key.target.id] = inspect.cleandoc(str(text.value.value))
    return found


@cache
def _classes(module: str) -> dict[str, ast.ClassDef]:
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    return {each.name: each for each in tree.body if isinstance(each, ast.ClassDef)}


def _plain(text: str) -> str:
    """Return a text without marks, on one line."""
    return ' '.join(text.replace('`', '').split())


# --- the page ------------------------------------------------------------------------------------

def page() -> str:
    """Return the tables of docs/json.md: a section for each verb, then one for each inner type."""
    results = [each for kinds in RESULTS.values() for each in kinds]
    parts = []
    for verb, kinds in RESULTS.items():
        parts.append(f'## {verb}\n')
        parts.append(_section(kinds[0]))
        parts += [f'### {_title(kind)}\n\n{_section(kind)}' for kind in kinds[1:]]
    parts.append('## Parts of results\n')
    parts += [f'### {_title(kind)}\n\n{_section(kind)}'
              for kind in _reachable(results) if _written(kind) not in results]
    return '\n'.join(parts)


def _written(kind: type) -> type:
    """Return the result that a type is the file of, otherwise the type itself."""
    name = kind.__name__.replace('File', 'Result')
    return next((each for kinds in RESULTS.values() for each in kinds if each.__name__ == name),
                kind)


def _section(kind: type) -> str:
    """Return the text about a type, and the table of its keys; those that it always has first."""
    texts, hints = descriptions(kind), get_type_hints(kind)
    required = cast(Any, kind).__required_keys__
    rows = ''.join(
        f'| `{key}` | {"" if key in required else "optional: "}{_type_text(hints[key])} | '
        f'{" ".join(texts[key].split())} |\n'
        for key in sorted(hints, key=lambda key: key not in required))
    about = ' '.join((inspect.getdoc(kind) or '').replace('``', '`').split())
    return f'{about}\n\n| key | type | meaning |\n| --- | --- | --- |\n{rows}'


def _type_text(hint: Any) -> str:
    """Return a type in words, with links to the sections of inner types."""
    if hint is Any:
        return 'any'
    if hint in _PLAIN:
        return _PLAIN[hint]
    origin, of = get_origin(hint), get_args(hint)
    if origin is list:
        return f'list of {_type_text(of[0])}'
    if origin is dict:
        return f'map of {_type_text(of[1])}'
    if origin in (Union, UnionType):
        return ' or '.join(map(_type_text, of))
    title = _title(_written(hint))
    return f'[{title}](#{title.replace(" ", "-")})'


def _title(kind: type) -> str:
    """Return the name of a type in words: `ReplayedSink` is `replayed sink`."""
    name = kind.__name__.removesuffix('Result') or kind.__name__
    return re.sub('(?<!^)(?=[A-Z])', ' ', name).lower()


def main(verb: str) -> int:
    """Print the schema of a verb's result, or of all results; return the exit status."""
    if verb and verb not in RESULTS:
        print(f'error: {verb}: no such verb has a JSON result: choose one of '
              f'{", ".join(RESULTS)}', file=sys.stderr)
        return 2
    print(json.dumps(schema(verb or None), indent=2))
    return 0


if __name__ == '__main__':
    sys.exit(main(' '.join(sys.argv[1:])))
