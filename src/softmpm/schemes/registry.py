"""Registry of the schemes by name."""

from softmpm.schemes.fast.scheme import Fast
from softmpm.schemes.lagrangian.scheme import Lagrangian
from softmpm.schemes.plain.chunk import Plain
from softmpm.schemes.scheme import Scheme

SCHEMES: dict[str, type[Scheme]] = {"fast": Fast, "plain": Plain, "lagrangian": Lagrangian}
