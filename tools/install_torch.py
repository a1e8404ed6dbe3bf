"""Install PyTorch into this Python, the CPU build unless CUDA is asked for; make runs it first.

On Linux, plain ``pip install torch`` brings gigabytes of CUDA. PyTorch's own index has a CPU build;
where that cannot be reached, what pip is configured to find will do, if no CUDA comes with it.
"""

import argparse
import json
import re
import subprocess
import sys
import urllib.request

PIP = (
    sys.executable,
    "-m",
    "pip",
    "install",
    "--quiet",
    "--no-compile",
    "--disable-pip-version-check",
)
SECONDS = 5  # to wait for the index


def has_torch(index):
    """Whether the index answers and has PyTorch."""
    try:
        urllib.request.urlopen(f"{index.rstrip('/')}/torch/", timeout=SECONDS).close()
    except (OSError, ValueError):
        return False
    return True


def cuda_packages(wanted):
    """Return the CUDA packages that pip would install with `wanted`; exit where it finds nothing."""
    plan = subprocess.run(
        [*PIP, "--dry-run", "--report", "-", *wanted], stdout=subprocess.PIPE
    )
    if plan.returncode:
        sys.exit(plan.returncode)
    names = [
        package["metadata"]["name"].lower()
        for package in json.loads(plan.stdout)["install"]
    ]
    return [name for name in names if re.match("(nvidia|cuda)[-_.]", name)]


def main():
    """Install PyTorch; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--index", required=True, help="package index with the CPU build"
    )
    parser.add_argument(
        "--constraint", required=True, help="file that pins the version"
    )
    parser.add_argument("--cuda", action="store_true", help="allow CUDA")
    args = parser.parse_args()
    wanted = ["--constraint", args.constraint, "torch"]
    if not args.cuda:
        found = has_torch(args.index)
        wanted += ["--extra-index-url", args.index] if found else []
        if cuda := cuda_packages(wanted):
            sys.exit(
                f"torch: pip found a build that brings CUDA ({len(cuda)} packages), and "
                f"{'no CPU build for this Python at' if found else 'could not reach'} {args.index}; "
                "name an index with the CPU build (make TORCH_INDEX=URL), a folder with its wheel "
                "(PIP_FIND_LINKS=FOLDER make), or allow CUDA (make CUDA=1)"
            )
    return subprocess.run([*PIP, *wanted]).returncode


if __name__ == "__main__":
    sys.exit(main())
