# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Checks results of commands against their types (`mddag_executor.results`)."""

from functools import cache

import jsonschema
from mddag_executor.results.schema import RESULTS, schema, schema_of


@cache
def validators(types, verb=None):
    """Return a validator for each of the types; those of a verb have the keys of a file."""
    whole = schema_of(types, closed=True) if verb is None else schema(verb, closed=True)
    return [jsonschema.Draft7Validator({'allOf': [one], 'definitions': whole['definitions']})
            for one in whole['anyOf']]


def errors_of(value, types, verb=None):
    """Return what is wrong with a value, by the type that fits best."""
    return min(([f'{error.json_path}: {error.message}' for error in each.iter_errors(value)]
                for each in validators(types, verb)), key=len)


def result_errors(verb, result):
    """Return what is wrong with the result of a verb."""
    return errors_of(result, RESULTS[verb], verb)


def check_result(verb, result):
    """Check a result: all keys are known, none is missing, each has a value of its type."""
    wrong = result_errors(verb, result)
    assert not wrong, '\n'.join([f'mddag {verb} --json:', *wrong[:10]])
