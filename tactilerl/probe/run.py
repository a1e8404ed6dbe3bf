"""What `tactilerl probe` does: get grasps, ask them, write what was found."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..algos.mpi import Communicator
from ..envs import hands, layouts, typed, vector
from ..envs.grasp import setup
from ..envs.hands import Array, Hand
from ..envs.layouts import Layout, Taxels
from ..envs.scripted import require_grasps
from ..envs.vector import Job
from ..errors import InputError, input_errors
from ..pictures import places
from ..pictures.places import Place
from ..runs import provenance
from ..runs.files import locked, replacing
from ..runs.training import free_cores, start_workers
from . import analysis, estimators, figures, files, selection
from .analysis import Choices, Probe
from .files import Played
from .grasps import Measured, PolicyGrasps, Scenes, ScriptedGrasps
from .options import AnalysisFlags, GraspFlags, Options
from .play import play
from .readings import Grasps, with_faults


class Playing(NamedTuple):
    """What `play` needs, and where the results go."""

    settings: dict[str, Any]
    contact_places: tuple[Place, ...]
    task: Job[Measured]
    start: Callable[[int], vector.Workers]
    """By their number."""
    out: Path


def grasps(
    read: Options, comm: Communicator, held: ExitStack, show: Callable[[int], None]
) -> tuple[Played, Path]:
    """The grasps, played or read, and the folder where everything goes, to which no other process
    writes while it is `held`. Whatever cannot be asked is refused before minutes of playing."""
    source, out = read.output.grasps_file, read.output.out
    if source is not None:
        if changed := _changed(read.grasp):
            raise InputError(
                f"--{changed}: found it together with --from, allowed when grasps are played"
            )
        played = files.read(source)
        if not hands.is_hand(str(played.settings.get("env"))):
            raise InputError(f"{source}: found grasps of {played.settings.get('env')!r}, "
                             f"allowed: {hands.allowed()}")  # fmt: skip
        _require_answerable(read.analysis, hands.get(played.settings["env"]))
        out = out or source.parent
        _hold(out, comm, held)
        return played, out
    prepared = _scripted if read.grasp.policy is None else _by_policy
    playing = prepared(read.grasp, read.analysis, held)
    out, start = out or playing.out, partial(playing.start, read.output.workers or free_cores(comm))
    _hold(out, comm, held)
    played = play(out / "grasps.npz", read.grasp.grasps, playing.settings, playing.contact_places,
                  playing.task, start, comm, show)  # fmt: skip
    return played, out


def _hold(out: Path, comm: Communicator, held: ExitStack) -> None:
    """Make a folder and its lock."""
    files.folder(out)
    if comm.rank == 0:
        held.enter_context(locked(out))


def _require_answerable(asking: AnalysisFlags, hand: Hand) -> None:
    """InputError unless the hand has the layouts, and the skin as many taxels as to select."""
    _of_layouts(asking.layout, hand)
    if asking.select:
        found, allowed = max(asking.select), len(_of_layouts([asking.skin], hand)[asking.skin])
        if found > allowed:
            raise InputError(f"select: found {found}, allowed up to the {allowed} taxels of the skin "
                             f"({asking.skin})")  # fmt: skip


def _changed(playing: GraspFlags, *allowed: str) -> str | None:
    """The first flag that is not at its default."""
    mine, usual = asdict(playing), asdict(type(playing)())
    names = (name for name in mine if mine[name] != usual[name] and name not in allowed)
    return next(names, "").replace("_", "-") or None


def _scripted(grasps: GraspFlags, asking: AnalysisFlags, held: ExitStack) -> Playing:
    simulator = grasps.simulator or setup(grasps.env).simulator
    hand, drawn = hands.get(grasps.env), grasps.perturbation
    _require_answerable(asking, hand)
    with input_errors():
        require_grasps(hand)
    config = setup(grasps.env, simulator=simulator, touch=grasps.touch)
    settings: dict[str, Any] = {
        "env": grasps.env, "simulator": simulator, "touch": grasps.touch, "seed": grasps.seed,
        "hold_verdict": grasps.hold_verdict, "perturbation": asdict(drawn),
    }  # fmt: skip
    contact_places: tuple[Place, ...] = ()
    if grasps.touch == "contact":
        names = (*asking.layout, *((asking.skin,) if asking.select else ()))
        settings["layouts"] = list(names)
        folder = held.enter_context(tempfile.TemporaryDirectory())
        config = replace(config, layout=_union(names, hand, Path(folder)))
        contact_places = tuple(places.of(layouts.load(config.layout).place(hand)))
    with input_errors():
        for variant in drawn.variants():
            typed.validate(replace(config, **variant))
    task = ScriptedGrasps(drawn, grasps.seed, grasps.hold_verdict)
    start = partial(vector.start, partial(Scenes, grasps.env, config, drawn.variants()))
    out = Path("probes") / f"{hands.file(grasps.env).stem}_{simulator}"
    return Playing(settings, contact_places, task, start, out)


def _union(names: Sequence[str], hand: Hand, folder: Path) -> str:
    """A layout file with every taxel of some layouts: what the simulator has to feel."""
    every = places.union([_layout(name, hand) for name in names], hand)
    path = folder / "union.toml"
    path.write_text(layouts.of_taxels(every, hand, "all").toml(), encoding="utf-8")
    return str(path)


def _by_policy(grasps: GraspFlags, asking: AnalysisFlags, held: ExitStack) -> Playing:
    from ..runs.policies import read_run

    assert grasps.policy is not None
    if changed := _changed(grasps, "policy", "grasps", "seed", "touch"):
        raise InputError(f"--{changed}: found it together with --policy, allowed without: a run has "
                         "its own scene")  # fmt: skip
    config, policy, epoch, env_steps = read_run(grasps.policy)
    if config.scene is None:
        raise InputError(f"--policy {grasps.policy}: found a run of {config.run.env}, allowed runs of "
                         f"{hands.allowed()}")  # fmt: skip
    scene, hand, name = config.scene, hands.get(config.run.env), grasps.policy.resolve().name
    settings = {
        "env": config.run.env, "simulator": scene.simulator, "touch": grasps.touch,
        "seed": grasps.seed, "policy": name, "epoch": epoch, "env_steps": env_steps,
    }  # fmt: skip
    _require_answerable(asking, hand)
    contact_places: tuple[Place, ...] = ()
    if scene.touch == "contact":
        contact_places = tuple(places.of(layouts.load(scene.layout).place(hand)))
    start = partial(start_workers, config, Communicator())
    return Playing(
        settings, contact_places, PolicyGrasps(policy, grasps.seed), start, Path("probes") / name
    )


def _layout(name: str, hand: Hand) -> Layout:
    """A layout, or a skin as "2mm"; ValueError and FileNotFoundError where there is none."""
    if name.endswith("mm"):
        try:
            spacing = float(name[:-2])
        except ValueError:
            raise ValueError(
                f"skin: found {name!r}, allowed a layout, or a spacing such as 2mm"
            ) from None
        return places.dense_skin(hand, 1e-3 * spacing)
    return layouts.load(name)


def _of_layouts(names: Sequence[str], hand: Hand) -> dict[str, Taxels]:
    """The taxels of each layout on a hand; InputError when there is no such layout."""
    with input_errors():
        return {name: _layout(name, hand).place(hand) for name in names}


def analyse(read: Options, played: Played, out: Path) -> dict[str, Any]:
    """Ask the grasps; writes probe.json, the figures and what was selected to `out`."""
    hand, asking, settings = hands.get(played.settings["env"]), read.analysis, played.settings
    is_whole = ~played.records["broken"].astype(bool)
    kept = {name: values[is_whole] for name, values in played.records.items()}
    asked = Grasps(hand, kept, played.contact_places)
    choices = Choices(**vars(asking), seed=settings["seed"], jobs=free_cores(Communicator()))
    where = _of_layouts(asking.layout, hand)
    with input_errors(), estimators.expected_warnings():
        readings = {name: _feel(read, asked, settings, taxels) for name, taxels in where.items()}
        probe = Probe(asked, readings, choices)
        result = {
            **_about(read, played, asked),
            "layouts": {name: {"taxels": len(taxels)} for name, taxels in where.items()},
            **_answers(probe, out),
            "worth": _worth(probe, where[probe.densest]),
        }
        if asking.select:
            candidates = _of_layouts([asking.skin], hand)[asking.skin]
            skin = _feel(read, asked, settings, candidates)
            path, found = selection.select(probe, skin, asking.select)
            written = _write_chosen(probe, candidates, path, settings, out)
            spots = [asdict(place) for place in places.of(candidates)]
            about = {"skin": asking.skin, "candidates": len(spots), **found}
            result["selection"] = {**about, "places": [spots[i] for i in path], "files": written}
    with replacing(out / "probe.json") as file:
        file.write((json.dumps(result, indent=1) + "\n").encode())
    figures.draw(result, hand, out)
    return result


def _feel(read: Options, asked: Grasps, settings: dict[str, Any], taxels: Taxels) -> Array:
    """Readings bool (n, taxels) by the touch rule of the grasps, with faults."""
    readings = asked.feel_contact(taxels) if settings["touch"] == "contact" else asked.feel(taxels)
    rng = np.random.default_rng([settings["seed"], analysis.FAULTS])
    return with_faults(readings, read.fault, rng)


def _about(read: Options, played: Played, asked: Grasps) -> dict[str, Any]:
    """What was asked of what, and by which versions."""
    return {
        **{name: played.settings[name] for name in ("env", "simulator", "touch", "seed")},
        "playing": played.settings,
        "asking": json.loads(json.dumps(asdict(read.analysis))),
        "faults": asdict(read.fault),
        "grasps": len(asked),
        "broken": len(played.records["held"]) - len(asked),
        "held": float(asked.held.mean()) if len(asked) else 0.0,
        "objects": asked.object_names,
        "versions": provenance.versions("scipy", "scikit-learn"),
    }


def _answers(probe: Probe, out: Path) -> dict[str, Any]:
    """The table, the differences, the learning curve and the check; gains.npz to compare hands."""
    layouts, noises = [*probe.readings], probe.choices.joint_noise
    samples = probe.answers(analysis.questions(probe), analysis.all_inputs(layouts, noises))
    gains: dict[str, Any] = {
        f"{noise:g} {layout}": analysis.hold_gain(samples, noise, layout).astype(np.float32)
        for noise in noises
        for layout in layouts
    }
    with replacing(out / "gains.npz") as file:
        np.savez_compressed(file, **gains)
    return {
        "table": analysis.table(samples),
        "differences": analysis.differences(samples, layouts),
        "learning_curve": analysis.learning_curve(probe, samples),
        "shuffled": analysis.shuffled_gain(probe),
    }


def _worth(probe: Probe, taxels: Taxels) -> dict[str, Any]:
    """What each taxel of the densest layout tells alone, by the angles with the last noise."""
    noise, most = probe.choices.joint_noise[-1], probe.densest
    known = probe.features(analysis.Inputs(noise, analysis.JOINTS))
    bits = selection.worth(known, probe.readings[most], probe.grasps.held)
    spots = [asdict(place) for place in places.of(taxels)]
    return {"layout": most, "joint_noise": noise, "bits": bits.tolist(), "places": spots}


def _write_chosen(
    probe: Probe, candidates: Taxels, path: list[int], settings: dict[str, Any], out: Path
) -> list[str]:
    """A layout file for each number that was asked for."""
    written = []
    for n in sorted({min(n, len(path)) for n in probe.choices.select}):
        about = (
            f"{n} taxels chosen from skin {probe.choices.skin} by {len(probe.grasps)} grasps "
            f"of {settings['env']} in {settings['simulator']}"
        )
        chosen = layouts.of_taxels(candidates.take(path[:n]), probe.grasps.hand, about)
        written.append(f"selected_{n}.toml")
        with replacing(out / written[-1]) as file:
            file.write(chosen.toml().encode())
    return written
