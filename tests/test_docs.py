"""The docs hold: links lead somewhere, commands and flags exist, examples in Python run."""

import contextlib
import dataclasses
import importlib
import io
import json
import os
import re
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from tactilerl.commands import cli

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
READ = [page for page in PAGES if page.name != "CHANGELOG.md"]
NOT_RUN = "<!-- not run"  # on the line before a block
BLOCK = re.compile(r"(?:(<!-- not run[^\n]*)\n)?^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)


def blocks(page, *languages):
    """(marked as not run, text) of each code block of a page in one of the languages."""
    found = BLOCK.findall(page.read_text(encoding="utf-8"))
    return [(bool(mark), text) for mark, language, text in found if language in languages]


def prose(page):
    """A page without its code blocks."""
    return BLOCK.sub("", page.read_text(encoding="utf-8"))


def anchors(page):
    """The anchors of a page's headings, as a repository's browser and mkdocs make them."""
    headings = re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)
    texts = (re.sub(r"[`*]|\]\([^)]*\)|\[", "", heading).lower() for heading in headings)
    return {re.sub(r"[^\w -]", "", text).strip().replace(" ", "-") for text in texts}


# -- links -----------------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if re.match(r"\w+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{link}: no such file"
        if anchor:
            assert anchor in anchors(target), f"{link}: no such heading"


def test_files_that_code_and_docs_name_exist():
    """The changelog names what was."""
    folders = r"(?:algos|envs|tactilerl|benchmarks|tests|tools|studies|docs/data)"
    in_docs = dict.fromkeys(READ, rf"\b{folders}/[a-z0-9_/]+\.(?:py|toml|json)\b")
    parts = ("algos", "envs", "tactilerl", "benchmarks")
    in_code = {p: r"docs/[\w/]+\.md" for part in parts for p in ROOT.glob(f"{part}/**/*.py")}
    for source, pattern in (in_docs | in_code).items():
        for named in re.findall(pattern, source.read_text(encoding="utf-8")):
            assert (ROOT / named).is_file(), f"{source.relative_to(ROOT)}: {named} does not exist"


# -- commands --------------------------------------------------------------------------------


@cache
def help_of(*command):
    """What `tactilerl COMMAND --help-all` prints."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.suppress(SystemExit):
        cli.main([*command, "--help-all"])
    return output.getvalue()


def calls():
    """(page, words) of every call of tactilerl in the docs, in blocks and between backticks."""
    for page in READ:
        lines = [line for _, text in blocks(page, "", "bash") for line in text.splitlines()]
        lines += re.findall(r"`([^`]+)`", prose(page))
        for line in lines:
            words = shlex.split(
                line.replace("\n", " ").partition(" #")[0].replace("...", ""), posix=False
            )
            if "tactilerl" in words[:-1]:
                yield page, tuple(words[words.index("tactilerl") + 1 :])


def test_commands_and_flags_exist():
    found = list(calls())
    assert len(found) > 50
    for page, words in found:
        where = f"{page.relative_to(ROOT)}: tactilerl {' '.join(words)}"
        if words[0].isupper() or words[0].startswith("-"):  # COMMAND, --help, --version
            continue
        assert words[0] in cli.COMMANDS, where
        command = words[: 2 if words[0] == "study" else 1]
        extra = ("--algo", "ddpg_her") if {"--algo", "ddpg_her"} <= set(words) else ()
        known = {"--help-all", *re.findall(r"--[\w-]+", help_of(*command, *extra))}
        for flag in (word.partition("=")[0] for word in words if word.startswith("--")):
            assert flag in known, f"{where}: no flag {flag}"


def test_flags_in_prose_exist():
    commands = [(name,) for name in cli.COMMANDS if name != "study"]
    commands += [("train", "--algo", "ddpg_her")]
    commands += [("study", part) for part in ("run", "status", "plan", "compare", "collect", "report")]
    known = {flag for command in commands for flag in re.findall(r"--[\w-]+", help_of(*command))}
    others = {"--oversubscribe", "--hostfile", "--bind-to", "--mpi"}  # of MPI and Slurm
    others |= {"--version", "--help-all", "--logdir"}  # the last is TensorBoard's
    for page in READ:
        spans = (span for span in re.findall(r"`([^`]+)`", prose(page)) if "python " not in span)
        flags = {flag for span in spans for flag in re.findall(r"(?<![\w-])--[a-z][\w-]*", span)}
        found = flags - known - others - benchmark_flags(page)
        assert not found, f"{page.relative_to(ROOT)}: no such flags: {sorted(found)}"


def benchmark_flags(page):
    """Flags of the benchmarks that a page names."""
    names = re.findall(r"python\s+-m\s+benchmarks\s+(\w+)", page.read_text(encoding="utf-8"))
    scripts = [next(ROOT.glob(f"benchmarks/**/{name}.py"), None) for name in names]
    assert None not in scripts, f"{page.relative_to(ROOT)}: no such benchmark among {names}"
    text = "".join(script.read_text(encoding="utf-8") for script in scripts)
    shared = (*ROOT.glob("benchmarks/**/timing.py"), *ROOT.glob("benchmarks/command.py"))
    text += "".join(path.read_text(encoding="utf-8") for path in shared)
    return set(re.findall(r"--[\w-]+", text))


# -- the site --------------------------------------------------------------------------------

COLUMNS = 88  # of code, that a page 1280 pixels wide shows without scrolling


def test_code_fits_its_page():
    for page in READ:
        for _, language, text in BLOCK.findall(page.read_text(encoding="utf-8")):
            wide = [line for line in text.splitlines() if len(line) > COLUMNS]
            assert not wide, (
                f"{page.relative_to(ROOT)}, {language}: wider than {COLUMNS} columns: {wide}"
            )


@pytest.fixture
def hooks(monkeypatch):
    """The module that mkdocs takes the pages made from code from."""
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    monkeypatch.setattr(os, "environ", os.environ.copy())
    return importlib.import_module("docs_hooks")


def test_learners_list_their_hyperparameters(hooks):
    for name, config in hooks.LEARNERS.items():
        shown = hooks.entry(name)
        for field in dataclasses.fields(config):
            assert f"| `{field.name}` | `{getattr(config(), field.name)!r}` | " in shown


def test_each_environment_has_a_page(hooks):
    """With every entry of what it observes and does. The overview has its id."""
    overview = (ROOT / "docs/environments/README.md").read_text(encoding="utf-8")
    for name in hooks.environments.names():
        page = hooks.environments.page(name)
        _, env = hooks.environments._made(name)
        last = len(env.observation_names()) - 1
        assert re.search(rf"^\| (?:\d+–)?{last} \| taxels", page, re.MULTILINE), name
        assert f"| {len(env.hand.action_names) - 1} |" in page
        assert f"`tactilerl/{hooks.environments.title(name)}-v0`" in overview
        for link in re.findall(r"\]\(([^)#\s]+)", page):
            assert (ROOT / "docs/environments" / link).exists(), f"{name}: {link}"


# -- examples --------------------------------------------------------------------------------

EXAMPLES = {
    f"{page.relative_to(ROOT)}-{number}": text
    for page in PAGES
    for number, (is_marked, text) in enumerate(blocks(page, "python"))
    if not is_marked
}


def test_examples_run(tmp_path):
    """Each in a module of its own; in one process, into which only they import anything."""
    code = "import json, sys\nfor name, text in json.loads(sys.argv[1]).items():\n"
    code += "    exec(compile(text, name, 'exec'), {'__name__': '__main__'})"
    command = [sys.executable, "-c", code, json.dumps(EXAMPLES)]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    ran = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr


def test_layout_example_is_a_layout(tmp_path):
    from tactilerl.envs import layouts

    (_, text), *_ = blocks(ROOT / "docs/guides/layouts.md", "toml")
    path = tmp_path / "my_layout.toml"
    path.write_text(text, encoding="utf-8")
    assert layouts.load(str(path)).patches


def test_study_example_is_a_study(tmp_path):
    from tactilerl.study import grid

    texts = [text for _, text in blocks(ROOT / "docs/guides/study.md", "toml")]
    path = tmp_path / "pilot.toml"
    path.write_text("\n".join(texts), encoding="utf-8")  # a whole one, and what may be added
    study = grid.read(path)
    assert study.runs()
    assert study.looks is not None


def test_tables_are_what_their_data_say():
    """And each that a command writes stands in the docs."""
    tables = pytest.importorskip("benchmarks.tables")
    pages = {page: page.read_text() for page in sorted((ROOT / "docs").rglob("*.md"))}
    for page, text in pages.items():
        assert tables.filled(text) == text, f"{page}: run python -m benchmarks tables"
    found = {name for text in pages.values() for _, name, *_ in tables.MARKED.findall(text)}
    assert found == set(tables.PRINTED)


def test_readme_has_the_rates_of_the_study():
    """Success over the last tenth, with touch and without."""
    study = (ROOT / "docs" / "study.md").read_text()
    rates = [
        re.search(rf"^\| {arm} \|.*\| ([\d.]+) \([^)]*\) \|$", study, re.MULTILINE).group(1)
        for arm in ("touch", "no touch")
    ]
    sentence = "policies with touch end at a mean success rate of {}, and those without at {}."
    assert sentence.format(*rates) in " ".join((ROOT / "README.md").read_text().split())


@pytest.mark.parametrize(
    ("name", "tables_of", "others", "n_least"),
    [
        # the least p of 6 and 8 pairs, all with the same sign
        ("study", ["study"], {f"{2 / 2**pairs:.3f}" for pairs in (6, 8)}, 20),
        ("setups", ["setups", "gates"], {"0.85", "0.3"}, 10),  # for a set-up to take part
    ],
)
def test_numbers_in_the_text_of_a_study_are_those_of_its_tables(name, tables_of, others, n_least):
    pages = {one: (ROOT / "docs" / f"{one}.md").read_text() for one in (name, *tables_of)}
    tables = "\n".join(line for one in tables_of for line in re.findall(r"(?m)^\|.*", pages[one]))
    text = "\n".join(re.findall(r"(?m)^[^|\n].*", pages[name]))
    known = {*re.findall(r"\d+\.\d+", tables), *others, "0.95"}  # 95 % intervals
    found = set(re.findall(r"\d\.\d+", re.sub(r"\(http\S+", "", text)))
    percent = re.findall(r"\d+", " ".join(re.findall(r"[\d to]+ %", text)))
    found |= {f"{int(share) / 100:.2f}" for share in percent}
    assert len(found) > n_least
    assert found <= known
