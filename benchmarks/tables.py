"""Write the tables of the docs anew from the data committed beside them.

    python -m benchmarks tables

A table stands between two comments, `<!-- table NAME -->` and `<!-- end -->`. The tests compare them.
"""

from __future__ import annotations

import io
import itertools
import re
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import partial
from typing import Any

from benchmarks import environments
from benchmarks.command import DOCS, ROOT, data, no_flags
from benchmarks.peers import env, solve, updates
from benchmarks.physics import forces, hands, hard_cases, hold_verdict, softness, speed_vs_error
from benchmarks.studies import gates, layouts_study, paper_source, study_tables

MARKED = re.compile(r"(<!-- table (.+?) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def _of(name: str, show: Callable[..., None], *more: Any) -> Callable[[], None]:
    return lambda: show(data(name), *more)


def _parts(name: str, show: Callable[..., None], *parts: str) -> Callable[[], None]:
    return lambda: show(*map(data(name).get, parts))


def _settings(pair: str) -> Callable[[], None]:
    return lambda: speed_vs_error.show(data("speed_vs_error")[pair]["settings"])


PRINTED: dict[str, Callable[[], None]] = {
    "hold verdict": _of("hold_verdict", hold_verdict.show),
    "updates": _parts("peers", updates.show, "updates"),
    "steps": _parts("peers", env.show, "env"),
    "toys": _parts("peers", solve.show, "solve"),
    "forces": _of("forces", forces.show),
    "physics": _of("speed_vs_error", speed_vs_error.show_shipped),
    **{
        f"physics {pair}": _settings(pair)
        for pair in itertools.starmap(
            "{} in {}".format, itertools.product(speed_vs_error.SIZES, speed_vs_error.SETTINGS)
        )
    },
    "hands": _of("hands", hands.show),
    "hard cases": _of("hard_cases", hard_cases.show),
    "softness": _of("softness", softness.show),
    "softness grasps": _of("softness", softness.show_grasps),
    **study_tables.TABLES,
    **layouts_study.TABLES,
    **paper_source.TABLES,
    **{f"gates {name}": _of("gates", partial(gates.show, name)) for name in gates.tables()},
    **environments.TABLES,
}
"""What prints each table, perhaps with a title."""


def table(name: str) -> str:
    """Return a table as it should stand in the docs."""
    with redirect_stdout(io.StringIO()) as printed:
        PRINTED[name]()
    return "".join(f"{line}\n" for line in printed.getvalue().splitlines() if line.startswith("|"))


def filled(text: str) -> str:
    """Return a page with its tables written anew."""
    return MARKED.sub(lambda match: match[1] + table(match[2]) + match[4], text)


def main() -> None:
    """Write the tables of every page anew."""
    no_flags(__doc__)
    for page in sorted(DOCS.rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        if (new := filled(text)) != text:
            page.write_text(new, encoding="utf-8")
            print(page.relative_to(ROOT))
