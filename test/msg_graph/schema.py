# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the JSON Schema says about a declaration."""

import jsonschema
from msg_graph import language
import yaml


def schema_errors(text):
    validator = jsonschema.Draft7Validator(language.schema())
    return [error.message for error in validator.iter_errors(yaml.safe_load(text))]
