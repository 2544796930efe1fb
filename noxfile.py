"""``nox -s check`` before every commit; ``nox -s gpu`` and ``nox -s bench`` on a machine with a GPU."""

import nox

nox.options.sessions = ["check"]


@nox.session
def check(session: nox.Session) -> None:
    """Format, lint, types and the tests on the CPU."""
    session.install("-e", ".[dev]")
    session.run("ruff", "format", "--check", ".")
    session.run("ruff", "check", ".")
    session.run("pyright")
    session.run("pytest", "-m", "not gpu", *session.posargs, env={"OMP_NUM_THREADS": "1"})


@nox.session
def docs(session: nox.Session) -> None:
    """The site of the documentation, in ``site/``; a warning is an error."""
    session.install("-e", ".[docs]")
    session.run("python", "-m", "sphinx", "-W", "--keep-going", "-q", "docs", "site")


@nox.session
def gpu(session: nox.Session) -> None:
    """The tests that need a GPU."""
    session.install("-e", ".[dev]")
    session.run("pytest", "-m", "gpu", *session.posargs)


@nox.session
def bench(session: nox.Session) -> None:
    """Time of a substep and of a gradient (``bench/step.py``, ``bench/gradient.py``), or the benchmarks named."""
    session.install("-e", ".[dev]")
    for name in session.posargs or ("step", "gradient"):
        session.run("python", f"bench/{name}.py")
