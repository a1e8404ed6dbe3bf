"""What `tactilerl probe` does: get grasps, ask them, write what was found."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..envs import hands, layouts, typed, vector
from ..envs.grasp import setup
from ..envs.hands import Hand
from ..envs.scripted import require_grasps
from ..envs.state import Array
from ..errors import InputError, input_errors
from ..pictures import places
from ..runs import provenance
from ..runs.cores import free_cores
from ..runs.files import locked, replacing
from . import analysis, estimators, figures, files, selection
from .grasps import Measured, Scenes, ScriptedGrasps
from .options import AnalysisFlags, GraspFlags, Options
from .play import play
from .readings import Grasps, with_faults

RULE = "skin"
"""By which taxels are read of the recorded poses."""
Playing = tuple[dict[str, Any], vector.Job[Measured], Callable[[int], vector.Workers], str]
"""Settings, who plays a grasp in it, workers by their number, and the results' folder."""


def grasps(read: Options, held: ExitStack, show: Callable[[int], None]) -> tuple[files.Played, Path]:
    """The grasps, played or read, and the folder where everything goes, to which no other process
    writes while it is `held`. Whatever cannot be asked is refused before minutes of playing."""
    source = read.output.grasps_file
    if source is not None:
        _require_usual(read.grasp)
        played = files.read(source)
        env = played.settings.get("env")
        if not hands.is_hand(str(env)):
            raise InputError(f"{source}: found grasps of {env!r}, allowed: {hands.allowed()}")
        _require_answerable(read.analysis, hands.get(str(env)))
        return played, _held(read.output.out or source.parent, held)
    settings, task, start, name = scripted(read.grasp)
    if digest := hands.digest(settings["env"]):  # of a hand of one's own, which may change
        settings["hand"] = digest
    _require_answerable(read.analysis, hands.get(settings["env"]))
    path = _held(read.output.out or Path("probes") / name, held) / "grasps.npz"
    workers = partial(start, read.output.workers or free_cores())
    n = read.grasp.grasps
    return play(path, n, settings, task, workers, show), path.parent


def _held(out: Path, held: ExitStack) -> Path:
    """The folder, made and locked."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {str(out)!r}: {error.strerror}") from error
    held.enter_context(locked(out))
    return out


def _require_answerable(asking: AnalysisFlags, hand: Hand) -> None:
    """InputError unless the hand has the layouts."""
    for name in asking.layout:
        _taxels(name, hand)


def _require_usual(playing: GraspFlags) -> None:
    """InputError naming the first flag that is not at its default."""
    usual = GraspFlags()
    for name, value in vars(playing).items():
        if value != getattr(usual, name):
            flag = f"--{name.replace('_', '-')}"
            raise InputError(f"{flag}: found together with --from, allowed when grasps are played")


@input_errors()
def scripted(grasps: GraspFlags) -> Playing:
    """Perturbed scripted grasps; InputError where the hand has none."""
    simulator = grasps.simulator or setup(grasps.env).simulator
    hand, drawn = hands.get(grasps.env), grasps.perturbation
    require_grasps(hand)
    config = setup(grasps.env, simulator=simulator)
    settings: dict[str, Any] = {
        "env": grasps.env, "simulator": simulator, "touch_rule": RULE, "seed": grasps.seed,
        "hold_verdict": grasps.hold_verdict, "perturbation": asdict(drawn),
    }  # fmt: skip
    for variant in drawn.variants():
        typed.validate(replace(config, **variant))
    task = ScriptedGrasps(drawn, grasps.seed, grasps.hold_verdict)
    start = partial(vector.start, partial(Scenes, grasps.env, config, drawn.variants()))
    return settings, task, start, f"{hands.file(grasps.env).stem}_{simulator}"


@input_errors()
def _taxels(name: str, hand: Hand) -> layouts.Taxels:
    return layouts.load(name).place(hand)


def analyse(read: Options, played: files.Played, out: Path) -> dict[str, Any]:
    """Ask the grasps; writes probe.json and the figures to `out`."""
    hand, asking, settings = hands.get(played.settings["env"]), read.analysis, played.settings
    is_whole = ~played.records["broken"].astype(bool)
    whole = {name: values[is_whole] for name, values in played.records.items()}
    grasps = Grasps(hand, whole)
    taxels = {name: _taxels(name, hand) for name in asking.layout}

    def feel(taxels: layouts.Taxels) -> Array:
        """Readings bool (n, taxels), with faults."""
        rng = np.random.default_rng([settings["seed"], analysis.FAULTS])
        return with_faults(grasps.feel(taxels), read.fault, rng)

    with input_errors(), estimators.expected_warnings():
        readings = {name: feel(placed) for name, placed in taxels.items()}
        probe = analysis.Probe(grasps, readings, asking, settings["seed"], free_cores())
        asked = probe.questions()
        samples = probe.answers(asked, probe.inputs())
        _write_gains(probe, samples, out)
        result = {
            **{name: settings[name] for name in ("env", "simulator", "touch_rule", "seed")},
            "playing": settings,
            "asking": asdict(asking),
            "faults": asdict(read.fault),
            "grasps": len(grasps),
            "broken": len(is_whole) - len(grasps),
            "held": float(grasps.held.mean()),
            "objects": grasps.objects()[0],
            "versions": provenance.versions("scipy", "scikit-learn"),
            "layouts": {name: {"taxels": len(placed)} for name, placed in taxels.items()},
            "table": analysis.table(samples),
            "differences": analysis.differences(probe, asked, samples),
            "shuffled": analysis.shuffled_gain(probe),
            "worth": selection.worth(probe) | {"places": _spots(taxels[probe.densest])},
        }
    with replacing(out / "probe.json") as file:
        file.write((json.dumps(result, indent=1) + "\n").encode())
    figures.draw(result, hand, out)
    return result


def _spots(taxels: layouts.Taxels) -> list[dict[str, Any]]:
    return [asdict(place) for place in places.of(taxels)]


def _write_gains(probe: analysis.Probe, samples: analysis.Samples, out: Path) -> None:
    """gains.npz, to compare hands."""
    gains: dict[str, Any] = {
        f"{noise:g} {layout}": analysis.hold_gain(samples, noise, layout).astype(np.float32)
        for noise in probe.choices.joint_noise
        for layout in probe.readings
    }
    with replacing(out / "gains.npz") as file:
        np.savez_compressed(file, **gains)
