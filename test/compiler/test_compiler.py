# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Compiled functions do what Python does; what is not compiled is refused with its place."""

from collections.abc import Callable
from heapq import heapify, heappop, heappush
from typing import NamedTuple

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.compiler.kinds import Kinds
from mddag_executor.compiler.runtime import free_all, REPLACED
from mddag_executor.simulate import compiled
from mddag_executor.simulate.compiled import Memory
import pytest

from ..conftest import examples

pytestmark = pytest.mark.skipif(not compiled.available(), reason='llvmlite is not there')

SMALL = (2, 3, 5)
LONGEST = 40


class Box(NamedTuple):
    """What the functions change, like the core's state."""

    found: list[int]
    numbers: list[int]
    heap: list[tuple[int, int, int, int, int]]


class Boxes(NamedTuple):
    """A list of lists; and an integer."""

    lists: list[list[int]]
    limit: int


def arithmetic(box: Box, several: Boxes, a: int, b: int) -> None:
    """Compute with integers of either sign."""
    for value in (a + b, a - b, a * b, a & b, a | b, a ^ b, ~a, -a, abs(a), min(a, b, 7),
                  max(a, -b, 1), a >> 2, (a & 15) << 3):
        box.found.append(value)
    if b != 0:
        box.found.append(a // b)
        box.found.append(a % b)
        box.found.append(-(-a // b))


def conditions(box: Box, several: Boxes, a: int, b: int) -> None:
    """Keep truth values as integers, and evaluate only what matters."""
    first = second = a < b
    box.found.append(int(first) + int(second))
    box.found.append(int(-5 < a <= b < 9))
    box.found.append(int(not a or (b == 3 and a != 2)))
    box.found.append(int(b != 0 and a // b > 1))
    box.found.append(int((a, b, 1) < (b, a, 2)) + 2 * int((a, b) == (b, a)))
    box.found.append(int((a, b) >= (3, 4)) + 2 * int((a, b) != (1, 1)))
    box.found.append(a if a > b else b)
    box.found.append(int(a in SMALL) + 2 * int(a not in box.numbers))
    box.found.append(a or b)
    box.found.append((a and b) + 100 * (b and a > 3))
    box.found.append(a and b or len(box.numbers) or a - b)


def loops(box: Box, several: Boxes, a: int, b: int) -> None:
    """Leave and continue loops of every kind."""
    total = 0
    for i in range(a):
        if i == 2:
            continue
        if i > 4:
            break
        total += i
    for i in range(8, b, -3):
        total += i * 10
    for number in box.numbers:
        total += number
        if len(box.numbers) < LONGEST and number > 5:
            box.numbers.append(number // 2)
    for numbers in (box.numbers, box.found):
        total += len(numbers)
        if total > 100:
            break
        numbers.append(1)
    for number in (a, a + b, total):
        a += 5
        total += number + a
    while True:
        total -= 3
        if total < 10:
            break
    box.found.append(total)


def lists(box: Box, several: Boxes, a: int, b: int) -> None:
    """Use lists of integers, of tuples and of lists, and make some."""
    for start in (a, b):
        waiting = [start]
        while waiting:
            number = waiting.pop()
            box.found.append(number)
            if number > 3:
                waiting.append(number // 2)
                waiting.append(number - 3)
        if b == 1:
            return
    mine = [a, b]
    mine = [len(mine), mine[1], mine.pop() + mine[0]]
    for number in mine:
        box.found.append(number)
    pairs = [(a, b)]
    pairs.append((b, a))
    last, _ = pairs.pop()
    box.found.append(last + pairs[0][1] + several.limit)
    for _ in range(3):
        several.lists.append([])
        several.lists[0].append(len(several.lists))
    several.lists[1].append(b)
    several.lists[0][0] += len(several.lists[0])
    del several.lists[0][2:]
    several.lists[1].clear()
    box.heap.append((a, b) + (1, 2, 3))
    box.found.append(box.heap[0][1])


def calls(box: Box, several: Boxes, a: int, b: int) -> None:
    """Read a place before the operand is evaluated, which moves the list."""
    box.found.append(a)
    box.found[0] += _lengthen(box, times=20)
    box.found.append(_pass_on(_next, b))
    box.found.append(_chosen(None, b))


def _lengthen(box: Box, times: int) -> int:
    for _ in range(times):
        box.found.append(box.found[0])
    box.found[0] = 7
    return times


def _next(a: int) -> int:
    return a + 1


def _chosen(call: Callable[[int], int] | None, a: int) -> int:
    return call(a) if call is not None and a > 0 else _pair(a)[1]


def _pass_on(call: Callable[[int], int], a: int) -> int:
    return call(a) if a > 0 else _chosen(call=None, a=a)


def _pair(a: int) -> tuple[int, int]:
    return (a, 2 * a)


def heaps(box: Box, several: Boxes, a: int, b: int) -> None:
    """Use the functions of heapq."""
    for number in box.numbers:
        heappush(box.heap, (number % 7, number % 3, a, b, len(box.heap)))
    if len(box.heap) > 2:
        box.found.append(heappop(box.heap)[4])
        box.heap[0] = (b, a, 0, 0, 0)
        heapify(box.heap)
    while len(box.heap) > 5:
        first = heappop(box.heap)
        box.found.append(first[0] * 100 + first[4])


def run_one(box: Box, several: Boxes, given: list[int], which: int, a: int, b: int) -> None:
    """Run one of the functions; all that it leaves is in the box then."""
    for number in given:
        box.numbers.append(number)
    if which == 0:
        arithmetic(box, several, a, b)
    elif which == 1:
        conditions(box, several, a, b)
    elif which == 2:
        loops(box, several, a, b)
    elif which == 3:
        lists(box, several, a, b)
    elif which == 4:
        calls(box, several, a, b)
    else:
        heaps(box, several, a, b)
    for each in several.lists:
        box.found.append(len(each))
        for number in each:
            box.found.append(number)


def free_both(box: Box, several: Boxes) -> None:
    """Free what a run has left."""
    free_all(box)
    free_all(several)


def translated(*functions):
    """Translate functions; ``_next`` is each argument that is a function."""
    from mddag_executor.compiler.program import source_of
    from mddag_executor.compiler.statements import translate
    return translate(functions, Kinds({}), REPLACED, (_next, source_of(_next)))


@pytest.fixture(scope='module')
def code():
    from mddag_executor.compiler import machine_code
    return machine_code.MachineCode(machine_code.make(translated(run_one, free_both)))


@examples(300)
@given(st.integers(0, 5), st.lists(st.integers(-50, 50), max_size=12), st.integers(-12, 12),
       st.integers(-12, 12))
def test_compiled_functions_do_what_python_does(code, which, numbers, a, b):
    plain, several = Box([], [], []), Boxes([], 9)
    run_one(plain, several, numbers, which, a, b)
    box, boxes, numbers = Memory(0, 0, 0), Memory(0, 9), Memory(numbers)
    code.function('run_one', 6)(box.address, boxes.address, numbers.address, which, a, b)
    found = [box.words(field, width).tolist() for field, width in ((0, 1), (1, 1), (2, 5))]
    code.function('free_both', 2)(box.address, boxes.address)
    assert [sum(found[0], []), sum(found[1], []), list(map(tuple, found[2]))] == [*plain]
    assert [len(box.words(field, 1)) for field in range(3)] == [0, 0, 0]
    assert len(boxes.words(0, 3)) == 0


REFUSED = {
    'a / 2': 'Div is not compiled',
    'box.found[-1]': 'an index from the end is not compiled',
    'box.found[a:]': 'Slice is not compiled',
    'sum(box.found)': 'sum is not compiled',
    'box.found.index(a)': 'index of a list is not compiled',
    'box.missing': 'Box has no missing',
    'box.found == box.found': 'list and list are not compared',
    '[a for _ in box.found]': 'ListComp is not compiled',
    "'text'": "'text' cannot be a constant of compiled code",
    'unknown': 'unknown has no value here',
    'box.heap[0]': 'this is tuple, not int',
    'a < b is a': 'Is is not compiled here',
    'max(a, b, key=abs)': 'max with key= is not compiled',
    'helper(1)': 'helper needs a, call',
    'helper(1, helper)': 'call must be None',
}


@pytest.mark.parametrize(('expression', 'what'), REFUSED.items(), ids=REFUSED)
def test_what_is_not_compiled_is_refused(tmp_path, expression, what):
    from mddag_executor.compiler.program import NotCompiledError
    path = tmp_path / 'refused.py'
    path.write_text(f"""\
def helper(a: int, call: Callable[[int], int] | None) -> int:
    return a

def refused(box: Box, a: int) -> int:
    b = 1
    return {expression}
""")
    space = {'Box': Box, 'Callable': Callable, '__name__': 'refused'}
    exec(compile(path.read_text(), str(path), 'exec'), space)
    with pytest.raises(NotCompiledError) as error:
        translated(space['refused'])
    assert str(error.value) == f'{path}:6: {what}'


@pytest.mark.parametrize('last', ('other = mine', 'return mine'))
def test_a_list_that_a_function_makes_has_one_name(tmp_path, last):
    from mddag_executor.compiler.program import NotCompiledError
    path = tmp_path / 'refused.py'
    path.write_text(f"""\
def refused(box: Box) -> {'None' if 'other' in last else 'list[int]'}:
    mine = [1]
    mine.append(2)
    {last}
""")
    space = {'Box': Box, '__name__': 'refused'}
    exec(compile(path.read_text(), str(path), 'exec'), space)
    with pytest.raises(NotCompiledError) as error:
        translated(space['refused'])
    assert str(error.value) == (
        f'{path}:4: mine is a list of this function, and can have no other name')
