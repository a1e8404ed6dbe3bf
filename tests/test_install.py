"""What a fresh machine gets: the CPU build of PyTorch or nothing, and a package with all its files."""

import importlib
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

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
    (tmp_path / "no_touch").mkdir()
    (tmp_path / "no_touch" / "thesis.tex").write_text("")
    short = "--scene handover --total-timesteps 1 --steps-per-epoch 1 --hidden 8 --n-passes 1"
    (tmp_path / "installed").touch()
    variables = f"BIN={Path(sys.executable).parent}", f"TRAINING={tmp_path}/installed"
    variables += f"RUNS={tmp_path}", f"TRAIN={short}"
    made = subprocess.run(["make", "train", *variables], cwd=ROOT, capture_output=True, text=True)
    assert made.returncode == 2
    assert "no_touch' exists but is not a run folder" in made.stderr
    assert re.search(r"^touch +The run is in ", made.stdout, re.MULTILINE)
    assert "This films" not in made.stdout
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
