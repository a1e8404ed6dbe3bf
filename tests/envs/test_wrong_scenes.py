"""Choices of a scene that cannot be, or not together: each is named, with what was found."""

import pytest
from tactilerl import envs

REACH, HANDOVER = {"task": "reach-goal"}, {"scene": "handover"}
WRONG = [
    ({"control_dt": 0.005}, "control_dt"),
    ({"hold_seconds": 0.0}, "hold_seconds"),
    ({"task": "fly"}, "task"),
    *(({name: 1e300}, name) for name in ("hold_seconds", "joint_noise", "slide_noise", "finger_gain")),
    ({"history": 0}, r"history: found 0, allowed \[1, 100\]"),
    ({"observe_targets": "no"}, "observe_targets: found 'no'"),
    ({"object_seen": "blurred"}, "object_seen: found 'blurred', allowed: exact, noisy, start"),
    ({"sight_noise": (0.01, 0.1)}, "sight_noise: found .* allowed only with object_seen noisy"),
    ({"object_seen": "hidden", "sight_noise_kind": "held"}, "sight_noise_kind: found held"),
    ({"object_seen": "noisy", "sight_noise": (-0.01, 0.1)}, "sight_noise: found -0.01"),
    ({"taxel_false_on": 1.1}, r"taxel_false_on: found 1.1, allowed \[0, 1\]"),
    ({"touch": "off", "taxel_dead": 0.1}, "taxel_dead: found 0.1, allowed only with touch"),
    ({"touch_rule": "force", "taxel_stuck": 0.1}, "taxel_stuck: .* only with Boolean taxels"),
    ({"taxel_threshold": 0.1, "touch": "off"}, "taxel_threshold: .* only with touch on"),
    ({"taxel_threshold": 0.1, "taxel_release": 0.2}, "taxel_release: .* allowed up to taxel_threshold"),
    ({"taxel_noise": 0.1}, "taxel_noise: found 0.1, allowed only with taxels that read a force"),
    ({"taxel_threshold_spread": 0.1, "touch_rule": "force"}, "_spread: .* only with touch_rule skin"),
    ({"sensor": "switch", "taxel_threshold": 0.1}, "taxel_release: found 0.2 N, allowed up to"),
    ({"sensor": "fsr", "control_dt": 0.0}, "control_dt: found 0.0"),
    ({"sensor": "fsr3"}, "sensor: found 'fsr3', did you mean fsr\\? allowed: biotac"),
    ({"giver_force": 1.0}, "giver_force: found 1.0, allowed only with task handover"),
    ({"object": "box,torus"}, "object: found 'torus', allowed: box, sphere, cylinder"),
    ({"object": "box,cylinder", "object_size": ("0.04..0.05", 0.05)}, "object_size: found 2 numbers"),
    ({"object_size": "0.05..0.04"}, r"object_size: found '0.05..0.04', allowed a number or LOW..HIGH"),
    ({"object_size": "0.04..0.09"}, "object_size: found 0.09 m, allowed up to 0.08 m across"),
    ({"object_size": (0.02, 0.02, 0.16)}, "object_size: found 0.16 m, allowed up to 0.15 m in height"),
    ({"object_density": "1..1e300"}, r"object_density: found 1e[+]300, allowed \[1, 100000\]"),
    ({"friction": "0..1"}, r"friction: found 0.0, allowed \(0, 10\]"),
    ({"start_offset": 0.02, "jitter": False}, "start_offset: found 0.02, allowed only with jitter"),
    ({"object": "mug.stl"}, "object: found 'mug.stl', allowed: box, sphere, cylinder, capsule, ell"),
    ({"object": "capsule", "object_size": (0.03, 0.03, 0.05)}, "3 numbers, allowed for a capsule"),
    ({"object": "ellipsoid", "simulator": "pybullet"}, "object: found ellipsoid, allowed only with"),
    ({"skin_thickness": 0.003, "simulator": "pybullet"}, "skin_thickness: found 0.003, allowed only"),
    ({"skin_thickness": 0.001}, r"skin_thickness: found 0.001, allowed \[0.002, 0.004\]"),
    ({"skin_modulus": 5e4}, "skin_modulus: found 50000.0, allowed only with skin_thickness"),
    (REACH | {"goal_range": 0.09}, "goal_range: found 0.09 m, allowed from 0 to goal_height, 0.08 m"),
    ({"goal_range": 0.01}, "goal_range: .* only with task reach-goal"),
    (HANDOVER | {"handover_reach": "0.02..0.4"}, r"handover_reach: found 0.4, allowed \[0, 0.3\]"),
    (REACH | {"lift_clearance": 0.2}, "lift_clearance: .* only with task lift-and-hold"),
    ({"actions": "all", "start_closing": 0.5}, "start_closing: .* only with actions fingers or grip"),
    (HANDOVER | {"reward": "staged"}, "reward: found 'staged'"),
    (HANDOVER | {"max_episode_steps": 20}, "max_episode_steps: found 20, allowed 53 or more"),
    (HANDOVER | {"control_dt": 0.0125, "timestep": 0.0025}, "found 0.0125 s, allowed 0.041 s"),
]


@pytest.mark.parametrize(("choices", "named"), WRONG)
def test_what_cannot_be_is_named(choices, named):
    with pytest.raises(ValueError, match=named):
        envs.make("shadow", **choices)
