"""The parser of bench/mutants.py: which terms it finds, and what their factors do to the source."""

import ast
from pathlib import Path

import pytest
from bench.adjoint_terms import IN_KERNELS, ON_HOST, terms_of, with_factors

SRC = Path(__file__).parents[1] / "src" / "softmpm"
FILES = [path for path in sorted(SRC.rglob("*.py")) if terms_of(path, path.name)]
MUTANTS = SRC.parents[1] / "bench" / "mutants.py"
TOY = """
def f(a, b):
    return a + b

def f_adj(a, b, i: int):
    place = 3 * i
    c = table()
    size = a * b
    if size > 0.0:
        c[place] = a - 2 * (a + b)
    return c[place] + b
"""


def test_the_script_names_tests_that_are_there():
    """A path that has moved would silently leave its tests out, or the ignored one in."""
    constants = {
        node.targets[0].id: ast.literal_eval(node.value)
        for node in ast.parse(MUTANTS.read_text()).body
        if isinstance(node, ast.Assign) and node.targets[0].id in ("TESTS", "IGNORED")
    }
    for path in (*constants["TESTS"], constants["IGNORED"]):
        assert (SRC.parents[1] / path).exists(), path


def test_terms_of_a_toy(tmp_path):
    """Each sum, also in parentheses; no index, condition or zero, and nothing of a function that is no adjoint."""
    path = tmp_path / "toy.py"
    path.write_text("# @wp.func\n" + TOY)
    texts = [term.text for term in terms_of(path, "toy.py")]
    assert texts == ["a", "2 * (a + b)", "a", "b", "c[place]", "b"]


def test_a_factor_changes_its_term_alone(tmp_path):
    """Of 5 - 2 (5 + 7) + 7 one addend at a time, one per cent more."""
    path, active = tmp_path / "toy.py", []
    path.write_text("# @wp.func\n" + TOY)
    terms = terms_of(path, "toy.py")
    source = with_factors(path.read_text(), terms, 0).removeprefix(IN_KERNELS)
    space = dict(factor=lambda k, term: 1.01 * term if k in active else term, table=lambda: [0.0])
    exec(source, space)
    found = []
    for number in range(-1, len(terms)):
        active[:] = [number]
        found.append(space["f_adj"](5.0, 7.0, 0))
    want = [
        -12.0,
        5.05 - 24 + 7,
        5 - 24.24 + 7,
        5 - 2 * 12.05 + 7,
        5 - 2 * 12.07 + 7,
        -19 * 1.01 + 7,
        -19 + 7.07,
    ]
    assert found == pytest.approx(want)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_factors_keep_the_source(path):
    """Without its factors a source is what it was."""

    class Without(ast.NodeTransformer):
        def visit_Call(self, node):
            self.generic_visit(node)
            return node.args[1] if ast.unparse(node.func) == "factor" else node

    source = path.read_text()
    factored = with_factors(source, terms_of(path, path.name), 0)
    changed = Without().visit(ast.parse(factored.removeprefix(IN_KERNELS).removeprefix(ON_HOST)))
    assert ast.unparse(changed) == ast.unparse(ast.parse(source))


@pytest.mark.parametrize(
    "file, function, text",
    [
        ("particle.py", "moved_adj", "constants.dt * (wp.transpose(new_C) * adj_new.H)"),
        ("particle.py", "momentum_adj", "wp.ddot(adj_A, C)"),
        ("fixed_corotated.py", "pressure_slope", "real(2.0) * j"),
        ("polar.py", "rotation_adj", "c * (adj_R[1, 0] - adj_R[0, 1])"),
        ("separate.py", "slide_adj", "(c * along) * n"),
        ("gather_adj.py", "sums_adj", "wy[2] * tr"),
        ("packing.py", "leave_adj", "load_vec(adj, i, row_fx) / constants.spacing"),
        ("chunk.py", "vjp", "start.fx / model.scene.grid.spacing"),
    ],
)
def test_known_terms_are_found(file, function, text):
    """One of each kind of statement."""
    path = next(path for path in FILES if path.name == file)
    assert (function, text) in {(term.function, " ".join(term.text.split())) for term in terms_of(path, file)}
