# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Translates expressions for ``compiler``; a value is as long as the block in which it is used.

This module needs llvmlite.
"""

from __future__ import annotations

import ast
import builtins
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from llvmlite import ir
from mddag_executor.compiler.kinds import (
    ABSENT,
    INTEGER,
    Kind,
    KNOWN,
    NOTHING,
    Structure,
    TRUTH,
    Tuple,
    tuple_of,
    Vector,
)
from mddag_executor.compiler.program import BIT, Callee, INT64, types_of
from mddag_executor.compiler.runtime import free_all
from mddag_executor.compiler.writer import integer, truth, Value, Writer

_OPERATIONS: dict[type, str] = {
    ast.Add: 'add', ast.Sub: 'sub', ast.Mult: 'mul', ast.BitAnd: 'and_', ast.BitOr: 'or_',
    ast.BitXor: 'xor', ast.LShift: 'shl', ast.RShift: 'ashr'}
_COMPARISONS: dict[type, str] = {
    ast.Eq: '==', ast.NotEq: '!=', ast.Lt: '<', ast.LtE: '<=', ast.Gt: '>', ast.GtE: '>='}


class Variable(NamedTuple):
    """A local variable: its kind, and where its words are."""

    kind: Kind
    places: tuple[Any, ...]


class Expressions(ast.NodeVisitor):
    """
    The expressions of one function; ``visit`` writes one and returns its ``Value``.

    :ivar variables: those that have a value so far.
    """

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._builder = writer.builder
        self._arguments = writer.callee.arguments
        self.variables: dict[str, Variable] = {}

    def generic_visit(self, node: ast.AST) -> Any:
        """Refuse what there is no method for."""
        raise self._writer.error(node, f'{type(node).__name__} is not compiled')

    def integer(self, node: ast.expr) -> Any:
        """Return the word of an integer expression."""
        return self._writer.as_kind(INTEGER, self.visit(node), node).words[0]

    def truth(self, node: ast.expr) -> Any:
        """Return the bit of an expression: whether it counts as true."""
        value: Value = (
            self._all_or_any(node) if isinstance(node, ast.BoolOp) else self.visit(node))
        if value.kind is TRUTH:
            return value.words[0]
        if isinstance(value.kind, Vector):
            value = integer(self._writer.length(value.words[0]))
        if value.kind is not INTEGER:
            raise self._writer.error(node, f'{value.kind} is neither true nor false')
        return self._builder.icmp_signed('!=', value.words[0], INT64(0))

    def list(self, node: ast.expr) -> tuple[Any, Vector]:
        """Return the address and kind of a list."""
        value: Value = self.visit(node)
        if not isinstance(value.kind, Vector):
            raise self._writer.error(node, f'this is {value.kind}, not a list')
        return value.words[0], value.kind

    # --- constants and variables -----------------------------------------------------------------

    def visit_Constant(self, node: ast.Constant) -> Value:
        """Return an integer or truth value."""
        return self._constant(node, node.value)

    def _constant(self, node: ast.AST, value: Any) -> Value:
        if isinstance(value, bool):
            return truth(BIT(int(value)))
        if isinstance(value, int):
            return integer(INT64(value))
        if isinstance(value, tuple) and all(isinstance(each, int) for each in value):
            return Value(tuple_of(len(value)), tuple(map(INT64, value)))
        raise self._writer.error(node, f'{value!r} cannot be a constant of compiled code')

    def visit_Name(self, node: ast.Name) -> Value:
        """Return a variable, or a constant of the module."""
        variable = self.variables.get(node.id)
        if variable is None:
            found = self.named(node)
            if found is None:
                raise self._writer.error(node, f'{node.id} has no value here')
            return self._constant(node, found)
        return Value(variable.kind, tuple(map(self._builder.load, variable.places)))

    def named(self, node: ast.expr) -> Any:
        """Return the value of a name of the module, or of Python; None: it is another name."""
        if not isinstance(node, ast.Name) or node.id in self.variables:
            return None
        names = self._writer.callee.source.names
        return names.get(node.id, vars(builtins).get(node.id))

    def visit_Tuple(self, node: ast.Tuple) -> Value:
        """Return a tuple of integers."""
        return Value(tuple_of(len(node.elts)), tuple(map(self.integer, node.elts)))

    def visit_Attribute(self, node: ast.Attribute) -> Value:
        """Return a field of a structure."""
        owner = self.visit(node.value)
        if not isinstance(owner.kind, Structure) or node.attr not in owner.kind.fields:
            raise self._writer.error(node, f'{owner.kind} has no {node.attr}')
        return self._writer.field(owner.words[0], owner.kind, node.attr)

    def visit_Subscript(self, node: ast.Subscript) -> Value:
        """Return an element of a vector, or of a tuple."""
        owner = self.visit(node.value)
        if isinstance(owner.kind, Vector):
            return self._writer.element(owner.words[0], owner.kind, self.index(node))
        if isinstance(owner.kind, Tuple) and isinstance(node.slice, ast.Constant):
            return integer(owner.words[int(str(node.slice.value))])
        raise self._writer.error(node, f'{owner.kind} has no such element')

    def index(self, node: ast.Subscript) -> Any:
        """Return the index in a vector."""
        index = self.integer(node.slice)
        if isinstance(index, ir.Constant) and index.constant < 0:
            raise self._writer.error(node, 'an index from the end is not compiled')
        return index

    # --- operations ------------------------------------------------------------------------------

    def visit_UnaryOp(self, node: ast.UnaryOp) -> Value:
        """Return ``not``, ``-`` or ``~`` of a value."""
        if isinstance(node.op, ast.Not):
            return truth(self._builder.not_(self.truth(node.operand)))
        word = self.integer(node.operand)
        if isinstance(node.op, ast.USub):
            constant = isinstance(word, ir.Constant)
            return integer(INT64(-word.constant) if constant else self._builder.neg(word))
        if isinstance(node.op, ast.Invert):
            return integer(self._builder.not_(word))
        raise self._writer.error(node, f'{type(node.op).__name__} is not compiled')

    def visit_BinOp(self, node: ast.BinOp) -> Value:
        """Return the result of an operation on integers, or two tuples as one."""
        left, right = self.visit(node.left), self.visit(node.right)
        if isinstance(node.op, ast.Add) and isinstance(left.kind, Tuple) and isinstance(
                right.kind, Tuple):
            return Value(tuple_of(left.kind.width + right.kind.width), left.words + right.words)
        one, other = (self._writer.as_kind(INTEGER, each, node).words[0] for each in (left, right))
        return self.operation(node, node.op, one, other)

    def operation(self, node: ast.AST, operator: ast.operator, left: Any, right: Any) -> Value:
        """Return the result of an operation on integers."""
        builder, name = self._builder, _OPERATIONS.get(type(operator))
        if name is not None:
            return integer(getattr(builder, name)(left, right))
        if not isinstance(operator, (ast.FloorDiv, ast.Mod)):
            raise self._writer.error(node, f'{type(operator).__name__} is not compiled')
        # the quotient is rounded down, and the remainder has the divisor's sign
        rest = builder.srem(left, right)
        is_rounded = builder.and_(
            builder.icmp_signed('!=', rest, INT64(0)),
            builder.icmp_signed('<', builder.xor(rest, right), INT64(0)))
        if isinstance(operator, ast.Mod):
            return integer(builder.select(is_rounded, builder.add(rest, right), rest))
        return integer(builder.sub(builder.sdiv(left, right), builder.zext(is_rounded, INT64)))

    def visit_IfExp(self, node: ast.IfExp) -> Value:
        """Return one of two values; the other one is not evaluated."""
        writer = self._writer
        condition = self.truth(node.test)
        if isinstance(condition, ir.Constant):
            return Value(*self.visit(node.body if condition.constant else node.orelse))
        then, otherwise, after = map(writer.block, ('if', 'else', 'chosen'))
        self._builder.cbranch(condition, then, otherwise)
        values, blocks = [], []
        for block, each in ((then, node.body), (otherwise, node.orelse)):
            writer.begin(block)
            values.append(writer.as_integer(self.visit(each)))
            blocks.append(self._builder.block)
            writer.go_to(after)
        writer.begin(after)
        one, other = values
        if one.kind != other.kind:
            raise writer.error(node, f'this is {one.kind} or {other.kind}')
        return Value(one.kind, tuple(
            writer.choose(list(zip(words, blocks))) for words in zip(one.words, other.words)))

    def visit_BoolOp(self, node: ast.BoolOp) -> Value:
        """Return the integer that decides: the first one that is true (or), or is not (and)."""
        if _is_truth(node):
            return self._all_or_any(node)
        writer, after = self._writer, self._writer.block('decided')
        found: list[tuple[Any, Any]] = []
        for each in node.values[:-1]:
            word = self.integer(each)
            found.append((word, self._builder.block))
            following = writer.block('next')
            self._builder.cbranch(
                self._builder.icmp_signed('!=', word, INT64(0)),
                *((after, following) if isinstance(node.op, ast.Or) else (following, after)))
            writer.begin(following)
        found.append((self.integer(node.values[-1]), self._builder.block))
        writer.go_to(after)
        writer.begin(after)
        return integer(writer.choose(found))

    def _all_or_any(self, node: ast.BoolOp) -> Value:
        """Return whether all values, or any, count as true."""
        return self._short_circuit(isinstance(node.op, ast.Or), [
            lambda each=each: self.truth(each) for each in node.values])  # type: ignore[misc]

    def _short_circuit(self, ends: bool, conditions: Sequence[Callable[[], Any]]) -> Value:
        """Return the bit of the first condition that is ``ends``, or else of the last one."""
        writer, last = self._writer, BIT(int(not ends))
        after: Any = None
        found: list[tuple[Any, Any]] = []
        for condition in conditions:
            last = condition()
            if not isinstance(last, ir.Constant):
                found.append((BIT(int(ends)), self._builder.block))
                after, following = after or writer.block('known'), writer.block('next')
                self._builder.cbranch(
                    last, *((after, following) if ends else (following, after)))
                writer.begin(following)
            elif bool(last.constant) is ends:
                break
        else:
            last = BIT(int(not ends))
        if not found:
            return truth(last)
        found.append((last, self._builder.block))
        writer.go_to(after)
        writer.begin(after)
        return truth(writer.choose(found))

    # --- comparisons -----------------------------------------------------------------------------

    def visit_Compare(self, node: ast.Compare) -> Value:
        """Return the result of a comparison, or of several in a row."""
        if isinstance(node.ops[0], (ast.Is, ast.IsNot)):
            return self._is_none(node)
        left = self.visit(node.left)

        def compare(operator: ast.cmpop, operand: ast.expr) -> Any:
            nonlocal left
            right = self.visit(operand)
            bit = self._compare(node, operator, left, right)
            left = right
            return bit

        if len(node.ops) == 1:
            return truth(compare(node.ops[0], node.comparators[0]))
        return self._short_circuit(False, [
            lambda operator=operator, operand=operand: compare(  # type: ignore[misc]
                operator, operand) for operator, operand in zip(node.ops, node.comparators)])

    def _is_none(self, node: ast.Compare) -> Value:
        """Compare an argument that may be a function, but is always None, with None."""
        if self._argument(node.left) is not ABSENT:
            raise self._writer.error(node, 'only an argument may be a function or None')
        return truth(BIT(int(isinstance(node.ops[0], ast.Is))))

    def _compare(self, node: ast.AST, operator: ast.cmpop, left: Value, right: Value) -> Any:
        writer = self._writer
        if isinstance(operator, (ast.In, ast.NotIn)):
            bit = self._contains(node, right, left)
            return self._builder.not_(bit) if isinstance(operator, ast.NotIn) else bit
        if type(operator) not in _COMPARISONS:
            raise writer.error(node, f'{type(operator).__name__} is not compiled here')
        left, right = map(writer.as_integer, (left, right))
        if left.kind != right.kind or not (left.kind is INTEGER or isinstance(left.kind, Tuple)):
            raise writer.error(node, f'{left.kind} and {right.kind} are not compared')
        return writer.compare(_COMPARISONS[type(operator)], left.words, right.words)

    def _contains(self, node: ast.AST, owner: Value, value: Value) -> Any:
        """Return the bit of ``value in owner``."""
        writer = self._writer
        if isinstance(owner.kind, Vector) and not owner.kind.nested:
            wanted = writer.as_kind(owner.kind.element, value, node)
            return writer.contains(owner.words[0], owner.kind, wanted)
        if not isinstance(owner.kind, Tuple):
            raise writer.error(node, f'{owner.kind} cannot be searched')
        word = writer.as_kind(INTEGER, value, node).words[0]
        bit = BIT(0)
        for each in owner.words:
            bit = self._builder.or_(bit, self._builder.icmp_signed('==', word, each))
        return bit

    # --- calls -----------------------------------------------------------------------------------

    def visit_Call(self, node: ast.Call) -> Value:
        """Return the result of a call."""
        if isinstance(node.func, ast.Attribute):
            return self._call_method(node, node.func)
        function = self.named(node.func)
        if self._argument(node.func) is KNOWN:
            function = self._writer.program.known
        if function in _BUILTINS:
            if node.keywords:
                raise self._writer.error(
                    node, f'{function.__name__} with {node.keywords[0].arg}= is not compiled')
            return _BUILTINS[function](self, node)
        if function is free_all:
            return self._free_all(node)
        callee = self._writer.program.callee(function)
        if callee is None:
            raise self._writer.error(node, f'{ast.unparse(node.func)} is not compiled')
        return self._call(node, callee)

    def _argument(self, node: ast.expr) -> Kind | None:
        """Return the kind of an argument; None: it is none."""
        return self._arguments.get(node.id) if isinstance(node, ast.Name) else None

    def _call(self, node: ast.Call, callee: Callee) -> Value:
        given = dict(zip(callee.arguments, node.args))
        given.update((each.arg, each.value) for each in node.keywords if each.arg is not None)
        if given.keys() != callee.arguments.keys():
            raise self._writer.error(
                node, f'{callee.source.name} needs {", ".join(callee.arguments)}')
        words: list[Any] = []
        for name, kind in callee.arguments.items():
            if kind is ABSENT and not self._is_absent(given[name]):
                raise self._writer.error(node, f'{name} must be None')
            if types_of(kind):
                words += self._writer.as_kind(kind, self.visit(given[name]), given[name]).words
        result = self._builder.call(callee.function, words)
        if callee.result is NOTHING:
            return Value(NOTHING, ())
        width = len(types_of(callee.result))
        return Value(callee.result, (result,) if width == 1 else tuple(
            self._builder.extract_value(result, place) for place in range(width)))

    def _is_absent(self, node: ast.expr) -> bool:
        return self._argument(node) is ABSENT or (
            isinstance(node, ast.Constant) and node.value is None)

    def _call_method(self, node: ast.Call, method: ast.Attribute) -> Value:
        """Return the result of a method of a list."""
        writer = self._writer
        header, kind = self.list(method.value)
        if method.attr == 'append':
            value = node.args[0]
            if kind.nested and isinstance(value, ast.List) and not value.elts:
                writer.append_empty(header, kind)
            else:
                self.append(header, kind, self.visit(value), node)
        elif method.attr == 'pop' and not node.args:
            last = self._builder.sub(writer.length(header), INT64(1))
            writer.set_length(header, last)
            return writer.element(header, kind, last)
        elif method.attr == 'clear':
            writer.set_length(header, INT64(0))
        else:
            raise writer.error(node, f'{method.attr} of a list is not compiled')
        return Value(NOTHING, ())

    def append(self, header: Any, kind: Vector, value: Value, node: ast.AST) -> None:
        """Append a value to a list."""
        value = self._writer.as_kind(kind.element, value, node)
        self._writer.set_element(header, kind, self._writer.lengthen(header, kind), value)

    def _free_all(self, node: ast.Call) -> Value:
        owner = self.visit(node.args[0])
        if not isinstance(owner.kind, Structure):
            raise self._writer.error(node, f'{owner.kind} is not freed')
        self._writer.free_all(owner.words[0], owner.kind)
        return Value(NOTHING, ())

    def length_of(self, node: ast.Call) -> Value:
        """Return ``len(list)``."""
        return integer(self._writer.length(self.list(node.args[0])[0]))

    def integer_of(self, node: ast.Call) -> Value:
        """Return ``int(truth value)``."""
        return integer(self.integer(node.args[0]))

    def magnitude(self, node: ast.Call) -> Value:
        """Return ``abs(integer)``."""
        word = self.integer(node.args[0])
        is_negative = self._builder.icmp_signed('<', word, INT64(0))
        return integer(self._builder.select(is_negative, self._builder.neg(word), word))

    def least(self, node: ast.Call) -> Value:
        """Return ``min(integer, …)``."""
        return self._extreme(node, '<')

    def largest(self, node: ast.Call) -> Value:
        """Return ``max(integer, …)``."""
        return self._extreme(node, '>')

    def _extreme(self, node: ast.Call, sign: str) -> Value:
        found, *others = map(self.integer, node.args)
        for other in others:
            found = self._builder.select(
                self._builder.icmp_signed(sign, other, found), other, found)
        return integer(found)


def _is_truth(node: ast.expr) -> bool:
    """Return whether the value of an expression is True or False, not another integer."""
    if isinstance(node, ast.BoolOp):
        return all(map(_is_truth, node.values))
    return isinstance(node, ast.Compare) or (
        isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not))


_BUILTINS: dict[Any, Callable[[Expressions, ast.Call], Value]] = {
    len: Expressions.length_of, int: Expressions.integer_of, abs: Expressions.magnitude,
    min: Expressions.least, max: Expressions.largest}
