"""Which test notices an adjoint that is one per cent wrong? `python bench/mutants.py [--file polar] [--most 50 --seed 1]`

Every additive term of every explicit adjoint (adjoint_terms.py) gets a factor in a copy of the source. All of them are 1 but one, which
is 1.01: a mutant. The factors are read from memory, so that the kernels are compiled once for all mutants; each of these then runs the
tests in a process of its own, up to the first that fails. Results are appended to a JSON file, a line each; mutants that are there
already are left out, so that several runs complete the list. The CPU suffices: terms that only a GPU runs are in headers without
adjoints of their own.
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
    "tests/softmpm/test_rollout.py",
    "tests/softmpm/test_autograd.py",
    "tests/softmpm/test_warp_api.py",
    "tests/softmpm/schemes/fast/test_deterministic.py",
    "tests/softmpm/schemes/fast/test_sorted_state.py",
    "tests/softmpm/kernels",
)
"""In the order in which they run."""
IGNORED = "tests/softmpm/kernels/fast/test_compiled.py"
"""Counts registers, of which the factors take some."""
CELL = 0x7E0000000000
"""Address of the number of the mutant: kernels are compiled with it, so that it is the same in every run."""
FACTOR = f"""
import ctypes
import warp as wp

@wp.func_native("return *reinterpret_cast<const volatile int*>({CELL}ull) == k ? 1.01 : 1.0;")
def in_kernel(k: int) -> wp.float64: ...

def on_host(k: int) -> float:
    return 1.01 if ctypes.c_int.from_address({CELL}).value == k else 1.0
"""
HOMOGENEOUS = (
    "contact is homogeneous in the velocity, so that its adjoint depends on the direction of that alone"
)
UNCHANGED = {
    ("back", "v"): HOMOGENEOUS,
    ("back", "respond(walls, v)"): HOMOGENEOUS,
    (
        "grid_velocity_adj",
        "load_node(node_before, i)",
    ): "momentum and mass alike, of which only the quotient is used",
}
"""Mutants that give the same numbers, and the reason."""
PATIENCE = 300.0
"""Seconds for the tests of one mutant."""


class Trials:
    """pytest plugin: runs the collected tests once as they are, then again for each mutant, up to the first that fails.

    Args:
        numbers: Of the mutants.
        report: Takes the number of a mutant, the test that noticed it, and what that said; "" if none did.
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
        """In a process of its own, which a mutant may spoil."""
        context = multiprocessing.get_context("fork")
        ours, theirs = context.Pipe()
        process = context.Process(target=self._trial, args=(session, number, theirs))
        process.start()
        theirs.close()
        try:
            return ours.recv() if ours.poll(PATIENCE) else ("no end", f"after {PATIENCE:.0f} s")
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
    """Copy what the tests need to ``root``, a factor on each term of the adjoints; the terms in the order of their numbers."""
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
    parser.add_argument("--file", default="", help="only files with this in their name")
    parser.add_argument("--most", type=int, default=None, help="at most so many mutants, drawn at random")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--results", type=Path, default=Path("mutants.jsonl"))
    parser.add_argument("--list", action="store_true", help="print the terms, run nothing")
    return parser.parse_args()


def keys(terms: list[Term]) -> list[list]:
    """Names of terms that outlast changes elsewhere: file, function, text, and which of those alike it is."""
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
    """Let kernels read the number of the mutant, and imports find the copy."""
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
            print(f"{term}: {test or (f'cannot be noticed, {reason}' if reason else 'SURVIVED')}", flush=True)

        prepare(Path(folder).resolve())
        numbers = chosen(terms, args)
        trials = Trials(numbers, report)
        options = ["-s", "-m", "not gpu", "-p", "no:randomly", "-p", "no:cacheprovider", "-p", "no:terminal"]
        options += [f"--ignore={IGNORED}"]
        pytest.main([*options, *TESTS], plugins=[trials])
        if trials.failure[0]:
            print("no mutant ran")
            sys.exit(1)
        print(f"{len(terms)} terms, {len(numbers)} run now: {len(survivors)} survived", *survivors, sep="\n")
    sys.exit(1 if survivors else 0)


if __name__ == "__main__":
    main()
