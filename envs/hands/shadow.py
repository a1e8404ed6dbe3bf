"""The Shadow Dexterous Hand, from the model files that ship with gymnasium-robotics.

The MJCF is OpenAI's (Plappert et al. 2018), which the paper's MuJoCo set-up inherits through
Melnik et al. 2021. Kept: every joint, coupling tendon, actuator, inertia and collision primitive of
the hand and its own contact pairs. Changed: the hand hangs palm down from three slides, and
its forearm is light (it is carried, not modelled). Dropped, because nothing in a grasping
scene can notice them: the forearm's collision mesh, two 1 mm boxes in the thumb's joints,
40 tendons whose limits lie beyond the joints' own, the old object, target and floor, the old
touch zones and sensors.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np

from . import DIGITS, SEGMENTS, SLIDES, Hand, LinearAction, Pitch, ScriptedGrasp, Surface
from .servos import add_slides

PREFIX = "robot0:"
# Order of joints and ranges of actuators: hand/robot.xml and hand/shared.xml of the assets.
WRIST = ("WRJ1", "WRJ0")
JOINTS = (
    *WRIST,
    *("FFJ3", "FFJ2", "FFJ1", "FFJ0"),
    *("MFJ3", "MFJ2", "MFJ1", "MFJ0"),
    *("RFJ3", "RFJ2", "RFJ1", "RFJ0"),
    *("LFJ4", "LFJ3", "LFJ2", "LFJ1", "LFJ0"),
    *("THJ4", "THJ3", "THJ2", "THJ1", "THJ0"),
)
UNACTUATED = ("FFJ0", "MFJ0", "RFJ0", "LFJ0")  # coupled to J1 by a tendon
ACTUATED = tuple(joint for joint in JOINTS if joint not in UNACTUATED)
DISTAL_PER_MIDDLE = 0.00805 / 0.00705  # the coupling tendon's ratio J0 : J1
ACTUATOR_RANGES = {
    **{"WRJ1": (-0.489, 0.14), "WRJ0": (-0.698, 0.489), "LFJ4": (0.0, 0.785)},
    **{f"{f}J3": (-0.349, 0.349) for f in ("FF", "MF", "RF", "LF")},
    **{f"{f}J{j}": (0.0, 1.571) for f in ("FF", "MF", "RF", "LF") for j in (1, 2)},
    **{"THJ4": (-1.047, 1.047), "THJ3": (0.0, 1.222), "THJ2": (-0.209, 0.209)},
    **{"THJ1": (-0.524, 0.524), "THJ0": (-1.571, 0.0)},
}

UNNEEDED_GEOMS = {"C_forearm", "V_thbase", "V_thhub"}
NEEDED_TENDONS = "J1c"  # what the names of the couplings end in

# The whole hand. Position of the palm box's centre at slide zero, m (world; the object rests
# at the origin), and how far an action moves it. Action 0 puts the hand at the grasping
# height, or the penalty on actions and a zero-mean policy would park it away from the cube.
START_PALM = (-0.030, 0.064, 0.095)
SLIDE_CENTRE = (0.0, 0.0, -0.052)
SLIDE_HALF_RANGE = (0.03, 0.03, 0.20)
SLIDE_GAIN = 1000.0  # N/m
SLIDE_DAMPING = 79.0  # N s/m
SLIDE_FORCE = 30.0  # N; without a limit the slides press the hand 10-23 mm into the ground
FOREARM_MASS = 0.5  # kg; the model's 4 kg would only be carried along

PALM_BOX = (0.011, 0.0, 0.038)  # C_palm0's centre in the palm's frame, m
PALM_HALF_THICKNESS = 0.0111
# At the bases of the four fingers, on the palmar face of the palm's boxes.
PALM_TAXELS = (
    ("index", PREFIX + "palm", (0.033, -PALM_HALF_THICKNESS, 0.080)),
    ("middle", PREFIX + "palm", (0.011, -PALM_HALF_THICKNESS, 0.080)),
    ("ring", PREFIX + "palm", (-0.011, -PALM_HALF_THICKNESS, 0.080)),
    ("little", PREFIX + "lfmetacarpal", (-0.017, -PALM_HALF_THICKNESS, 0.028)),
)
FINGERS = {"thumb": "th", "index": "ff", "middle": "mf", "ring": "rf", "little": "lf"}
# (half length of the capsule, radius), m, in the model's collision geometry; each phalanx's
# frame lies at its proximal end with z along the bone.
FINGER_CAPSULES = {
    "proximal": (0.0225, 0.01),
    "middle": (0.0125, 0.00805),
    "distal": (0.012, 0.00705),
}
THUMB_CAPSULES = {"proximal": (0.019, 0.013), "middle": (0.016, 0.011), "distal": (0.013, 0.00918)}
# Fingertips meet objects on the pulp, near the tip: contacts of held grasps lie 14 mm beyond the
# middle of the distal capsule, and a grid centred there misses them (docs/concepts/touch.md).
DISTAL_SHIFT = 0.005  # m towards the tip


def assets() -> Path:
    """Folder of the MJCF files; gymnasium-robotics is located but not imported (it is slow)."""
    spec = find_spec("gymnasium_robotics")
    if spec is None or not spec.submodule_search_locations:
        raise ImportError(
            "the Shadow Hand's model files come with gymnasium-robotics, which is not installed: "
            "pip install gymnasium-robotics"
        )
    return Path(spec.submodule_search_locations[0]) / "envs" / "assets" / "hand"


def build(visual: bool = False, finger_gain: float = 1.0) -> mujoco.MjSpec:
    """The hand alone as an editable model.

    `visual` keeps the meshes, which weigh nothing and touch nothing, for pictures.
    `finger_gain` multiplies the position gain and force limit of the finger actuators.
    """
    spec = mujoco.MjSpec.from_file(str(assets() / "manipulate_block.xml"))
    _drop_what_the_scene_does_not_need(spec, visual)
    _hang_from_slides(spec)
    if finger_gain != 1.0:
        for joint in ACTUATED:
            if joint not in WRIST:
                _scale_gain(spec.actuator(f"{PREFIX}A_{joint}"), finger_gain)
    return spec


def _drop_what_the_scene_does_not_need(spec: mujoco.MjSpec, visual: bool) -> None:
    for name in ("object", "target", "floor0"):
        spec.delete(spec.body(name))
    # All tendons but the couplings limit what the joints limit first.
    free_tendons = [tendon for tendon in spec.tendons if not tendon.name.endswith(NEEDED_TENDONS)]
    for element in (spec.geom("floor0"), *spec.sensors, *spec.lights, *spec.sites, *free_tendons):
        spec.delete(element)
    for geom in spec.geoms:
        name = geom.name.removeprefix(PREFIX)
        if name in UNNEEDED_GEOMS or (name.startswith("V_") and not visual):
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for mesh in spec.meshes:
        if mesh.name not in used:
            spec.delete(mesh)
    if not visual:
        _drop_materials(spec)


def _drop_materials(spec: mujoco.MjSpec) -> None:
    for geom in spec.geoms:
        geom.material = ""
    for cls in ("DC_Hand", "D_Vizual"):
        spec.find_default(PREFIX + cls).geom.material = ""
    for element in (*spec.materials, *spec.textures):
        spec.delete(element)


def _hang_from_slides(spec: mujoco.MjSpec) -> None:
    mount = spec.body(PREFIX + "hand mount")
    mount.alt.euler = [np.pi / 2, 0, 0]  # palm (-y of the body) down, fingers (+z) to world -y
    # The palm's frame hangs at mount + forearm (0, .01, 0) + wrist (0, 0, .256) + (0, 0, .034).
    palm_in_mount = np.array([0.0, 0.01, 0.29]) + PALM_BOX
    x, y, z = palm_in_mount
    mount.pos = np.array(START_PALM) - np.array([x, -z, y])
    # Slide axes are given in the mount's frame: world (x, y, z) is local (x, z, -y).
    axes = ([1, 0, 0], [0, 0, -1], [0, 1, 0])
    add_slides(spec, mount, axes, SLIDE_GAIN, SLIDE_DAMPING, SLIDE_FORCE)
    spec.body(PREFIX + "forearm").mass = FOREARM_MASS
    for body in spec.bodies:
        if body.name.startswith(PREFIX):
            body.gravcomp = 1.0


def _scale_gain(actuator: mujoco.MjsActuator, factor: float) -> None:
    actuator.gainprm = np.array(actuator.gainprm) * factor
    actuator.biasprm = np.array(actuator.biasprm) * factor
    actuator.forcerange = np.array(actuator.forcerange) * factor


def _surfaces() -> tuple[Surface, ...]:
    surfaces = []
    for digit in DIGITS:
        # The thumb opposes: its palmar side is the one that faces the fingers, -x.
        palmar = (-1.0, 0.0, 0.0) if digit == "thumb" else (0.0, -1.0, 0.0)
        capsules = THUMB_CAPSULES if digit == "thumb" else FINGER_CAPSULES
        for segment in SEGMENTS:
            half_length, radius = capsules[segment]
            shift = DISTAL_SHIFT if segment == "distal" else 0.0
            surfaces.append(
                Surface(
                    digit=digit,
                    segment=segment,
                    link=f"{PREFIX}{FINGERS[digit]}{segment}",
                    centre=(0.0, 0.0, half_length + shift),
                    along=(0.0, 0.0, 1.0),
                    palmar=palmar,
                    radius=radius,
                    bone=((0.0, 0.0, 0.0), (0.0, 0.0, 2 * half_length)),
                )
            )
    for digit, link, centre in PALM_TAXELS:
        surfaces.append(Surface(digit, "palm", link, centre, (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)))
    return tuple(surfaces)


def _start() -> dict[str, float]:
    start = {}
    for finger in ("FF", "MF", "RF", "LF"):
        start[f"{PREFIX}{finger}J2"] = 0.6
        start[f"{PREFIX}{finger}J1"] = 0.5
        start[f"{PREFIX}{finger}J0"] = 0.5 * DISTAL_PER_MIDDLE
    return start


def _grasp(size: float, palm: tuple[float, float, float], joints: dict[str, float]) -> ScriptedGrasp:
    """A searched grasp; `palm` is where the palm box's centre goes, MCP and PIP serve all fingers."""
    joints = dict(joints)
    mcp, pip = joints.pop("MCP"), joints.pop("PIP")
    targets = {f"{f}J2": mcp for f in ("FF", "MF", "RF", "LF")}
    targets |= {f"{f}J1": pip for f in ("FF", "MF", "RF", "LF")}
    targets |= joints
    named = {f"{PREFIX}A_{joint}": value for joint, value in targets.items()}
    named |= {s: p - q for s, p, q in zip(SLIDES, palm, START_PALM, strict=True)}
    return ScriptedGrasp(size, named)


# Found by a cross-entropy search over perturbed starts, apart from those the doctor uses:
# (edge of the cube, palm box's centre, joint targets), m and rad.
GRASPS = (
    _grasp(
        0.04,
        (-0.010, 0.052, 0.022),
        {"MCP": 1.0, "PIP": 1.571, "THJ4": 0.653, "THJ3": 0.234, "THJ2": 0.208, "THJ1": -0.065}
        | {"THJ0": -1.083, "LFJ4": 0.546, "WRJ0": -0.434, "WRJ1": -0.074},
    ),
    _grasp(
        0.05,
        (-0.010, 0.050, 0.038),
        {"MCP": 1.08, "PIP": 1.571, "THJ4": 0.498, "THJ3": 0.612, "THJ2": 0.153, "THJ1": -0.089}
        | {"THJ0": -1.02, "LFJ4": 0.712, "WRJ0": -0.297, "WRJ1": -0.104},
    ),
)


# Fingers that close in groups go from straight, the thumb opposed, to a fist around small things.
CLOSED = {
    **{f"{finger}J{j}": 1.571 for finger in ("FF", "MF", "RF", "LF") for j in (1, 2)},
    **{"THJ4": 1.0, "THJ3": 0.6, "THJ2": 0.209, "THJ1": -0.3, "THJ0": -1.2},
}
OPENED = {**dict.fromkeys(CLOSED, 0.0), "THJ4": 1.0, "THJ3": 0.2}
GROUPS = {"thumb": "TH", "index": "FF", "middle": "MF", "ring": "RF", "little": "LF"}


def hand() -> Hand:
    """The Shadow Hand with 3 slides, 24 joints and 23 actuators (paper, MuJoCo set-up)."""
    ranges = np.array([ACTUATOR_RANGES[joint] for joint in ACTUATED])
    actuators = (*SLIDES, *(f"{PREFIX}A_{joint}" for joint in ACTUATED))
    tip = {"thumb": 0.0275}
    return Hand(
        name="shadow",
        build=build,
        joints=(*SLIDES, *(PREFIX + joint for joint in JOINTS)),
        actuators=actuators,
        actuated=(*SLIDES, *(PREFIX + joint for joint in ACTUATED)),
        palm=PREFIX + "palm",
        palm_point=PALM_BOX,
        # Sites S_*tip of the model.
        fingertips=tuple(
            (f"{PREFIX}{FINGERS[digit]}distal", (0.0, 0.0, tip.get(digit, 0.026))) for digit in DIGITS
        ),
        surfaces=_surfaces(),
        pitch=Pitch(
            rows={"proximal": 6e-3, "middle": 3e-3, "distal": 7.5e-3},
            column=5e-3,
            radius=1.5e-3,
            large_radius=3.5e-3,
        ),
        action_map=LinearAction(
            centre=np.concatenate([SLIDE_CENTRE, ranges.mean(axis=1)]),
            half_range=np.concatenate([SLIDE_HALF_RANGE, np.ptp(ranges, axis=1) / 2]),
        ),
        action_names=actuators,
        couplings=tuple(
            (PREFIX + joint, f"{PREFIX}{joint[:2]}J1", DISTAL_PER_MIDDLE) for joint in UNACTUATED
        ),
        start=_start(),
        observation=(
            "joint_positions",
            "joint_velocities",
            "object_position",
            "object_orientation",
        ),
        grasps=GRASPS,
        opened={f"{PREFIX}A_{joint}": angle for joint, angle in OPENED.items()},
        closed={f"{PREFIX}A_{joint}": angle for joint, angle in CLOSED.items()},
        groups=tuple(
            tuple(f"{PREFIX}A_{joint}" for joint in CLOSED if joint.startswith(group))
            for group in GROUPS.values()
        ),
        group_names=tuple(f"closing of {digit}" for digit in GROUPS),
    )
