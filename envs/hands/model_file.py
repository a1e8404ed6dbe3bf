"""Model files as they are published, MJCF or URDF, as editable models."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from xml.etree import ElementTree

import mujoco

# Of an element of MjSpec: where it stands, not what it is like.
NOT_DEFAULTS = {
    "id",
    "signature",
    "parent",
    "frame",
    "compiler",
    "classname",
    "plugin",
    "alt",
    "name",
}
MESHES = (".stl", ".obj", ".msh")
PACKAGE = "package://"


def read(path: Path) -> mujoco.MjSpec:
    """A model's file, with nothing of it merged; ValueError in one line."""
    beside = {
        os.path.relpath(file, path.parent): file.read_bytes()
        for file in included(path)[1:]
    }
    is_urdf = _root(path).tag == "robot"
    with quiet():
        try:
            text = _urdf(path) if is_urdf else path.read_text(encoding="utf-8")
            spec = mujoco.MjSpec.from_string(text, include=beside)
        except ValueError as error:
            raise ValueError(f"model {path}: {' '.join(str(error).split())}") from None
    spec.modelfiledir = str(path.parent)
    assets(path, spec)  # not pipes
    _forget_defaults(spec)
    spec.compiler.fusestatic = False
    spec.compiler.balanceinertia = is_urdf
    for mesh in spec.meshes if is_urdf else ():  # scans are seldom closed
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    return spec


def _root(path: Path) -> ElementTree.Element:
    try:
        return ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, ValueError) as error:
        raise ValueError(f"model {path}: not valid XML: {error}") from None


def included(path: Path) -> list[Path]:
    """A model's file and those that it includes; FileNotFoundError for what is no file, such as a pipe
    that never ends."""
    found = [path]
    for each in found:  # grows: a file that is included may include others
        if not each.is_file():
            raise FileNotFoundError(f"model {str(each)!r} does not exist")
        with suppress(ElementTree.ParseError, ValueError):  # MuJoCo says it better
            root = ElementTree.parse(each).getroot()
            names = (element.attrib.get("file", "") for element in root.iter("include"))
            for name in names:  # beside the model, or else beside what includes it
                places = path.parent / name, each.parent / name
                other = next((place for place in places if place.exists()), places[0])
                found += [other] if other not in found else []
    return found


def assets(path: Path, spec: mujoco.MjSpec) -> list[Path]:
    """The files of a model's meshes, textures and height fields; FileNotFoundError for what is there
    and no file, such as a pipe: MuJoCo would wait for its end."""
    folders = {
        "meshes": spec.meshdir,
        "hfields": spec.meshdir,
        "textures": spec.texturedir,
    }
    found = [
        path.parent / folder / (Path(each.file).name if spec.strippath else each.file)
        for kind, folder in folders.items()
        for each in getattr(spec, kind)
        if each.file
    ]
    for file in found:
        if file.exists() and not file.is_file():
            raise FileNotFoundError(f"model: found no file {str(file)!r}")
    return found


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """A model; ValueError in one line where it is wrong, or a mesh of it cannot be found."""
    with quiet():
        try:
            return spec.compile()
        except ValueError as error:
            raise ValueError(f"model: {' '.join(str(error).split())}") from None


@contextmanager
def quiet() -> Iterator[None]:
    """MuJoCo's warnings are not written to the terminal, nor to a log where it runs."""
    before, here = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    here.logto_console = here.logto_file = False
    here.set()
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        before.set()


def _forget_defaults(spec: mujoco.MjSpec) -> None:
    """What is added from here on is as MuJoCo has it: the file's own elements have their values."""
    fresh = mujoco.MjSpec()
    for kind in ("geom", "joint", "actuator"):
        own, usual = getattr(spec.default, kind), getattr(fresh.default, kind)
        for name in set(dir(usual)) - NOT_DEFAULTS:
            if not name.startswith(("_", "set_")):
                setattr(own, name, getattr(usual, name))


# -- URDF ------------------------------------------------------------------------------------


def _urdf(path: Path) -> str:
    """The text of a URDF with meshes where they are found, and without what only pictures need."""
    robot = _root(path)
    options = robot.find("mujoco/compiler")
    folder = path.parent / (options.get("meshdir", "") if options is not None else "")
    for extension in robot.findall("mujoco"):
        robot.remove(extension)
    for link in robot.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    unreadable, missing = [], []
    for mesh in robot.iter("mesh"):
        name = mesh.get("filename", "")
        file = _mesh(name, path.parent, folder)
        if not name.lower().endswith(MESHES):
            unreadable.append(name)
        elif file is None:
            missing.append(name)
        else:
            mesh.set("filename", str(file.absolute()))
    for names, what in ((unreadable, "collision meshes that are neither STL nor OBJ; convert them"),
                        (missing, "no files for these meshes")):  # fmt: skip
        if names:
            more = f" and {len(set(names)) - 3} more" if len(set(names)) > 3 else ""
            raise ValueError(
                f"found {what}: {', '.join([*dict.fromkeys(names)][:3])}{more}"
            )
    extension = ElementTree.SubElement(robot, "mujoco")
    ElementTree.SubElement(
        extension,
        "compiler",
        strippath="false",
        fusestatic="false",
        discardvisual="false",
    )
    return ElementTree.tostring(robot, encoding="unicode")


def _mesh(name: str, *folders: Path) -> Path | None:
    """Where a mesh of a URDF is: beside it, under its meshdir, or in a package that a folder above it
    belongs to."""
    first = folders[0].absolute()
    if name.startswith(PACKAGE):
        package, _, inside = name.removeprefix(PACKAGE).partition("/")
        above = [first, *first.parents]
        places = [
            place
            for each in above
            for place in (each / package / inside, each / inside)
        ]
    else:
        name = name.removeprefix("file://")
        places = [
            place for each in folders for place in (each / name, each / Path(name).name)
        ]
    return next((place for place in places if place.is_file()), None)
