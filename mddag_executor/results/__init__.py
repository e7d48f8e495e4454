# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The results that commands write with ``--json``: types of all keys, with meaning and unit.

Theory of operation
-------------------
1. A result is a dictionary.  Its type is a ``TypedDict`` here, and nowhere else.  The functions
   that make results return these types, so mypy finds a key that is missing, unknown or of
   another type.
2. The text below a key is its description.  ``schema`` makes the JSON Schema from types and texts,
   and the tables of docs/json.md are made from both.  Tests validate the results of all verbs.
3. A key that only some results have is in a type with ``total=False``, which the type of the
   result inherits.
4. Times and durations are integers in nanoseconds on the clock of the recording, unless the name
   or the text of a key says something else.
"""
