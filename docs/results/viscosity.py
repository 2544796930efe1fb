"""Print the figures of "Twenty seeds" and "A more viscous material" in docs/results.md, from lasting.csv beside this script."""

from comparison import Row
from lasting import both, compare, figures, lasting, lucky, print_examined, walking
from settling import table

BEFORE, NOW = "a best repeats itself", "2 ms"
"""Twenty fresh seeds of each robot with η/μ = 1 ms and with 2 ms."""


def main():
    kinds: dict[tuple[str, str, str], list[Row]] = {}
    for row in table("lasting.csv"):
        kinds.setdefault((row["robot"], row["iterations"], row["choice"]), []).append(row)
    for (robot, iterations, choice), rows in kinds.items():
        if choice == BEFORE or " ms" in choice:
            print(f"{robot}, {iterations}, {choice} | {figures(rows)} | {lucky(walking(rows))[0]}")
            if walking(rows):
                print_examined(walking(rows))
    now, before = (
        both(*(lasting(kinds[robot, "100", choice]) for robot in ("biped", "elephant")))
        for choice in (NOW, BEFORE)
    )
    compare("walkers that last, of those that walk", now, before)
    fine = [kinds["elephant", iterations, f"standard, {ms} ms"] for iterations, ms in (("100", 1), ("60", 2))]
    walk = [(len(walking(rows)), len(rows)) for rows in fine]
    compare("elephants at the standard resolution that walk", walk[1], walk[0])


if __name__ == "__main__":
    main()
