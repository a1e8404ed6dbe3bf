"""What a fresh machine gets: the CPU build of PyTorch or nothing, and a package with all its files."""

import os
import subprocess
import sys
import zipfile
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest

from one_line import python

ROOT = Path(__file__).resolve().parents[1]


def write_wheel(folder, name, version, *requirements):
    """The smallest wheel that pip installs."""
    folder.mkdir(parents=True, exist_ok=True)
    needs = "".join(f"Requires-Dist: {requirement}\n" for requirement in requirements)
    info = f"{name}-{version}.dist-info"
    about = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n{needs}"
    kind = "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    with zipfile.ZipFile(folder / f"{name}-{version}-py3-none-any.whl", "w") as wheel:
        for file, text in (("METADATA", about), ("WHEEL", kind), ("RECORD", "")):
            wheel.writestr(f"{info}/{file}", text)


@pytest.fixture
def served(tmp_path):
    """Address of a server with two package indexes: pypi has PyTorch with CUDA, cpu without."""
    write_wheel(tmp_path / "pypi/torch", "torch", "2.0", "nvidia_cublas")
    write_wheel(tmp_path / "pypi/nvidia-cublas", "nvidia_cublas", "1.0")
    write_wheel(tmp_path / "cpu/torch", "torch", "2.0+cpu")
    server = ThreadingHTTPServer(
        ("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=str(tmp_path))
    )
    Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


@pytest.fixture
def install(served, tmp_path):
    """Runs the script; returns what it said and what it installed."""
    (tmp_path / "constraints.txt").write_text("torch==2.0\n")
    ours = {key: value for key, value in os.environ.items() if not key.startswith("PIP_")}
    pip = {"PIP_CONFIG_FILE": os.devnull, "PIP_INDEX_URL": f"{served}/pypi", "PIP_NO_CACHE_DIR": "1"}
    pip["PIP_NO_WARN_CONFLICTS"] = "1"  # with what this Python has installed
    pip["PIP_TARGET"] = str(tmp_path / "installed")

    def run(index, *flags):
        command = [sys.executable, str(ROOT / "tools/install_torch.py"), "--index", index]
        result = subprocess.run(
            [*command, "--constraint", "constraints.txt", *flags],
            cwd=tmp_path, env=ours | pip, capture_output=True, text=True,
        )  # fmt: skip
        return result, sorted(p.name for p in (tmp_path / "installed").glob("*.dist-info"))

    return run


def test_the_cpu_build_is_taken_where_its_index_answers(install, served):
    result, installed = install(f"{served}/cpu")
    assert result.returncode == 0, result.stderr
    assert installed == ["torch-2.0+cpu.dist-info"]


def test_cuda_is_refused_with_one_line(install, served):
    result, installed = install(f"{served}/nothing")
    assert result.returncode == 1
    assert not installed
    assert result.stderr.count("\n") == 1
    assert "brings CUDA" in result.stderr
    assert "make TORCH_INDEX=URL" in result.stderr


def test_without_the_index_what_pip_finds_will_do_if_it_is_a_cpu_build(install, tmp_path):
    write_wheel(tmp_path / "pypi/torch", "torch", "2.0+mine")
    result, installed = install("http://127.0.0.1:9")
    assert result.returncode == 0, result.stderr
    assert installed == ["torch-2.0+mine.dist-info"]


def test_cuda_comes_when_it_is_asked_for(install, served):
    result, installed = install(f"{served}/cpu", "--cuda")
    assert result.returncode == 0, result.stderr
    assert installed == ["nvidia_cublas-1.0.dist-info", "torch-2.0.dist-info"]


def test_the_wheel_has_every_file_and_runs_outside_the_checkout(tmp_path, in_tmp):
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    offline = ["--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "wheel", *offline, "--wheel-dir", tmp_path, str(ROOT)], check=True)
    (wheel,) = tmp_path.glob("tactilerl-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    shipped = {".py", ".toml", ".typed"}
    expected = {
        path.relative_to(ROOT).as_posix().removeprefix("tactilerl/")
        for folder in ("tactilerl", "envs", "algos")
        for path in (ROOT / folder).rglob("*")
        if path.suffix in shipped
    }
    package = tmp_path / "site/tactilerl"
    found = {p.relative_to(package).as_posix() for p in package.rglob("*") if p.suffix in shipped}
    assert found == expected
    code = "import tactilerl; print(tactilerl.__file__); from tactilerl.commands.cli import main; "
    code += "main(['env', '--env', 'lqr'])"
    result = python("-c", code, PYTHONPATH=str(package.parent))
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith(str(package))
    assert "lqr" in result.stdout
