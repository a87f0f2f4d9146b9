"""The house rules: sizes of functions, shapes of arrays, docstrings of constants."""

from __future__ import annotations

import ast
import functools
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "dro_grasp"
LONGEST_FUNCTION = 60
SHAPED = {"Float", "Int", "Bool", "UInt8", "Num", "Shaped", "Integer", "Real"}
"""Types of jaxtyping, which state the shape of the array that they hold."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


@functools.cache
def parsed(text: str) -> ast.Module:
    return ast.parse(text)


def functions(tree: ast.Module) -> Iterator[Function]:
    return (node for node in ast.walk(tree) if isinstance(node, Function))


def parameters(function: Function) -> list[ast.arg]:
    named = function.args.posonlyargs + function.args.args + function.args.kwonlyargs
    named += [arg for arg in (function.args.vararg, function.args.kwarg) if arg is not None]
    return [arg for arg in named if arg.arg not in {"self", "cls"}]


def has_bare_array(annotation: ast.AST | None) -> bool:
    """Whether a type is, or contains, a tensor or an array without a shape."""
    if annotation is None or (isinstance(annotation, ast.Subscript) and getattr(annotation.value, "id", None) in SHAPED):
        return False
    if isinstance(annotation, ast.Name | ast.Attribute):
        return getattr(annotation, "id", None) == "Tensor" or getattr(annotation, "attr", None) in {"Tensor", "ndarray"}
    return any(map(has_bare_array, ast.iter_child_nodes(annotation)))


def long_functions(text: str) -> Iterator[str]:
    for f in functions(parsed(text)):
        if (lines := f.end_lineno - f.lineno + 1) > LONGEST_FUNCTION:
            yield f"{f.lineno}: {f.name} has {lines} lines, at most {LONGEST_FUNCTION}: split it"


def bare_arrays(text: str) -> Iterator[str]:
    tree = parsed(text)
    places = [(f"{f.name}({arg.arg})", arg.lineno, arg.annotation) for f in functions(tree) for arg in parameters(f)]
    places += [(f"the result of {f.name}", f.lineno, f.returns) for f in functions(tree)]
    places += [(f"{c.name}.{ast.unparse(field.target)}", field.lineno, field.annotation) for c in ast.walk(tree)
               if isinstance(c, ast.ClassDef) for field in c.body if isinstance(field, ast.AnnAssign)]
    for name, line, annotation in places:
        if has_bare_array(annotation):
            yield f'{line}: {name} is an array without a shape: write Float[Tensor, "n 3"]'


def bare_constants(text: str) -> Iterator[str]:
    body, lines = parsed(text).body, text.splitlines()
    for node, following in zip(body, [*body[1:], None], strict=True):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        for target in targets:
            if isinstance(target, ast.Tuple) and any(getattr(name, "id", "").isupper() for name in target.elts):
                yield f"{node.lineno}: several constants in one assignment: give each its own line and docstring"
            elif isinstance(target, ast.Name) and target.id.isupper() and not (
                _is_docstring(following) or "  # " in lines[(node.end_lineno or node.lineno) - 1]):
                yield f"{node.lineno}: {target.id} has no docstring: write its meaning, unit and source under it, or behind it"


def _is_docstring(node: ast.stmt | None) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


Rule = Callable[[str], Iterator[str]]
RULES: list[Rule] = [long_functions, bare_arrays, bare_constants]


@pytest.mark.parametrize("rule", RULES)
def test_every_module_keeps_the_rules(rule: Rule) -> None:
    found = [f"{path.relative_to(SOURCE)}:{violation}" for path in sorted(SOURCE.rglob("*.py"))
             for violation in rule(path.read_text())]
    assert not found, "\n" + "\n".join(found)


BROKEN = {
    long_functions: "def f() -> None:\n" + "    pass\n" * LONGEST_FUNCTION,
    bare_arrays: "class A:\n    def f(self, x: list[np.ndarray]) -> None: ...",
    bare_constants: "A = 1\nB = 2\n'''Only of B.'''",
}
KEPT = {
    long_functions: "def f() -> None:\n" + "    pass\n" * (LONGEST_FUNCTION - 1),
    bare_arrays: "class A:\n    x: Float[Tensor, '...']\n    def f(self, x: list[Int[np.ndarray, 'n']]) -> Tensors: ...",
    bare_constants: "A = 1\n'''Of A.'''\nb = 2\nC = 3  # Of C",
}


@pytest.mark.parametrize("rule", RULES)
def test_a_rule_sees_what_breaks_it_and_nothing_else(rule: Rule) -> None:
    assert len(list(rule(BROKEN[rule]))) == 1
    assert not list(rule(KEPT[rule]))
    if rule is bare_arrays:
        assert len(list(rule("def f(x) -> Tensor | None: ..."))) == len(list(rule("class A:\n    x: Tensor"))) == 1
    if rule is bare_constants:
        assert len(list(rule("A, B = 1, 2\n'''Both.'''"))) == 1
