"""`python -m benchmarks` lists the benchmarks, `python -m benchmarks NAME [OPTIONS]` runs one."""

from __future__ import annotations

import ast
import re
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from tactilerl.errors import InputError

from benchmarks.command import no_flags

HERE = Path(__file__).parent


def benchmarks() -> dict[str, Path]:
    """Return the files that have a `main`, or `TABLES` to print, by name."""
    files = sorted(
        path for path in HERE.rglob("*.py") if path.parent != HERE or path.stem in ("figures", "tables")
    )
    is_one = re.compile(r"^(def main\(|TABLES = )", re.MULTILINE)
    return {path.stem: path for path in files if is_one.search(path.read_text(encoding="utf-8"))}


def about(path: Path) -> str:
    """Return the first line of a file's docstring."""
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return docstring.splitlines()[0]


def usage(files: dict[str, Path]) -> str:
    """Return a list of all benchmarks, in their groups."""
    lines = ["usage: python -m benchmarks NAME [OPTIONS]"]
    for group in sorted({path.parent for path in files.values()}):
        lines += ["", about(group / "__init__.py")]
        lines += [f"  {name:18}{about(path)}" for name, path in files.items() if path.parent == group]
    return "\n".join(lines)


def main() -> int | None:
    """Run the benchmark that is named."""
    files = benchmarks()
    if len(sys.argv) < 2 or sys.argv[1] not in files:
        print(usage(files))
        return 0 if sys.argv[1:] in ([], ["-h"], ["--help"]) else 2
    name = sys.argv.pop(1)
    sys.argv[0] = f"python -m benchmarks {name}"
    module = ".".join(files[name].relative_to(HERE).with_suffix("").parts)
    try:
        benchmark: Any = import_module(f"benchmarks.{module}")
        if hasattr(benchmark, "main"):
            return benchmark.main()
        no_flags(benchmark.__doc__)
        if not benchmark.TABLES:
            raise InputError("docs/data: found no collected study of it")
        for name, show in benchmark.TABLES.items():
            print(f"\n### {name}\n")
            show()
        return None
    except InputError as error:
        print(f"{sys.argv[0]}: error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
