"""What in a skeleton file would end DART, which checks little of it, and the program with it.

The numbers of a vector are written into memory for as many as there should be, and what is missing
keeps whatever stood there. Bodies without a joint and shapes that DART does not know are followed
as if they were there.
"""

import math
import re
from collections.abc import Container, Iterator, Mapping
from pathlib import Path

from dart_model.errors import ModelError
from dart_model.skeleton_file import MJCF_SUFFIXES, list_includes
from dart_model.skeleton_xml import Element, read_xml, walk

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)

_OF_MJCF: Mapping[str, int] = {
    **dict.fromkeys(("pos", "axis", "euler", "zaxis", "diaginertia", "scale", "anchor"), 3),
    **dict.fromkeys(("gravity", "wind", "magnetic"), 3),
    **dict.fromkeys(("quat", "axisangle", "rgba"), 4),
    **dict.fromkeys(("xyaxes", "fromto", "fullinertia"), 6),
    "range": 2,
    "relpose": 7,
}
"""Attribute of an MJCF file -> how many numbers it has."""

_POSED = ("model", "link", "inertial", "visual", "collision", "joint", "soft_shape")
_SHAPES_OF_SDF = ("visual", "collision")
_OF_SDF: Mapping[tuple[str, str], int] = {
    **dict.fromkeys(((parent, "pose") for parent in _POSED), 6),
    ("axis", "xyz"): 3,
    ("axis2", "xyz"): 3,
    ("physics", "gravity"): 3,
    ("box", "size"): 3,
    ("box", "frags"): 3,
    ("ellipsoid", "size"): 3,
    ("plane", "size"): 2,
    ("mesh", "scale"): 3,
}
"""Element of an SDF file, behind what it is in -> how many numbers it has."""

_PLACED = ("skeleton", "body", "joint", "visualization_shape", "collision_shape", "soft_shape")
_SHAPES_OF_SKEL = ("visualization_shape", "collision_shape")
_OF_SKEL: Mapping[tuple[str, str], int] = {
    **dict.fromkeys(((parent, "transformation") for parent in _PLACED), 6),
    ("axis", "xyz"): 3,
    ("axis2", "xyz"): 3,
    ("translation_axis1", "xyz"): 3,
    ("translation_axis2", "xyz"): 3,
    ("physics", "gravity"): 3,
    ("inertia", "offset"): 3,
    ("marker", "offset"): 3,
    ("box", "size"): 3,
    ("box", "frags"): 3,
    ("ellipsoid", "size"): 3,
    ("plane", "normal"): 3,
    ("plane", "point"): 3,
    ("sphere", "position"): 3,
    ("mesh", "scale"): 3,
}
"""Element of a SKEL file, behind what it is in -> how many numbers it has."""

_COORDINATES: Mapping[str, int] = {
    "weld": 0,
    "prismatic": 1,
    "revolute": 1,
    "universal": 2,
    "ball": 3,
    "euler": 3,
    "planar": 3,
    "translational": 3,
    "free": 6,
}
"""Joint of a SKEL file that DART makes -> its coordinates."""

_KNOWN_SHAPES = (
    *("box", "capsule", "cone", "cylinder", "ellipsoid"),
    *("mesh", "multi_sphere", "plane", "pyramid", "sphere"),
)


def refuse_fatal(path: Path) -> None:
    """Refuse a skeleton file that would end DART.

    Raises:
        FileError: It, or a file that it includes, cannot be read.
        ModelError: A vector has too many numbers or too few, or a part is missing.
    """
    suffix = path.suffix.lower()
    if suffix in MJCF_SUFFIXES:
        files = [path, *(path.parent / name for name in list_includes(path))]
        roots = [read_xml(file) for file in files]
        meshes = {it.attributes.get("name") for root in roots for it in _find(root, "mesh")}
        for file, root in zip(files, roots, strict=True):
            _check_mjcf(root, meshes, file)
    elif suffix == ".sdf":
        root = read_xml(path)
        _check_numbers(root, _OF_SDF, path)
        _check_geometries(root, _SHAPES_OF_SDF, path)
    elif suffix == ".skel":
        root = read_xml(path)
        _check_numbers(root, _OF_SKEL, path)
        _check_geometries(root, _SHAPES_OF_SKEL, path)
        for skeleton in _find(root, "skeleton"):
            _check_skel_joints(skeleton, path)
        for geometry in _find(root, "geometry"):
            _check_skel_shape(geometry, path)


def _find(root: Element, name: str) -> Iterator[Element]:
    return (element for element in walk(root) if element.name == name)


def _check_mjcf(root: Element, meshes: Container[str | None], path: Path) -> None:
    for element in walk(root):
        for name, value in element.attributes.items():
            if name in _OF_MJCF:
                _refuse_other_count(f"{path}: {element.name} {name}", value, _OF_MJCF[name])
    for geom in _find(root, "geom"):
        mesh = geom.attributes.get("mesh")
        if mesh is not None and mesh not in meshes:
            raise ModelError(f"{path}: geom mesh {mesh[:100]!r}: expected the name of a mesh")
    for child in root.children:
        if child.name == "worldbody" and any(item.name == "site" for item in child.children):
            raise ModelError(f"{path}: worldbody: has a site, expected sites in bodies alone")


def _check_numbers(root: Element, counts: Mapping[tuple[str, str], int], path: Path) -> None:
    for element in walk(root):
        for child in element.children:
            count = counts.get((element.name, child.name))
            if count is not None:
                _refuse_other_count(f"{path}: {element.name} {child.name}", child.text, count)


def _check_geometries(root: Element, shapes: tuple[str, ...], path: Path) -> None:
    for element in walk(root):
        if element.name in shapes and all(it.name != "geometry" for it in element.children):
            raise ModelError(f"{path}: {element.name}: has no geometry, expected one")


def _check_skel_joints(skeleton: Element, path: Path) -> None:
    """Check that DART makes all joints of a skeleton, and joins all of its bodies by them."""
    joints = [item for item in skeleton.children if item.name == "joint"]
    bodies = {it.attributes.get("name", "") for it in skeleton.children if it.name == "body"}
    joined: set[str] = set()
    for joint in joints:
        name, kind = (joint.attributes.get(key, "")[:100] for key in ("name", "type"))
        where = f"{path}: joint {name!r}"
        if kind not in _COORDINATES:
            raise ModelError(f"{where}: type {kind!r}: expected one of {', '.join(_COORDINATES)}")
        parent, child = joint.child_text("parent"), joint.child_text("child")
        if child not in bodies or parent not in {*bodies, "world", ""}:
            between = f"{parent[:100]!r} and {child[:100]!r}"
            raise ModelError(f"{where}: is between {between}, expected bodies of the skeleton")
        joined |= {parent, child}
        for item in joint.children:
            if item.name in ("init_pos", "init_vel") and _COORDINATES[kind]:
                _refuse_other_count(f"{where}: {item.name}", item.text, _COORDINATES[kind])
    if not joints:
        raise ModelError(f"{path}: skeleton: has no joint, expected one for every body")
    for name in bodies - joined:
        raise ModelError(f"{path}: body {name[:100]!r}: has no joint, expected one")


def _check_skel_shape(geometry: Element, path: Path) -> None:
    names = [item.name for item in geometry.children]
    if not any(name in _KNOWN_SHAPES for name in names):
        expected = ", ".join(_KNOWN_SHAPES)
        raise ModelError(f"{path}: geometry: {names[:3]}: expected one of {expected}")
    for item in geometry.children:
        file = item.child_text("file_name")
        if item.name == "mesh" and not (path.parent / file).is_file():
            raise ModelError(f"{path}: mesh: file_name {file[:100]!r}: no such file")


def _refuse_other_count(where: str, text: str, count: int) -> None:
    """Refuse a text that is not as many numbers as DART takes it for."""
    words = text.split()
    if len(words) != count or not all(_is_number(word) for word in words):
        numbers = "one number" if count == 1 else f"{count} numbers"
        raise ModelError(f"{where}: {' '.join(words)[:100]!r}: expected {numbers}")


def _is_number(word: str) -> bool:
    return _NUMBER.fullmatch(word) is not None and math.isfinite(float(word))
