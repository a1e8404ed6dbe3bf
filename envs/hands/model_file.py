"""Model files as they are published, MJCF or URDF, as editable models."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import mujoco
import numpy as np

EMPTY_SPEC = mujoco.MjSpec()
"""MuJoCo's own defaults, `EMPTY_SPEC.default`, for what is added to a model that has defaults."""
MESHES = (".stl", ".obj", ".msh")
PACKAGE = "package://"
LARGEST_MESH = 2.0  # m, from the middle: larger ones are in mm
MAX_RADIANS = 3 * np.pi  # rad: URDFs whose limits are wider have degrees
# What a scene decides, and no hand:
WORLD_FLAGS = sum(
    int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{what}"))
    for what in ("GRAVITY", "CONTACT", "CONSTRAINT", "ACTUATION", "SENSOR")
)
MIN_INERTIA = 1e-9  # kg m²: what a URDF rounds to zero


def read(path: Path) -> mujoco.MjSpec:
    """Return the model of a file, with nothing of it merged.

    Raise ValueError in one line for a file that is wrong.
    """
    root, files = parsed(path)
    is_urdf = root.tag == "robot"
    with reading():
        text = path.read_text(encoding="utf-8")
        if is_urdf:
            _prepare_urdf(root, path)
        if is_urdf or len(files) > 1:
            text = ElementTree.tostring(root, encoding="unicode")
        spec = mujoco.MjSpec.from_string(text)
    _leave_out_world(spec)
    spec.modelfiledir = str(path.parent)
    assets(path, spec)  # not pipes
    for number, body in enumerate(spec.bodies):
        body.name = body.name or f"unnamed body {number}"
    for number, actuator in enumerate(spec.actuators):
        actuator.name = actuator.name or f"{actuator.target} {number}"
    spec.compiler.fusestatic = False
    spec.compiler.balanceinertia |= is_urdf
    for mesh in spec.meshes if is_urdf else ():  # scans are seldom closed
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    return spec


def _leave_out_world(spec: mujoco.MjSpec) -> None:
    """Remove what a model says about the world around it, which a scene has of its own.

    Remove disabled actuators too. Raise ValueError where a total mass is given, which would be that
    of the whole scene.
    """
    if getattr(spec.compiler, "settotalmass", -1) > 0:  # MuJoCo is going to drop it
        raise ValueError(
            "model: found settotalmass, allowed masses or densities of the parts"
        )
    for name in ("gravity", "wind", "density", "viscosity"):
        setattr(spec.option, name, getattr(EMPTY_SPEC.option, name))
    spec.option.disableflags &= ~WORLD_FLAGS
    spec.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_OVERRIDE)
    spec.memory = EMPTY_SPEC.memory
    for actuator in list(spec.actuators):
        if spec.option.disableactuator >> actuator.group & 1:
            spec.delete(actuator)
    spec.option.disableactuator = 0


def parsed(path: Path) -> tuple[Element, list[Path]]:
    """Return the XML of a model's file with what it includes in place, and the paths of its files.

    Raise FileNotFoundError for what is no file, such as a pipe that never ends.
    """
    files: list[Path] = []

    def parse(file: Path) -> Element:
        if file in files:
            raise ValueError(f"model {path}: found {file} included twice, allowed once")
        if not file.is_file():
            raise FileNotFoundError(f"model {str(file)!r} does not exist")
        files.append(file)
        try:
            root = ElementTree.parse(file).getroot()
        except (ElementTree.ParseError, ValueError) as error:
            raise ValueError(f"model {file}: not valid XML: {error}") from None
        if any("xacro" in str(element.tag) for element in root.iter()):
            target = file.name.removesuffix(".xacro").removesuffix(".urdf") + ".urdf"
            raise ValueError(
                f"model {file}: found xacro, which ROS expands: xacro {file.name} > {target}"
            )
        for parent in list(root.iter()):
            for include in parent.findall("include"):
                name = include.get("file", "")
                beside = path.parent / name
                inner = parse(beside if beside.exists() else file.parent / name)
                at = list(parent).index(include)
                parent[at : at + 1] = list(inner)
        return root

    return parse(path), files


def assets(path: Path, spec: mujoco.MjSpec) -> list[Path]:
    """Return the files of a model's meshes, textures and height fields that are there.

    Raise FileNotFoundError for a pipe and the like: MuJoCo would wait for its end.
    """
    named = [(spec.meshdir, each.file) for each in (*spec.meshes, *spec.hfields)]
    named += [(spec.texturedir, each.file) for each in spec.textures]
    files = []
    for folder, name in named:
        file = path.parent / folder / (Path(name).name if spec.strippath else name)
        if file.is_file():
            files.append(file)
        elif name and file.exists():
            raise FileNotFoundError(f"model: found no file {str(file)!r}")
    return files


def undrawable(spec: mujoco.MjSpec) -> list[str]:
    """Return the meshes that only pictures need and whose files are missing, empty or damaged."""
    drawn = {geom.meshname for geom in spec.geoms}
    drawn -= {geom.meshname for geom in spec.geoms if geom.contype or geom.conaffinity}
    names = []
    for mesh in spec.meshes:
        if mesh.file and mesh.name in drawn:
            alone = mujoco.MjSpec()
            alone.modelfiledir, alone.meshdir = spec.modelfiledir, spec.meshdir
            alone.strippath = spec.strippath
            alone.add_mesh(name=mesh.name, file=mesh.file)
            try:
                compiled(alone)
            except ValueError:
                names.append(mesh.name)
    return names


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Return the compiled model.

    Raise ValueError in one line where it is wrong, a mesh of it cannot be found, or is in mm.
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
def quiet() -> Iterator[None]:
    """Keep MuJoCo's warnings off the terminal, and from a log where it runs."""
    before, here = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    here.logto_console = here.logto_file = False
    here.set()
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        before.set()


@contextmanager
def reading() -> Iterator[None]:
    """Have MuJoCo raise its errors as ValueErrors of one line, and print no warnings."""
    try:
        with quiet():
            yield
    except (ValueError, RecursionError) as error:
        raise ValueError(f"model: {' '.join(str(error).split())}") from None


# -- URDF ------------------------------------------------------------------------------------


def _prepare_urdf(robot: Element, path: Path) -> None:
    """Give the meshes of a URDF their absolute paths, and leave out what only pictures need.

    Raise ValueError for what MuJoCo would drop or misread.
    """
    options = robot.find("mujoco/compiler")
    folder = path.parent / (options.get("meshdir", "") if options is not None else "")
    for extension in robot.findall("mujoco"):
        robot.remove(extension)
    for link in robot.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    for mesh in robot.iter("mesh"):
        name = mesh.get("filename", "")
        if not name.lower().endswith(MESHES):
            raise ValueError(
                f"found collision mesh {name}, allowed STL and OBJ: convert it"
            )
        file = _mesh(name, path.parent, folder)
        if file is None:
            raise ValueError(f"found no file for mesh {name}")
        mesh.set("filename", str(file.absolute()))
    for inertia in robot.iter("inertia"):
        for axis in ("ixx", "iyy", "izz"):
            about = max(float(inertia.get(axis, 0)), MIN_INERTIA)
            inertia.set(axis, repr(about))
    _check_joints(robot)
    extension = ElementTree.SubElement(robot, "mujoco")
    ElementTree.SubElement(
        extension,
        "compiler",
        strippath="false",
        fusestatic="false",
        discardvisual="false",
    )


def _check_joints(robot: Element) -> None:
    """Raise ValueError for limits in degrees, and for a joint that follows none that moves."""
    joints = robot.findall("joint")
    moving = {joint.get("name") for joint in joints if joint.get("type") != "fixed"}
    for joint in joints:
        name, limit, mimic = joint.get("name"), joint.find("limit"), joint.find("mimic")
        if limit is not None and joint.get("type") == "revolute":
            ends = [float(limit.get(end, 0)) for end in ("lower", "upper")]
            if max(map(abs, ends)) > MAX_RADIANS:
                raise ValueError(
                    f"joint {name!r}: found limits {ends}, allowed radians: these are degrees; "
                    "multiply them by pi / 180"
                )
        if mimic is not None and mimic.get("joint") not in moving - {name}:
            raise ValueError(
                f"joint {name!r}: found <mimic> of {mimic.get('joint')!r}, allowed another joint that "
                "moves"
            )


def _mesh(name: str, *folders: Path) -> Path | None:
    """Return the file of a URDF's mesh, None where there is none.

    It is beside the URDF, under its meshdir, or in a package that a folder above it belongs to.
    """
    names = [name.removeprefix("file://"), Path(name).name]
    if name.startswith(PACKAGE):
        package, _, inside = name.removeprefix(PACKAGE).partition("/")
        names = [f"{package}/{inside}", inside]
        first = folders[0].absolute()
        folders = (first, *first.parents)
    places = [folder / name for folder in folders for name in names]
    return next((place for place in places if place.is_file()), None)
