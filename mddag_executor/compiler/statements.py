# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Translates functions: their statements, with expressions by ``expressions``.

This module needs llvmlite.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from llvmlite import ir
from mddag_executor.compiler.expressions import Expressions, Variable
from mddag_executor.compiler.kinds import INTEGER, Kinds, NOTHING, Tuple, vector
from mddag_executor.compiler.program import Callee, INT64, Program, result_type, Source, types_of
from mddag_executor.compiler.writer import integer, Loop, Value, Writer


def translate(
    functions: Iterable[Any], kinds: Kinds, replaced: Mapping[Any, Any],
    known: tuple[Any, Source],
) -> Program:
    """
    Translate functions, which can be called by their names, and all that they call.

    The other parameters are those of ``Program``.
    """
    program = Program(kinds, replaced, known)
    for function in functions:
        program.export(function)
    for callee in program.take_untranslated():
        _Statements(program, callee).write()
    return program


class _Statements(ast.NodeVisitor):
    """Translates the statements of one function."""

    def __init__(self, program: Program, callee: Callee) -> None:
        self._callee = callee
        self._writer = Writer(program, callee)
        self._builder = self._writer.builder
        self._expressions = Expressions(self._writer)
        self._exit = self._writer.block('exit')
        self._result: tuple[Any, ...] = ()
        self._loops: list[Loop] = []
        self._own_lists: set[str] = set()

    def write(self) -> None:
        """Write the function into the module."""
        writer, kind = self._writer, self._callee.result
        words = iter(self._callee.function.args)
        for name, each in self._callee.arguments.items():
            if types_of(each):
                self._assign(name, Value(each, tuple(next(words) for _ in types_of(each))))
        if kind is not NOTHING:
            self._result = writer.variable(kind)
        self._write_all(self._callee.source.definition.body)
        writer.go_to(self._exit)
        writer.begin(self._exit)
        writer.finish()
        found = [self._builder.load(place) for place in self._result]
        if kind is NOTHING:
            self._builder.ret_void()
        elif len(found) == 1:
            self._builder.ret(found[0])
        else:
            together = ir.Constant(result_type(kind), ir.Undefined)
            for place, word in enumerate(found):
                together = self._builder.insert_value(together, word, place)
            self._builder.ret(together)

    def _write_all(self, statements: Sequence[ast.stmt]) -> None:
        for statement in statements:
            if self._writer.has_ended:
                return
            self.visit(statement)

    def generic_visit(self, node: ast.AST) -> Any:
        """Refuse what there is no method for."""
        raise self._writer.error(node, f'{type(node).__name__} is not compiled')

    # --- assignments -----------------------------------------------------------------------------

    def visit_Assign(self, node: ast.Assign) -> None:
        """Evaluate once, then assign from left to right."""
        target = node.targets[0]
        if isinstance(node.value, ast.List):
            self._make_list(node, node.value)
        elif isinstance(node.value, ast.Tuple) and isinstance(target, ast.Tuple):
            values = [self._expressions.visit(each) for each in node.value.elts]
            for each, value in zip(target.elts, values, strict=True):
                self._assign_to(each, value)
        else:
            self._refuse_own_list(node.value)
            value = self._expressions.visit(node.value)
            for each in node.targets:
                self._assign_to(each, value)

    def _make_list(self, node: ast.Assign, values: ast.List) -> None:
        """Empty the list that a variable always has, and append the given values."""
        target = node.targets[0]
        if not isinstance(target, ast.Name) or not values.elts or len(node.targets) > 1:
            raise self._writer.error(node, 'only one name can be a new list, with an element')
        # the list may occur in its own new elements
        elements = [self._expressions.visit(each) for each in values.elts]
        if target.id not in self._expressions.variables:
            first = elements[0].kind
            kind = vector(first.width if isinstance(first, Tuple) else 0)
            self._assign(target.id, Value(kind, (self._writer.new_list(),)))
            self._own_lists.add(target.id)
        header, kind = self._expressions.list(ast.Name(target.id, ast.Load()))
        self._writer.set_length(header, INT64(0))
        for value in elements:
            self._expressions.append(header, kind, value, node)

    def _refuse_own_list(self, node: ast.expr) -> None:
        """Refuse a second name for a list of this function, which changes or is freed with it."""
        if isinstance(node, ast.Name) and node.id in self._own_lists:
            raise self._writer.error(
                node, f'{node.id} is a list of this function, and can have no other name')

    def _assign(self, name: str, value: Value, node: ast.AST | None = None) -> None:
        value = self._writer.as_integer(value)
        variables = self._expressions.variables
        if name not in variables:
            variables[name] = Variable(value.kind, self._writer.variable(value.kind))
        kind, places = variables[name]
        value = self._writer.as_kind(kind, value, node or self._callee.source.definition)
        for word, place in zip(value.words, places):
            self._builder.store(word, place)

    def _assign_to(self, target: ast.expr, value: Value) -> None:
        if isinstance(target, ast.Name):
            self._assign(target.id, value, target)
        elif isinstance(target, ast.Tuple):
            for each, word in zip(target.elts, value.words, strict=True):
                self._assign_to(each, integer(word))
        elif isinstance(target, ast.Subscript):
            header, kind = self._expressions.list(target.value)
            index = self._expressions.index(target)
            value = self._writer.as_kind(kind.element, value, target)
            self._writer.set_element(header, kind, index, value)
        else:
            raise self._writer.error(target, 'this cannot be assigned')

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        """Read before the operand is evaluated, and find the place again after that."""
        before = self._expressions.integer(node.target)
        operand = self._expressions.integer(node.value)
        self._assign_to(
            node.target, self._expressions.operation(node, node.op, before, operand))

    def visit_Delete(self, node: ast.Delete) -> None:
        """Shorten a list: ``del list[length:]``."""
        for target in node.targets:
            if not (isinstance(target, ast.Subscript) and isinstance(target.slice, ast.Slice)
                    and target.slice.lower is not None and target.slice.upper is None):
                raise self._writer.error(node, 'only del list[length:] is compiled')
            header, _ = self._expressions.list(target.value)
            self._writer.set_length(header, self._expressions.integer(target.slice.lower))

    # --- other statements ------------------------------------------------------------------------

    def visit_Expr(self, node: ast.Expr) -> None:
        """Write a call, or nothing for a docstring."""
        if not isinstance(node.value, ast.Constant):
            self._expressions.visit(node.value)

    def visit_Pass(self, node: ast.Pass) -> None:
        """Write nothing."""

    def visit_Return(self, node: ast.Return) -> None:
        """Keep the result, and go to the exit."""
        if node.value is not None:
            self._refuse_own_list(node.value)
            value = self._expressions.visit(node.value)
            value = self._writer.as_kind(self._callee.result, value, node)
            for word, place in zip(value.words, self._result):
                self._builder.store(word, place)
        self._writer.go_to(self._exit)

    def visit_If(self, node: ast.If) -> None:
        """Write both branches, or the only one that is possible."""
        condition = self._expressions.truth(node.test)
        if isinstance(condition, ir.Constant):
            self._write_all(node.body if condition.constant else node.orelse)
            return
        then, otherwise, after = map(self._writer.block, ('then', 'else', 'after'))
        self._builder.cbranch(condition, then, otherwise)
        for block, body in ((then, node.body), (otherwise, node.orelse)):
            self._writer.begin(block)
            self._write_all(body)
            self._writer.go_to(after)
        self._writer.begin(after)

    def visit_While(self, node: ast.While) -> None:
        """Write a loop."""
        self._refuse_else(node)
        test, body, after = map(self._writer.block, ('test', 'body', 'after'))
        self._writer.go_to(test)
        self._writer.begin(test)
        self._builder.cbranch(self._expressions.truth(node.test), body, after)
        self._writer.begin(body)
        self._write_turn(node.body, Loop(None, test, after))
        self._writer.go_to(test)
        self._writer.begin(after)

    def _refuse_else(self, node: ast.For | ast.While) -> None:
        if node.orelse:
            raise self._writer.error(node, 'else of a loop is not compiled')

    def _write_turn(self, body: Sequence[ast.stmt], loop: Loop) -> None:
        self._loops.append(loop)
        self._write_all(body)
        self._loops.pop()

    def visit_For(self, node: ast.For) -> None:
        """Write a loop over a range or a list, or what is in it for each element of a tuple."""
        self._refuse_else(node)
        if isinstance(node.iter, ast.Tuple):
            self._repeat(node, node.iter)
        elif isinstance(node.iter, ast.Call) and (
                self._expressions.named(node.iter.func) is range):
            begin, end, step = self._range(node, list(
                map(self._expressions.integer, node.iter.args)))
            sign = '<' if step.constant > 0 else '>'
            with self._writer.loop(begin, step, lambda at: self._builder.icmp_signed(
                    sign, at, end)) as loop:
                self._assign_to(node.target, Value(INTEGER, (loop.counter,)))
                self._write_turn(node.body, loop)
        else:
            header, kind = self._expressions.list(node.iter)
            with self._writer.indices(header) as loop:
                self._assign_to(node.target, self._writer.element(header, kind, loop.counter))
                self._write_turn(node.body, loop)

    def _range(self, node: ast.For, given: list[Any]) -> tuple[Any, Any, Any]:
        """Return begin, end and step of a range."""
        if len(given) == 1:
            given = [INT64(0), *given]
        begin, end, step = given if len(given) == 3 else [*given, INT64(1)]
        if not isinstance(step, ir.Constant):
            raise self._writer.error(node, 'the step of a range must be a constant')
        return begin, end, step

    def _repeat(self, node: ast.For, values: ast.Tuple) -> None:
        after = self._writer.block('after')
        # the turns may change what the elements are made of
        elements = [self._expressions.visit(each) for each in values.elts]
        for value in elements:
            following = self._writer.block('following')
            self._assign_to(node.target, value)
            self._write_turn(node.body, Loop(None, following, after))
            self._writer.go_to(following)
            self._writer.begin(following)
        self._writer.go_to(after)
        self._writer.begin(after)

    def visit_Break(self, node: ast.Break) -> None:
        """Leave the loop."""
        self._writer.go_to(self._loops[-1].after)

    def visit_Continue(self, node: ast.Continue) -> None:
        """Begin the loop again."""
        self._writer.go_to(self._loops[-1].again)
