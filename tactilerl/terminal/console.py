"""Where commands write for people: one line stays one line however wide the terminal is."""

import textwrap

from rich.console import Console

console = Console(highlight=False, soft_wrap=True, markup=False)
COLUMNS = 100


def paragraph(label: str, text: str) -> str:
    """Lines of at most COLUMNS: a label, and the text to the right of it."""
    return textwrap.fill(
        text, COLUMNS, initial_indent=f"  {label:8} ", subsequent_indent=11 * " ",
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip
