"""What a kernel does before an instruction, read from its PTX: every way through its code is followed from the entry."""

import itertools
import re
from collections import defaultdict

REGISTER = re.compile(r"%[a-z]+\d+")
PARAMETER = re.compile(r"_param_(\d+)(?:\+(\d+))?\]")
LABEL = re.compile(r"^(\$\w+):")
BRANCH = re.compile(r"^(@!?%p\d+\s+)?bra(?:\.uni)?\s+(\$\w+);")
BASE = re.compile(r"mov\.b64\s+(%rd\d+), \w+_param_(\d+);")
"""The address of a parameter, by which its parts are read."""
OPERATION = re.compile(r"^(?:@!?%p\d+\s+)?((ld|st|red|atom)\.[\w.]+)")
APART = {"param", "shared", "local", "const"}
"""Memory that no other kernel sees."""
Parameter = tuple[int, int]
"""Number of a parameter, and offset within it [bytes]."""


def until(code: str, stop: str) -> list[str]:
    """Instructions that a thread may execute before one that contains ``stop``."""
    lines = [line.strip() for line in code[code.index("{") :].splitlines()]
    labels = {found[1]: n for n, line in enumerate(lines) if (found := LABEL.match(line))}
    ways, seen = [0], set()
    while ways:
        n = ways.pop()
        while n < len(lines) and n not in seen:
            seen.add(n)
            if stop in lines[n]:
                break
            if branch := BRANCH.match(lines[n]):
                ways.append(labels[branch[2]])
                if not branch[1]:
                    break
            if re.match(r"(ret|exit);", lines[n]):
                break
            n += 1
    return [lines[n] for n in sorted(seen) if stop not in lines[n]]


def leaves(instructions: list[str]) -> list[str]:
    """Predicates of the branches among these instructions that lead to the end of the kernel."""
    ends = {
        found[1] for a, b in itertools.pairwise(instructions) if b == "ret;" and (found := LABEL.match(a))
    }
    return [
        found[1].strip("@! \t") for line in instructions if (found := BRANCH.match(line)) and found[2] in ends
    ]


def touched(instructions: list[str]) -> dict[str, set[Parameter]]:
    """Parameters from which addresses of global memory are computed, by the operation: "ld", "ld.cg" past the nearest cache, "ld.nc" of
    read-only memory, "st", "red" or "atom"."""
    bases = {found[1]: found[2] for line in instructions if (found := BASE.match(line))}

    def part(found: re.Match) -> str:
        return f"[_param_{bases[found[1]]}{found[2] or ''}]" if found[1] in bases else found[0]

    instructions = [
        re.sub(r"\[(%rd\d+)(\+\d+)?\]", part, line) if "ld.param" in line else line for line in instructions
    ]
    origin = defaultdict[str, set[Parameter]](set)
    while True:
        before = sum(map(len, origin.values()))
        for line in instructions:
            if (operation := OPERATION.match(line)) and "param" not in operation[1]:
                continue  # a value, not an address
            results, _, rest = line.partition(",") if "{" not in line else line.partition("}")
            sources = set().union(*(origin[name] for name in REGISTER.findall(rest)))
            sources |= {(int(number), int(offset or 0)) for number, offset in PARAMETER.findall(rest)}
            for name in REGISTER.findall(results):
                if sources:
                    origin[name] |= sources
        if sum(map(len, origin.values())) == before:
            break
    found = defaultdict[str, set[Parameter]](set)
    for line in instructions:
        if not (operation := OPERATION.match(line)) or APART & set(operation[1].split(".")):
            continue
        address = line[line.index("[") : line.index("]")]
        origins = set().union(*(origin[name] for name in REGISTER.findall(address)))
        assert origins, f"the origin of this address is not known: {line}"
        way = [word for word in ("cg", "nc") if word in operation[1].split(".")]
        found[".".join([operation[2], *way])] |= origins
    return dict(found)
