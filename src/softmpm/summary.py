"""Short texts of objects, for ``repr`` and for notebooks."""

import html


def counted(number: int, noun: str, plural: str | None = None) -> str:
    """A number and its noun, such as "1 body" or "2 bodies"."""
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"


def table(title: str, rows: dict[str, str]) -> str:
    """HTML table of names and values."""
    cells = "".join(
        f"<tr><th style='text-align: left'>{html.escape(name)}</th>"
        f"<td style='text-align: left'>{html.escape(value)}</td></tr>"
        for name, value in rows.items()
    )
    return f"<b>{html.escape(title)}</b><table>{cells}</table>"
