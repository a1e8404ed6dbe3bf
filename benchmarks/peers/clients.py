"""Which other libraries work with our environments and learners, in which versions: short real checks.

python -m benchmarks clients --out docs/data/clients.json

What is not installed is skipped by name.
"""

from __future__ import annotations

import platform
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import tactilerl

from benchmarks.command import ROOT, parser, write
from benchmarks.peers.client_checks import CHECKS
from benchmarks.printing import markdown, progress

LIMIT = 600  # s a check
WORKS = "works"


def installed(package: str) -> str:
    """Its version; "" where it is not there."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def tried(name: str) -> str:
    """How a check ended, in a line."""
    command = [sys.executable, "-W", "ignore", "-m", "benchmarks.peers.client_check", name]
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        return f"takes more than {LIMIT} s"
    said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
    return said[-1] if done.returncode else WORKS


def measure(names: list[str]) -> list[dict[str, Any]]:
    """A row for each check whose client is installed."""
    rows = []
    for name in progress(names, "checks"):
        check = CHECKS[name]
        if found := installed(check.package):
            row = {"client": check.package, "version": found, "tried": check.tried}
            rows.append({**row, "result": tried(name)})
    return rows


def show(rows: list[dict[str, Any]], versions: dict[str, str]) -> None:
    """One table, whose last row is what all of it ran on."""
    keys = "client", "version", "tried", "result"
    cells = [[row[key].replace("|", "\\|") for key in keys] for row in rows]
    beneath = ", ".join(f"{name} {number}" for name, number in versions.items())
    markdown("| client | version | tried | result |", [*cells, ["all", "", f"on {beneath}", ""]])


def main() -> None:
    """All checks, or those that are named."""
    flags = parser(__doc__)
    flags.add_argument("--only", nargs="+", choices=CHECKS, default=[*CHECKS], metavar="CHECK")
    options = flags.parse_args()
    rows = measure(options.only)
    versions = {"tactilerl": tactilerl.__version__, "python": platform.python_version()}
    versions |= {name: installed(name) for name in ("mujoco", "torch", "numpy")}
    show(rows, versions)
    for package in sorted({CHECKS[name].package for name in options.only}):
        if not installed(package):
            print(f"skipped: {package} is not installed")
    write(options.out, {"versions": versions, "checks": rows})
