"""What a fresh machine gets: the CPU build of PyTorch or nothing, and a package with all its files."""

import importlib
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from tactilerl.commands.cli import main

from one_line import python

ROOT = Path(__file__).resolve().parents[1]


def test_a_pytorch_that_brings_cuda_is_not_installed_unasked(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    tool = importlib.import_module("install_torch")
    monkeypatch.setattr(tool, "has_torch", lambda index: False)
    monkeypatch.setattr(tool, "cuda_packages", lambda wanted: ["nvidia-cublas"])
    monkeypatch.setattr(subprocess, "run", lambda command: pytest.fail("it was installed"))
    monkeypatch.setattr(sys, "argv", ["x", "--index", "cpu", "--constraint", "c.txt"])
    with pytest.raises(SystemExit, match=r"brings CUDA .*make TORCH_INDEX=URL"):
        tool.main()


def test_make_train_trains_two_hands_side_by_side_and_fails_where_one_does(tmp_path):
    """In place of the command is one that notes what it is asked, and fails without touch."""
    noting = tmp_path / "tactilerl"
    noting.write_text(f'#!/bin/sh\necho "$*" >> {tmp_path}/asked\necho heard\ntest "$7" = on\n')
    noting.chmod(0o755)
    (tmp_path / "installed").touch()
    variables = f"BIN={tmp_path}", f"TRAINING={tmp_path}/installed", f"RUNS={tmp_path}"
    made = subprocess.run(["make", "train", *variables], cwd=ROOT, capture_output=True, text=True)
    assert made.returncode == 2
    assert {"touch     heard", "no_touch  heard"} <= {*made.stdout.splitlines()}
    assert "This films" not in made.stdout
    _, asked = sorted((tmp_path / "asked").read_text().splitlines())
    asked = asked.replace("--n-test-episodes 100", "--n-test-episodes 1")
    short = "--total-timesteps 1 --steps-per-epoch 1 --hidden 8 --n-passes 1"
    assert main(f"{asked} {short}".split()) == 0
    assert (tmp_path / "touch/checkpoint.pt").is_file()


def test_wheel_and_sdist_of_a_copy_have_every_file_and_run_outside_the_checkout(tmp_path, in_tmp):
    copy, names = tmp_path / "copy", ("tactilerl", "envs", "algos")
    for name in names:
        assert not (ROOT / "tactilerl" / name).is_symlink()  # an archive may have no links
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE", "NOTICE"):
        shutil.copy(ROOT / name, copy)
    make = "from setuptools import build_meta as b; b.build_sdist('..'); b.build_wheel('..')"
    subprocess.run([sys.executable, "-c", make], check=True, cwd=copy, capture_output=True)
    (wheel,), (sdist,) = tmp_path.glob("tactilerl-*.whl"), tmp_path.glob("tactilerl-*.tar.gz")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    with tarfile.open(sdist) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    kinds = {".py", ".toml", ".xml", ".j2", ".html", ".typed"}
    paths = [path.relative_to(ROOT) for name in names for path in (ROOT / name).rglob("*")]
    files = {path.as_posix() for path in paths if path.suffix in kinds}
    assert files <= packed
    package = tmp_path / "site/tactilerl"
    found = {p.relative_to(package).as_posix() for p in package.rglob("*") if p.is_file()}
    assert found == {name.removeprefix("tactilerl/") for name in files}
    code = "import tactilerl; print(tactilerl.__file__); from tactilerl.commands.cli import main; "
    code += "main(['env', '--env', 'shadow'])"
    result = python("-c", code, PYTHONPATH=str(package.parent))
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith(str(package))
    assert "shadow" in result.stdout


def test_a_part_of_the_package_is_never_there_twice(monkeypatch):
    monkeypatch.chdir(ROOT)
    result = python("-c", "import envs")
    assert result.stderr.strip().endswith("envs is part of tactilerl: import tactilerl.envs")
