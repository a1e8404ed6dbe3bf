"""What `tactilerl probe` does: get grasps, ask them, write what was found."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from .. import machine
from ..envs import hands, layouts, validation
from ..envs.hands import Hand
from ..envs.state import Array
from ..errors import InputError, input_errors
from ..files import is_picture, locked, read_json, replacing, require_ours
from ..machine import free_cores
from ..pictures import places
from . import analysis, estimators, figures, files, selection
from .options import AnalysisFlags, Options
from .readings import Grasps, with_faults


def grasps(
    read: Options, held: ExitStack, show: Callable[[int], None]
) -> tuple[files.Played, Path]:
    """The grasps, played or read, and the folder where everything goes, to which no other process
    writes while it is `held`. Whatever cannot be asked is refused before minutes of playing."""
    asked, source, out = read.grasp, read.output.grasps_file, read.output.out
    if source is not None:
        with input_errors():
            validation.allow_only_with("grasps that are played", asked, *vars(asked))
        played = files.read(source)
        env = str(played.settings.get("env"))
        if not hands.is_hand(env):
            raise InputError(
                f"{source}: found grasps of {env!r}, allowed: {hands.allowed()}"
            )
        _placed(read.analysis, hands.get(env))
        held.enter_context(locked(out := out or source.parent))
        _require_ours(out)
        return played, out
    _placed(read.analysis, hands.get(asked.env))
    name = f"{hands.file(asked.env).stem}_{asked.config.simulator}"
    held.enter_context(locked(out := out or Path("probes") / name))
    _require_ours(out)
    return files.play(
        out / "grasps.npz", asked, read.output.workers or free_cores(), show
    ), out


def _require_ours(out: Path) -> None:
    """InputError where a file of somebody else would be lost."""
    for name in ("probe.json", "gains.npz"):  # together they are a probe's
        require_ours(
            out / name, lambda path: "asking" in read_json(path.with_name("probe.json"))
        )


@input_errors()
def _placed(asking: AnalysisFlags, hand: Hand) -> dict[str, layouts.Taxels]:
    """The layouts on the hand; InputError where it does not have them."""
    return {name: layouts.load(name).place(hand) for name in asking.layout}


def analyse(read: Options, played: files.Played, out: Path) -> dict[str, Any]:
    """Ask the grasps; writes probe.json and the figures to `out`."""
    hand, asking, settings = (
        hands.get(played.settings["env"]),
        read.analysis,
        played.settings,
    )
    grasps = Grasps.whole(hand, played.records)
    taxels = _placed(asking, hand)
    gains: dict[str, Any] = {}  # to compare hands

    def feel(taxels: layouts.Taxels) -> Array:
        """Readings bool (n, taxels), with faults."""
        rng = np.random.default_rng([settings["seed"], analysis.FAULTS])
        return with_faults(grasps.feel(taxels), read.fault, rng)

    with input_errors(), estimators.expected_warnings():
        readings = {name: feel(placed) for name, placed in taxels.items()}
        probe = analysis.Probe(grasps, readings, asking, settings["seed"], free_cores())
        asked = probe.questions()
        samples = probe.answers(asked, probe.inputs())
        for noise, name in itertools.product(asking.joint_noise, readings):
            gained = analysis.hold_gain(samples, noise, name)
            gains[f"{noise:g} {name}"] = gained.astype(np.float32)
        densest = probe.densest
        result = {
            **{
                name: settings[name]
                for name in ("env", "simulator", "touch_rule", "seed")
            },
            "playing": settings,
            "asking": asdict(asking),
            "faults": asdict(read.fault),
            "grasps": len(grasps),
            "broken": int(played.records["broken"].sum()),
            "held": float(grasps.held.mean()),
            "objects": grasps.objects()[0],
            "versions": machine.versions("scipy", "scikit-learn"),
            "layouts": {
                name: {"taxels": len(placed)} for name, placed in taxels.items()
            },
            "table": analysis.table(samples),
            "differences": analysis.differences(probe, asked, samples),
            "shuffled": analysis.shuffled_gain(probe),
            "worth": {
                "layout": densest,
                "joint_noise": asking.joint_noise[-1],
                "bits": selection.bits(probe, readings[densest]).tolist(),
                "places": [asdict(place) for place in places.of(taxels[densest])],
            },
        }
    with replacing(out / "probe.json") as file:
        file.write((json.dumps(result, indent=1) + "\n").encode())
    with replacing(out / "gains.npz") as file:
        np.savez_compressed(file, **gains)
    figures.save(figures.of_probe(result, hand), out, is_picture)
    return result
