# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Patterns of English that readers had to read twice, and what to write instead.

Theory of operation
-------------------
1. The test reads the pages (Markdown, without code), the comments, docstrings and messages of
   Python files, and the comments of scripts, workflows and other files (``#``).  A text is one
   paragraph of a page, one block of comments, or one string with a blank.
2. A pattern is a regular expression over a text whose line breaks are blanks.  It should find no
   good sentence: a pattern that has to be argued with is worse than none.
3. The changelog of released versions is history, and stays as it is.
"""

import ast
from dataclasses import dataclass
import io
from pathlib import Path
import re
import tokenize

TOP = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Pattern:
    """A pattern: what to write instead, what it finds, and an example that it has to find."""

    remedy: str
    regex: str
    example: str


PATTERNS = (
    Pattern("write 'also' or 'as well' inside the sentence",
            r',\s+too\b(?! (?:few|many|much|long|short|late))',
            'The trace is complete, too.'),
    Pattern("name the thing: not a sentence whose subject is a clause with 'what'",
            r'(?:[.;] |\* )What (?!if\b|it must\b)[^.?!]*[.!]',
            'The run ends. What is lost counts as missed.'),
    Pattern("name the thing instead of 'what' after a preposition",
            r'\b(?:of|for|with|from|by|than|behind|before|after) what (?:is|was|are|were|has)\b',
            'It has a copy of what was published.'),
    Pattern("'nobody', 'whoever' and 'whom' are people: write 'no thread', 'a callback that'",
            r'\b(?:[Nn]o|[Ss]ome|[Aa]ny)body\b|\b[Ww]ho(?:m|ever)\b|'
            r'\b(?:thread|callback|process|executor|worker|message|node|one)s? who\b',
            'Nobody waits for the callback.'),
    Pattern('write a whole sentence: it begins with its noun',
            r': (?:only )?of (?:a|an|the|any|each) [^.:;]{1,40}: ',
            '`tolerate`: of a sink: of any 100 jobs one.'),
    Pattern("write 'at most'",
            r'\bthan (?:it|they) may\b|\bas many as (?:it|they) may\b',
            'It missed more than it may.'),
    Pattern('write again, next to, alternately, in a list, receives, pass, manage, reported',
            r'\b(?:anew|beside|in turn|how-manieth|no whole number|hand(?:s|ed|ing)? (?:out|over|'
            r'back)|look(?:s|ed|ing)? after|taken (?:for|as)|takes? for granted|'
            r'stands? (?:in|there)|held back|theirs)\b',
            'The run begins anew.'),
    Pattern('jobs are not refused or reserved any more: demoted, behind, less important',
            r'\b(?:[Jj]ob|[Cc]allback|[Ee]xecution|[Ww]ork)s? (?:is|are|was|were) refused\b|'
            r'\brefusals?\b|\breserv(?:ation|ations|ed|es)\b|\bleaves? room\b',
            'Jobs are refused for a while.'),
    Pattern("write 'in time', 'us' and 'results'",
            r"\bon time\b|\bsink jobs\b|\bsinks' jobs\b",
            'All sinks are on time.'),
    Pattern("write 'after that', 'later', 'the rest'",
            r'(?i:\bfrom then on\b|\bfrom there on\b)|\bthereof\b|\bhence?forth\b',
            'Lost from then on.'),
    Pattern("write 'still running' or 'remains'",
            r'\bleft behind\b', 'Two threads are left behind.'),
    Pattern("write 'existing'",
            r'\b(?:is|are|was|were) there already\b', 'A file that is there already.'),
    Pattern("write 'even if', 'and also', or a sentence of its own",
            r'[,;(:] ?also (?:if|when|of|for|in|as|with|without|from|by|on|an|a|the)\b',
            'It ends, also if a callback runs.'),
    Pattern("begin with the subject: 'the test checks …', not 'checked are …'",
            r'(?:^|[.;:] |\* |\d\. )(?:Not )?(?:[Jj]udged|[Cc]hecked|[Rr]etained|[Uu]nknown|'
            r'[Ll]eft out|[Ll]isted|[Cc]ounted|[Rr]ead|[Ss]hown|[Oo]rdered|[Kk]ept) '
            r'(?:is|are|was|were) ',
            'The run ends. Judged are the jobs of the range.'),
    Pattern("write 'later', 'longer' or 'how much longer'",
            r'\b[Hh]ow many times as\b|\bas late as\b|\bas \w+ as where\b',
            'How many times as long callbacks may take.'),
    Pattern("write 'is not a …'",
            r'(?<!there )(?<!There )\b(?:is|are|was|were) no (?!longer\b|more\b|such\b)[a-z]',
            'A shorter time is no stop.'),
    Pattern("write 'no longer'",
            r'\bno more(?=[.,;:)]|$)|\bno \w+ any more\b',
            'A callback that is overtaken no more.'),
    Pattern("write 'this many'", r'\b[Ss]o many\b(?! that\b)', 'It waits for so many periods.'),
    Pattern("write 'report', 'say', 'notify' or 'distinguish'",
            r'\b(?:tells?|told)\b', 'The pool is told of changes.'),
    Pattern("begin with the subject: not 'Of a callback …'",
            r'(?:^|[.;] |\* |\d\. )Of (?:a|an|the|each|its|several|all) ',
            'Of a DAG they end together.'),
    Pattern("write 'the result of'",
            r'\bwhat (?:came|comes|becomes|became) of\b|\bWhat came of\b',
            'It returns what came of the run.'),
    Pattern("write 'for ever'", r'\bfor good\b', 'It starves for good.'),
)


def page_texts(path):
    """Yield line and text of each paragraph of a page, its code replaced by X."""
    text = path.read_text(encoding='utf-8')
    if path.name == 'CHANGELOG.md':
        text = text.partition('\n## 2.0.0')[0]

    def blank(match):
        return re.sub(r'[^\n]', ' ', match[0])
    text = re.sub(r'^ *```.*?^ *```$', blank, text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r'<!--.*?-->', blank, text, flags=re.DOTALL)
    text = re.sub(r'`[^`]+`', lambda match: re.sub(r'[^\n]', 'X', match[0]), text)
    for match in re.finditer(r'(?:^ *(?:\* |\d\. )?(?=\S).*\n?)(?:^ *(?!\* |\d\. )(?=\S).*\n?)*',
                             text, re.MULTILINE):
        yield text.count('\n', 0, match.start()) + 1, match[0]


def python_texts(path):
    """Yield line and text of each block of comments and of each string with a blank."""
    source = path.read_text(encoding='utf-8')
    parts = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.JoinedStr) and id(node) not in parts:
            parts.update(id(part) for part in ast.walk(node))
            yield node.lineno, ''.join(
                part.value if isinstance(part, ast.Constant) else '{}' for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and (
                ' ' in node.value and id(node) not in parts):
            yield node.lineno, node.value
    yield from blocks((token.start[0], token.string) for token in tokenize.generate_tokens(
        io.StringIO(source).readline) if token.type == tokenize.COMMENT)


def comment_texts(path):
    """Yield line and text of each block of comments of a script, a Makefile, YAML or TOML."""
    yield from blocks((number, match[1]) for number, line in enumerate(
        path.read_text(encoding='utf-8').splitlines(), 1)
        if (match := re.search(r'(?:^|\s)(#(?!!).*)', line)))


def blocks(comments):
    """Yield line and text of each block of comments, of which the lines are given."""
    lines, first = [], 0
    for number, text in comments:
        if lines and number != first + len(lines):
            yield first, '\n'.join(lines)
            lines = []
        first = first if lines else number
        lines.append(text.lstrip('#: '))
    if lines:
        yield first, '\n'.join(lines)


def findings(path, top=TOP):
    """Return a line for each pattern that a file has: place, words, and what to write."""
    found = []
    texts = {'.md': page_texts, '.py': python_texts}.get(path.suffix, comment_texts)
    for line, text in texts(path):
        flat = re.sub(r':(ivar|param) (\w+):', r':\1 \2 ', text.replace('\n', ' '))
        for pattern in PATTERNS:
            for match in re.finditer(pattern.regex, flat):
                at = line + text.count('\n', 0, match.start())
                words = ' '.join(flat[max(0, match.start() - 20):match.end() + 10].split())
                found.append(f'{path.relative_to(top)}:{at}: …{words}…: {pattern.remedy}')
    return found
