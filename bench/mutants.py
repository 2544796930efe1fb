"""Mutation test of the adjoints, each term one per cent wrong: `python bench/mutants.py [--file polar] [--most 50 --seed 1]`

In a copy of the source, every additive term of every explicit adjoint (adjoint_terms.py) is multiplied by a factor. In a mutant one of
these factors is 1.01 and all others are 1. Kernels read the factors from memory, so that they are compiled once for all mutants. Each
mutant runs the tests in a separate process up to the first failure. Results are appended to a JSON Lines file; mutants that are listed
there are skipped, so that several runs complete the list. The CPU suffices: code that only a GPU runs is in headers without separate
adjoints.
"""

import argparse
import collections
import ctypes
import itertools
import json
import mmap
import multiprocessing
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from adjoint_terms import Term, terms_of, with_factors

ROOT = Path(__file__).parents[1]
TESTS = (
    "tests/softmpm/test_adjoint_terms.py",
    "tests/softmpm/test_inputs.py",
    "tests/softmpm/test_surface_contact.py",
    "tests/softmpm/test_surface_walls.py",
    "tests/softmpm/test_surface_contact_moving.py",
    "tests/softmpm/test_lagrangian.py",
    "tests/softmpm/test_mirror.py",
    "tests/softmpm/test_driven.py",
    "tests/softmpm/test_rollout.py",
    "tests/softmpm/test_autograd.py",
    "tests/softmpm/test_warp_api.py",
    "tests/softmpm/schemes/fast/test_deterministic.py",
    "tests/softmpm/schemes/fast/test_sorted_state.py",
    "tests/softmpm/kernels",
)
"""Tests, in the order in which they run."""
IGNORED = "tests/softmpm/kernels/fast/test_compiled.py"
"""Not run: it counts registers, and the factors change their number."""
CELL = 0x7E0000000000
"""Address of the number of the active mutant: compiled into the kernels, hence the same in every run."""
FACTOR = f"""
import ctypes
from typing import Any

import warp as wp

@wp.func_native("return *reinterpret_cast<const volatile int*>({CELL}ull) == k ? 1.01 : 1.0;")
def number(k: int) -> wp.float64: ...

@wp.func
def in_kernel(k: int, term: Any):
    return term.dtype(number(k)) * term

@wp.func
def in_kernel(k: int, term: wp.float32):
    return wp.float32(number(k)) * term

@wp.func
def in_kernel(k: int, term: wp.float64):
    return number(k) * term

def on_host(k: int, term):
    return (1.01 if ctypes.c_int.from_address({CELL}).value == k else 1.0) * term
"""
"""Module of the factors, whose precision is that of their terms: kernels of float32 compute places and poses in float64."""
HOMOGENEOUS = (
    "contact is homogeneous in the velocity, so that its adjoint depends on the direction of that alone"
)
UNCHANGED = {
    ("back", "v"): HOMOGENEOUS,
    ("back", "meet(inputs, world, x, v)"): HOMOGENEOUS,
    (
        "grid_velocity_adj",
        "load_node(node_before, i)",
    ): "momentum and mass alike, of which only the quotient is used",
    ("press_adj_at", "v"): "the velocity after the last wall has no adjoint",
}
"""Equivalent mutants, which do not change any result, and the reason."""
PATIENCE = 300.0
"""Time limit for the tests of one mutant [s]."""


class Trials:
    """pytest plugin that runs the collected tests without a mutant, then for each mutant up to the first failure.

    Args:
        numbers: Numbers of the mutants.
        report: Called with the number of a mutant, the test that detected it, and its message; "" if no test did.
    """

    def __init__(self, numbers: list[int], report: Callable[[int, str, str], None]):
        self.numbers, self.report, self.failure = numbers, report, ("", "")

    def pytest_runtest_logreport(self, report):
        if report.failed and not self.failure[0]:
            self.failure = report.nodeid, report.longreprtext.strip().splitlines()[-1]

    pytest_collectreport = pytest_runtest_logreport

    def pytest_runtestloop(self, session):
        begin = time.perf_counter()
        self._run(session)  # compiles and loads every kernel
        if self.failure[0]:
            print("without a mutant this test fails:", *self.failure)
            return True
        print(f"all tests pass without a mutant, in {time.perf_counter() - begin:.0f} s", flush=True)
        for number in self.numbers:
            self.report(number, *self._caught(session, number))
        return True

    def _run(self, session) -> None:
        for item, after in itertools.zip_longest(session.items, session.items[1:]):
            session.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
            if self.failure[0]:
                return

    def _caught(self, session, number: int) -> tuple[str, str]:
        """Test that detects a mutant, run in a separate process, which the mutant may corrupt."""
        context = multiprocessing.get_context("fork")
        ours, theirs = context.Pipe()
        process = context.Process(target=self._trial, args=(session, number, theirs))
        process.start()
        theirs.close()
        try:
            return ours.recv() if ours.poll(PATIENCE) else ("timeout", f"after {PATIENCE:.0f} s")
        except EOFError:
            return "a crash", "the process died"
        finally:
            process.kill()
            process.join()

    def _trial(self, session, number: int, pipe) -> None:
        ctypes.c_int.from_address(CELL).value = number
        self._run(session)
        pipe.send(self.failure)


def instrument(root: Path) -> list[Term]:
    """Copy sources and tests to ``root``, with a factor on each term of the adjoints; returns the terms in that order."""
    for name in ("src", "tests", "conf", "pyproject.toml"):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, root / name)
    (root / "src" / "mutant.py").write_text(FACTOR)
    terms: list[Term] = []
    for path in sorted((root / "src" / "softmpm").rglob("*.py")):
        found = terms_of(path, str(path.relative_to(root / "src" / "softmpm")))
        if found:
            path.write_text(with_factors(path.read_text(), found, len(terms)))
            terms += found
    return terms


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--file", default="", help="only files whose name contains this")
    parser.add_argument("--most", type=int, default=None, help="largest number of mutants, drawn at random")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--tests", nargs="+", default=TESTS, help="tests to run instead of all that TESTS lists"
    )
    parser.add_argument("--results", type=Path, default=Path("mutants.jsonl"))
    parser.add_argument("--list", action="store_true", help="print the terms, run nothing")
    return parser.parse_args()


def keys(terms: list[Term]) -> list[list]:
    """Names of terms that do not depend on line numbers: file, function, text, and a counter for equal ones."""
    alike, found = collections.Counter(), []
    for term in terms:
        same = term.file, term.function, term.text
        found.append([*same, alike[same]])
        alike[same] += 1
    return found


def chosen(terms: list[Term], args: argparse.Namespace) -> list[int]:
    """Numbers of the mutants to run."""
    done = (
        [json.loads(line)["term"] for line in args.results.read_text().splitlines()]
        if args.results.exists()
        else []
    )
    left = [k for k, key in enumerate(keys(terms)) if args.file in key[0] and key not in done]
    if args.most is not None and args.most < len(left):
        left = sorted(random.Random(args.seed).sample(left, args.most))
    return left


def prepare(root: Path) -> None:
    """Map the page with the number of the mutant, and put the copy first on the import path."""
    memory = ctypes.CDLL(None).mmap
    memory.restype, memory.argtypes = ctypes.c_void_p, [ctypes.c_void_p, ctypes.c_size_t, *4 * [ctypes.c_int]]
    protection, fixed = mmap.PROT_READ | mmap.PROT_WRITE, 0x100000  # MAP_FIXED_NOREPLACE
    got = memory(CELL, mmap.PAGESIZE, protection, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | fixed, -1, 0)
    assert got == CELL, "the address of the number of the mutant is taken"
    ctypes.c_int.from_address(CELL).value = -1
    sys.path.insert(0, str(root / "src"))
    os.chdir(root)
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR


def main() -> None:
    args = arguments()
    args.results = args.results.absolute()
    with tempfile.TemporaryDirectory() as folder:
        terms = instrument(Path(folder).resolve())
        if args.list:
            print(*terms, f"{len(terms)} terms", sep="\n")
            return
        survivors, names = [], keys(terms)

        def report(number: int, test: str, message: str) -> None:
            term = terms[number]
            reason = UNCHANGED.get((term.function, term.text), "") if not test else ""
            result = {"term": names[number], "caught by": test, "message": message, "unchanged": reason}
            with args.results.open("a") as file:
                file.write(json.dumps(result) + "\n")
            if not (test or reason):
                survivors.append(term)
            print(f"{term}: {test or (f'equivalent, {reason}' if reason else 'SURVIVED')}", flush=True)

        prepare(Path(folder).resolve())
        numbers = chosen(terms, args)
        trials = Trials(numbers, report)
        options = ["-s", "-m", "not gpu", "-p", "no:randomly", "-p", "no:cacheprovider", "-p", "no:terminal"]
        options += [f"--ignore={IGNORED}"]
        pytest.main([*options, *args.tests], plugins=[trials])
        if trials.failure[0]:
            print("no mutant ran")
            sys.exit(1)
        print(f"{len(terms)} terms, {len(numbers)} run now: {len(survivors)} survived", *survivors, sep="\n")
    sys.exit(1 if survivors else 0)


if __name__ == "__main__":
    main()
