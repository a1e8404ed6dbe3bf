"""`python -m benchmarks` lists the benchmarks, `python -m benchmarks NAME [OPTIONS]` runs one."""

from __future__ import annotations

import ast
import sys
from importlib import import_module
from pathlib import Path

from tactilerl.errors import InputError

HERE = Path(__file__).parent


def found() -> dict[str, Path]:
    """The files that have a `main`, by name."""
    files = sorted(
        path
        for path in HERE.rglob("*.py")
        if path.parent != HERE or path.stem in ("figures", "tables", "times")
    )
    return {path.stem: path for path in files if "\ndef main(" in path.read_text(encoding="utf-8")}


def about(path: Path) -> str:
    """First line of a file's docstring."""
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return docstring.splitlines()[0]


def usage(files: dict[str, Path]) -> str:
    """Every benchmark in its group."""
    lines = ["usage: python -m benchmarks NAME [OPTIONS]"]
    for group in sorted({path.parent for path in files.values()}):
        lines += ["", about(group / "__init__.py")]
        own = {name: path for name, path in files.items() if path.parent == group}
        lines += [f"  {name:18}{about(path)}" for name, path in own.items()]
    return "\n".join(lines)


def main() -> int | None:
    """Run the benchmark that is named."""
    files = found()
    if len(sys.argv) < 2 or sys.argv[1] not in files:
        print(usage(files))
        return 0 if sys.argv[1:] in ([], ["-h"], ["--help"]) else 2
    name = sys.argv.pop(1)
    sys.argv[0] = f"python -m benchmarks {name}"
    module = ".".join(files[name].relative_to(HERE).with_suffix("").parts)
    try:
        code: int | None = import_module(f"benchmarks.{module}").main()
    except InputError as error:
        print(f"{sys.argv[0]}: error: {error}", file=sys.stderr)
        code = 2
    return code


if __name__ == "__main__":
    sys.exit(main())
