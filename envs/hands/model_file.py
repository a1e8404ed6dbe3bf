"""Model files as they are published, MJCF or URDF, as editable models."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from .. import validation

# MuJoCo would print its warnings, which are counted (`Simulator.warnings`), and write a
# log.
LOGS = mujoco.MjLogConfig.get()
LOGS.logto_console = LOGS.logto_file = False
LOGS.set()
EMPTY_SPEC = mujoco.MjSpec()
"""MuJoCo's own defaults, `EMPTY_SPEC.default`, for what is added to a model that has
defaults."""
MESHES = (".stl", ".obj", ".msh")
LARGEST_MESH = 2.0  # m, from the middle: larger ones are in mm
# What a scene decides, and no hand:
WORLD_OPTIONS = "gravity", "wind", "density", "viscosity"
WORLD_FLAGS = sum(
    int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{what}"))
    for what in ("GRAVITY", "CONTACT", "CONSTRAINT", "ACTUATION", "SENSOR")
)
MIN_INERTIA = 1e-9  # kg m²: what a URDF rounds to zero


def read(path: Path) -> mujoco.MjSpec:
    """Return the model of a file, with nothing of it merged, and nothing of the world around it.

    Raise ValueError in one line for a file that is wrong, and FileNotFoundError.
    """
    is_urdf = "<robot" in validation.read_text(path, "model")
    with reading():
        if is_urdf:
            spec = mujoco.MjSpec.from_string(_prepared_urdf(path))
        else:
            spec = mujoco.MjSpec.from_file(str(path))
    for name in WORLD_OPTIONS:
        setattr(spec.option, name, getattr(EMPTY_SPEC.option, name))
    spec.option.disableflags &= ~WORLD_FLAGS
    spec.memory = EMPTY_SPEC.memory
    for number, body in enumerate(spec.bodies):
        body.name = body.name or f"unnamed body {number}"
    for number, actuator in enumerate(spec.actuators):
        actuator.name = actuator.name or f"{actuator.target} {number}"
    spec.compiler.fusestatic = False
    spec.compiler.balanceinertia |= is_urdf
    for mesh in spec.meshes if is_urdf else ():  # scans are seldom closed
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    return spec


def files(path: Path, spec: mujoco.MjSpec) -> tuple[Path, ...]:
    """Return a model's file, what it includes, and its meshes, textures and height fields."""
    named = [(spec.meshdir, each.file) for each in (*spec.meshes, *spec.hfields)]
    named += [(spec.texturedir, each.file) for each in spec.textures]
    assets = [
        path.parent / folder / (Path(name).name if spec.strippath else name)
        for folder, name in named
    ]
    return (*_with_included(path, path.parent), *filter(Path.is_file, assets))


def _with_included(path: Path, folder: Path) -> list[Path]:
    """Return a file and all that it includes: from the model's folder, or else from its own."""
    found = [path]
    for include in ElementTree.parse(path).iter("include"):
        name = include.get("file", "")
        beside = folder / name
        beside = beside if beside.exists() else path.parent / name
        found += _with_included(beside, folder)
    return found


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Return the compiled model.

    Raise ValueError in one line where it is wrong, a mesh of it cannot be found, or is
    in mm.
    """
    with reading():
        model = spec.compile()
    sizes = np.where(model.geom_dataid >= 0, model.geom_rbound, 0.0)
    if sizes.max(initial=0.0) > LARGEST_MESH:
        largest = int(np.argmax(sizes))
        name = model.mesh(model.geom_dataid[largest]).name
        raise ValueError(
            f"model: found mesh {name!r} {2 * sizes[largest]:.3g} m large: its file is in mm; say "
            'scale="0.001 0.001 0.001" where the model names the mesh'
        )
    return model


@contextmanager
def reading() -> Iterator[None]:
    """Have MuJoCo and the reader of XML raise ValueErrors of one line, and print no warnings."""
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    except (ValueError, ElementTree.ParseError, mujoco.FatalError) as error:
        raise ValueError(f"model: {' '.join(str(error).split())}") from None


def _prepared_urdf(path: Path) -> str:
    """Return a URDF as MuJoCo reads it: with absolute paths of meshes, and nothing for pictures.

    Raise ValueError for what MuJoCo would drop or misread.
    """
    robot = ElementTree.parse(path).getroot()
    if any("xacro" in str(element.tag) for element in robot.iter()):
        raise ValueError("found xacro, which ROS expands: xacro FILE.xacro > FILE.urdf")
    for extension in robot.findall("mujoco"):
        robot.remove(extension)
    for link in robot.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    for mesh in robot.iter("mesh"):
        mesh.set("filename", str(_mesh(mesh.get("filename", ""), path)))
    for inertia in robot.iter("inertia"):
        for axis in ("ixx", "iyy", "izz"):
            about = max(float(inertia.get(axis, 0)), MIN_INERTIA)
            inertia.set(axis, repr(about))
    options = {"strippath": "false", "fusestatic": "false", "discardvisual": "false"}
    extension = ElementTree.SubElement(robot, "mujoco")
    ElementTree.SubElement(extension, "compiler", options)
    return ElementTree.tostring(robot, encoding="unicode")


def _mesh(name: str, path: Path) -> Path:
    """Return the file of a URDF's mesh: beside the URDF, or in a package that it is in."""
    if not name.lower().endswith(MESHES):
        raise ValueError(
            f"found collision mesh {name}, allowed STL and OBJ: convert it"
        )
    inside = name.removeprefix("file://").removeprefix("package://")
    for folder in path.absolute().parents:
        for place in (folder / inside, folder / inside.partition("/")[2]):
            if place.is_file():
                return place
    raise ValueError(f"found no file for mesh {name}")
