"""The additive terms of the explicit adjoints, found in their source, and that source with a factor on each of them.

An adjoint is a function whose name, or that of a function around it, ends in ``_adj`` or ``_slope``, or one of the few in ``ALSO``.
Its terms are the addends of every value that it assigns, adds, stores, passes to another adjoint or returns, including sums inside
parentheses and components of vectors. Indices, conditions, zeros and whole structs are not terms.
"""

import ast
import collections
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ALSO = ("slopes", "vjp", "collect", "parts", "total")
"""Functions without these suffixes that only adjoints use."""
BUILDERS = ("vec", "mat", "triple", "node_vec", "aligned", "pack", "matrix_from_cols", "skew")
"""Calls whose arguments are the components of a value."""
STORES = {
    "store_vec": 3,
    "store_mat": 3,
    "spread_vec": 2,
    "spread_mat": 2,
    "atomic_add": -1,
    "leave": 2,
    "copy_": 0,
    "mul_": 0,
}
"""Calls that store a value, and the index of that argument."""
ON_HOST = "from mutant import on_host as factor\n"
IN_KERNELS = "from mutant import in_kernel as factor\n"
"""First lines of a source with factors."""
INTEGERS = (
    *(
        "tid",
        "int",
        "world_of",
        "particle_of",
        "first_node",
        "unpack_base",
        "node_index",
        "node_coordinates",
    ),
    *("place_of", "place", "present", "exact_vec"),
    *("coordinates", "offset", "range", "len", "law_of", "actuator_of"),
)
"""Calls that return integers, or places in float64, which decide between branches."""
STRUCTS = (
    *(
        "moved_adj",
        "momentum_adj",
        "gather_adj",
        "slope_adj",
        "node_velocity_adj",
        "after_free_adj",
        "free_adj",
        "viscous_stress_adj",
        "respond_adj",
        "slide_adj",
        "placed",
    ),
    *("stress_adj_of", "active_stress_adj_of", "forced_adj", "touch", "touch_adj"),
    *(
        "through_others",
        "after_all_walls_adj",
        "meet",
        "meet_adj",
        "response_adj",
        "face",
        "faces_of",
        "pose",
        "way_adj",
        "fit",
    ),
)
"""Calls that return structs, which cannot be multiplied by a factor; their fields are terms where they are used."""
FIELDS = (
    *("shape", "count", "muscle", "base", "origin", "order", "places", "law", "driven", "actuator"),
    *("particles", "first", "members", "stencil", "cell_nodes", "node_cells", "number", "shift"),
)
"""Attributes and arrays of integers or places."""
COUNTS = ("count", "arms")
"""Constants of a factory that are integers."""


@dataclass(frozen=True)
class Term:
    """A term of the adjoint ``function`` in ``file``, at a place of its source that is only good until the source changes."""

    file: str
    function: str
    line: int
    text: str
    start: int
    end: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line} {self.function}: {' '.join(self.text.split())}"


def terms_of(path: Path, file: str) -> list[Term]:
    """All terms of a source file, in its order."""
    source = path.read_text()
    found: dict[tuple[int, int], Term] = {}
    for function in _adjoints(ast.parse(source), False):
        for node in _terms(function) if _in_kernels(source) else _stored_on_the_host(function):
            start, end = _span(source, node)
            term = Term(file, function.name, node.lineno, source[start:end], start, end)
            found.setdefault((start, end), term)
    return [found[span] for span in sorted(found)]


def with_factors(source: str, terms: list[Term], first: int) -> str:
    """The source with ``factor(k, term)`` for each term, k from ``first`` on."""
    openings, closings = collections.defaultdict(str), collections.Counter()
    for k, term in sorted(
        enumerate(terms, first), key=lambda pair: pair[1].start - pair[1].end
    ):  # outer ones first
        openings[term.start] += f"factor({k}, "
        closings[term.end] += 1
    parts = [openings[i] + letter + ")" * closings[i + 1] for i, letter in enumerate(source)]
    return (IN_KERNELS if _in_kernels(source) else ON_HOST) + "".join(parts)


def _adjoints(node: ast.AST, inside: bool) -> Iterator[ast.FunctionDef]:
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.FunctionDef):
            yield from _adjoints(child, inside)
            continue
        named = child.name.endswith(("_adj", "_slope")) or child.name in ALSO
        leaf = not any(
            isinstance(n, (ast.FunctionDef, ast.ClassDef)) for n in ast.walk(child) if n is not child
        )
        if leaf and (named or (inside and child.decorator_list)):
            yield child
        elif not leaf:
            yield from _adjoints(child, inside or named)


def _span(source: str, node: ast.expr) -> tuple[int, int]:
    """First and last character of an expression, which ``ast`` counts in bytes of its line."""
    lines = source.splitlines(keepends=True)

    def place(line: int, column: int) -> int:
        return sum(map(len, lines[: line - 1])) + len(lines[line - 1].encode()[:column].decode())

    assert node.end_lineno is not None and node.end_col_offset is not None
    return place(node.lineno, node.col_offset), place(node.end_lineno, node.end_col_offset)


def _terms(function: ast.FunctionDef) -> Iterator[ast.expr]:
    whole = {
        a.arg
        for a in function.args.args
        if a.annotation is not None and ast.unparse(a.annotation) in ("int", "ivec", "bool")
    }
    tested = _only_tested(function)
    struct = function.returns is not None and ast.unparse(function.returns)[:1].isupper()
    for node in sorted((n for n in ast.walk(function) if isinstance(n, ast.stmt)), key=lambda n: n.lineno):
        if isinstance(node, ast.For) and isinstance(node.target, ast.Name):
            whole.add(node.target.id)
        elif isinstance(node, ast.Assign):
            names = {n.id for target in node.targets for n in _leaves(target)}
            if _is_whole(node.value, whole):
                whole |= names
            elif isinstance(node.value, ast.Call) and _called(node.value)[:1].isupper():
                whole |= {
                    n.id for n in node.targets if isinstance(n, ast.Name)
                }  # a struct, whose fields follow
            elif not names or not names <= tested:
                yield from _sum(node.value, whole)
        elif isinstance(node, ast.AugAssign) or (
            isinstance(node, ast.Return) and node.value is not None and not struct
        ):
            yield from _sum(node.value, whole)
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
            yield from _stored(node.value, whole)


def _stored_on_the_host(function: ast.FunctionDef) -> Iterator[ast.expr]:
    """Terms of a function on tensors: values that are copied, scaled in place or put into a state."""
    for call in (n for n in ast.walk(function) if isinstance(n, ast.Call)):
        if _called(call) in ("copy_", "mul_"):
            yield call.args[0]
        elif _called(call) == "State":
            yield from (value for value in call.args if not isinstance(value, ast.Starred))


def _stored(call: ast.Call, whole: set[str]) -> Iterator[ast.expr]:
    name = _called(call)
    if name in STORES:
        yield from _sum(call.args[STORES[name]], whole)
    elif name == "scatter":
        for value in call.args[4:6]:
            yield from _sum(value, whole)


def _sum(node: ast.expr, whole: set[str]) -> Iterator[ast.expr]:
    """The terms of a value: its own, and those inside each of them."""
    for term in _addends(node):
        if isinstance(term, ast.Constant) or _is_whole(term, whole) or _is_zero(term):
            continue
        inner = term.operand if isinstance(term, ast.UnaryOp) else term
        name = _called(inner) if isinstance(inner, ast.Call) else ""
        struct = name in STRUCTS or (isinstance(inner, ast.Name) and inner.id in whole)
        if name not in BUILDERS and not struct:
            yield term
        yield from _inside(inner, whole)


def _inside(node: ast.AST, whole: set[str]) -> Iterator[ast.expr]:
    """Terms inside an expression: sums in parentheses, components of vectors, arguments of other adjoints."""
    if isinstance(node, ast.Call):
        name = _called(node)
        for value in node.args:
            if name in BUILDERS or (name.endswith("_adj") and isinstance(value, (ast.BinOp, ast.UnaryOp))):
                yield from _sum(value, whole)
            elif name not in INTEGERS:
                yield from _inside(value, whole) if not _splits(value) else _sum(value, whole)
        return
    for child in ast.iter_child_nodes(node):
        if isinstance(node, ast.Subscript) and child is node.slice:
            continue
        if isinstance(child, ast.expr) and _splits(child):
            yield from _sum(child, whole)
        else:
            yield from _inside(child, whole)


def _splits(node: ast.AST) -> bool:
    return isinstance(node, ast.BinOp) and isinstance(node.op, (ast.Add, ast.Sub))


def _addends(node: ast.expr) -> Iterator[ast.expr]:
    if isinstance(node, ast.BinOp) and isinstance(node.op, (ast.Add, ast.Sub)):
        yield from _addends(node.left)
        yield from _addends(node.right)
    else:
        yield node


def _is_zero(node: ast.expr) -> bool:
    """True for a new vector, struct or number that is zero."""
    if not isinstance(node, ast.Call) or node.keywords or _called(node) == "identity":
        return False
    return not node.args or all(isinstance(a, ast.Constant) and a.value == 0.0 for a in node.args)


def _is_whole(node: ast.AST, whole: set[str]) -> bool:
    if isinstance(node, ast.Name):
        return node.id in whole or node.id in COUNTS
    if isinstance(node, ast.Constant):
        return isinstance(node.value, (int, bool))
    if isinstance(node, ast.Attribute):
        return node.attr in FIELDS
    if isinstance(node, ast.Subscript):
        return _is_whole(node.value, whole) or (isinstance(node.value, ast.Name) and node.value.id in FIELDS)
    if isinstance(node, ast.Call):
        return _called(node) in INTEGERS
    if isinstance(node, ast.Compare):
        return True
    if isinstance(node, ast.BinOp):
        return _is_whole(node.left, whole) and _is_whole(node.right, whole)
    return isinstance(node, ast.UnaryOp) and _is_whole(node.operand, whole)


def _only_tested(function: ast.FunctionDef) -> set[str]:
    """Names that are read in conditions only."""
    tests = {id(n) for c in ast.walk(function) if isinstance(c, ast.If) for n in ast.walk(c.test)}
    read = [n for n in ast.walk(function) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Load)]
    return {n.id for n in read} - {n.id for n in read if id(n) not in tests}


def _called(call: ast.Call) -> str:
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


def _leaves(target: ast.expr) -> Iterator[ast.Name]:
    yield from (n for n in ast.walk(target) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store))


def _in_kernels(source: str) -> bool:
    """True if the functions of a file are those of kernels."""
    return "@wp." in source or "@kernel(" in source
