"""The docs hold: links lead somewhere, commands and flags exist, examples in Python run."""

import ast
import contextlib
import dataclasses
import importlib
import io
import os
import re
import shlex
from functools import cache
from pathlib import Path

import pytest
from tactilerl.commands import cli
from tactilerl.commands.study import PARTS
from tactilerl.envs import layouts, tasks
from tactilerl.study import grid

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
READ = [page for page in PAGES if page.name != "CHANGELOG.md"]
TEXT = {page: page.read_text(encoding="utf-8") for page in PAGES}
BLOCK = re.compile(r"(?:(<!-- not run[^\n]*)\n)?^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)


def blocks(page, *languages):
    """Return (is marked as not run, text) of each code block of a page in some languages."""
    found = BLOCK.findall(TEXT[page])
    return [(bool(mark), text) for mark, language, text in found if language in languages]


def prose(page):
    """Return a page without its code blocks."""
    return BLOCK.sub("", TEXT[page])


@cache
def anchors(page):
    """Return the anchors of a page's headings, as repositories' browsers and mkdocs make them."""
    headings = re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)
    texts = (re.sub(r"[`*]|\]\([^)]*\)|\[", "", heading).lower() for heading in headings)
    return {re.sub(r"[^\w -]", "", text).strip().replace(" ", "-") for text in texts}


def test_links_lead_somewhere():
    for page in PAGES:
        for link in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
            if re.match(r"\w+:", link):
                continue
            path, _, anchor = link.partition("#")
            target = (page.parent / path).resolve() if path else page
            where = f"{page.relative_to(ROOT)}: {link}"
            assert target.exists(), f"{where}: no such file"
            if anchor:
                assert anchor in anchors(target), f"{where}: no such heading"


def test_files_that_code_and_docs_name_exist_and_images_are_shown():
    """The changelog names what was."""
    folders = r"(?:algos|envs|tactilerl|benchmarks|tests|tools|studies|docs/data)"
    in_docs = dict.fromkeys(READ, rf"\b{folders}/[a-z0-9_/]+\.(?:py|toml|json)\b")
    parts = ("algos", "envs", "tactilerl", "benchmarks")
    in_code = {p: r"docs/[\w/]+\.md" for part in parts for p in ROOT.glob(f"{part}/**/*.py")}
    for source, pattern in (in_docs | in_code).items():
        for named in re.findall(pattern, source.read_text(encoding="utf-8")):
            assert (ROOT / named).is_file(), f"{source.relative_to(ROOT)}: {named} does not exist"
    shown = "".join(TEXT[page] for page in READ)
    assert not [path.name for path in ROOT.glob("docs/images/*") if path.name not in shown]


# -- commands --------------------------------------------------------------------------------


@cache
def flags_of(*command):
    """Return the flags in what `tactilerl COMMAND --help` prints."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.suppress(SystemExit):
        cli.main([*command, "--help"])
    return {"--help", "--import", *re.findall(r"--[\w-]+", output.getvalue())}


def calls():
    """Yield (page, words) of every call of tactilerl in blocks and between backticks."""
    for page in READ:
        lines = [line for _, text in blocks(page, "", "bash") for line in text.splitlines()]
        lines += re.findall(r"`([^`]+)`", prose(page))
        for line in lines:
            text = line.replace("\n", " ").partition(" #")[0].replace("...", "")
            words = shlex.split(text, posix=False)
            if "tactilerl" in words[:-1] and "0.4.0" not in text:
                yield page, tuple(words[words.index("tactilerl") + 1 :])


def test_commands_and_flags_exist():
    for page, words in calls():
        where = f"{page.relative_to(ROOT)}: tactilerl {' '.join(words)}"
        if words[0].isupper() or words[0].startswith("-"):  # COMMAND, --help, --version
            continue
        assert words[0] in cli.COMMANDS, where
        command = words[: 2 if words[0] == "study" else 1]
        extra = ("--algo", "ddpg_her") if {"--algo", "ddpg_her"} <= set(words) else ()
        for flag in (word.partition("=")[0] for word in words if word.startswith("--")):
            assert flag in flags_of(*command, *extra), f"{where}: no flag {flag}"


def test_flags_in_prose_exist():
    commands = [(name,) for name in cli.COMMANDS if name != "study"]
    commands += [("train", "--algo", "ddpg_her"), *(("study", part) for part in PARTS)]
    known = set().union(*(flags_of(*command) for command in commands))
    known |= {"--mpi", "--logdir", "--version"}  # of Slurm, of TensorBoard, of tactilerl
    for page in READ:
        spans = (
            span
            for span in re.findall(r"`([^`]+)`", prose(page))
            if not re.search("python |pip ", span)
        )
        flags = {flag for span in spans for flag in re.findall(r"(?<![\w-])--[a-z][\w-]*", span)}
        assert flags <= known, f"{page.relative_to(ROOT)}: no such flags: {flags - known}"


def test_benchmarks_that_docs_name_exist():
    from benchmarks.__main__ import benchmarks

    for page in READ:
        text = " ".join(TEXT[page].split())
        for name, after in re.findall(r"python -m benchmarks (\w+)(.{0,40})", text):
            assert name in benchmarks() or re.search(r"of 0\.[45]\.0", text), f"{page}: {name}{after}"


# -- the site --------------------------------------------------------------------------------


@pytest.fixture
def hooks(monkeypatch):
    """Return the module from which mkdocs takes the pages made from code."""
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
    overview = TEXT[ROOT / "docs/environments/README.md"]
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


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs(name, monkeypatch, in_tmp):
    """As a module of its own; what it adds to the tasks goes."""
    monkeypatch.setattr(tasks, "TASKS", dict(tasks.TASKS))
    exec(compile(EXAMPLES[name], name, "exec"), {"__name__": "__main__"})


def test_excerpts_of_ppo_are_its_lines():
    """But for loops and conditions, of whose bodies they may show a part."""

    def statements(text):
        nodes = ast.walk(ast.parse(text))
        return {ast.unparse(n) for n in nodes if isinstance(n, ast.stmt) and not hasattr(n, "body")}

    source = statements((ROOT / "algos/ppo.py").read_text(encoding="utf-8"))
    for _, text in blocks(ROOT / "docs/code.md", "python"):
        missing = statements(text) - source
        assert not missing, f"docs/code.md: not in algos/ppo.py: {missing}"


def test_examples_of_a_layout_and_of_a_study_are_read(tmp_path):
    (_, layout), *_ = blocks(ROOT / "docs/guides/layouts.md", "toml")
    (tmp_path / "layout.toml").write_text(layout, encoding="utf-8")
    assert layouts.load(str(tmp_path / "layout.toml")).patches
    texts = [text for _, text in blocks(ROOT / "docs/guides/study.md", "toml")]
    (tmp_path / "pilot.toml").write_text("\n".join(texts), encoding="utf-8")  # with what may be added
    assert grid.read(tmp_path / "pilot.toml").runs()


# -- numbers ---------------------------------------------------------------------------------


def test_tables_are_what_their_data_say():
    """And each that a command writes stands in the docs."""
    pytest.importorskip("jinja2")  # of the extra `study`
    tables = importlib.import_module("benchmarks.tables")
    for page in READ:
        assert tables.filled(TEXT[page]) == TEXT[page], f"{page}: run python -m benchmarks tables"
    found = {name for page in READ for _, name, *_ in tables.MARKED.findall(TEXT[page])}
    assert found == set(tables.PRINTED) | ({"NAME"} & found)


def test_readme_has_the_rates_of_the_study():
    page, readme = TEXT[ROOT / "docs/handover.md"], " ".join(TEXT[ROOT / "README.md"].split())
    touch, none = re.findall(r"^\| (?:no )?touch \|.*\| ([\d.]+) \(", page, re.MULTILINE)
    said = f"policies with touch end at a mean success rate of {touch}, and those without at {none}."
    assert said in readme


OTHERS = {"setups": {"0.17", "0.2", "0.82"}}  # W by chance, the script's wait, the paper's


@pytest.mark.parametrize("name", ["handover", "paper", "setups"])
def test_numbers_in_the_text_of_a_study_are_those_of_its_tables(name):
    page, gates = (TEXT[ROOT / "docs" / f"{one}.md"] for one in (name, "gates"))
    tables = "\n".join(re.findall(r"(?m)^\|.*", page + gates))
    text = "\n".join(re.findall(r"(?m)^[^|\n].*", page))
    known = {*re.findall(r"\d+\.\d+", tables), *OTHERS.get(name, ()), "0.95", "0.05"}  # 95 %, level
    found = set(re.findall(r"(?<![\d.])\d\.\d+", re.sub(r"\(http\S+|\d\.\d\.\d", "", text)))
    percent = re.findall(r"\d+", " ".join(re.findall(r"[\d to]+ %", text)))
    found |= {f"{int(share) / 100:.2f}" for share in percent}
    assert found <= known
