"""Where commands write for people: one line stays one line however wide the terminal is."""

from rich.console import Console

console = Console(highlight=False, soft_wrap=True, markup=False)
