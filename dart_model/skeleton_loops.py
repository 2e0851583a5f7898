"""Joints that close loops, as MJCF and SDF files state them: DART's parsers leave them out.

In MJCF they are `equality` constraints of the kind `connect`. In SDF a link is the child of two
joints: DART takes the first, and the others close loops.

References:
    MuJoCo documentation, XML Reference, equality/connect.
    SDFormat specification 1.7, joint.
"""

import math
from collections.abc import Iterator
from pathlib import Path

from can_dbc.yaml_file import validate
from dart_model.errors import ModelError
from dart_model.skeleton_file import MJCF_SUFFIXES, list_includes
from dart_model.skeleton_xml import Element, read_xml
from dart_model.spec import WORLD, LoopSpec


def loops_of_file(path: Path) -> tuple[LoopSpec, ...]:
    """The loops of a skeleton file; none where its format has none.

    Raises:
        FileError: It, or a file that it includes, cannot be read.
        ModelError: A loop is of a kind that is not supported, or states too little.
    """
    suffix = path.suffix.lower()
    if suffix in MJCF_SUFFIXES:
        files = [path, *(path.parent / name for name in list_includes(path))]
        return tuple(loop for file in files for loop in _of_mjcf(read_xml(file), file))
    if suffix == ".sdf":
        return tuple(_of_sdf(read_xml(path), path))
    return ()


def _of_mjcf(root: Element, path: Path) -> Iterator[LoopSpec]:
    for equality in (item for item in root.children if item.name == "equality"):
        for item in equality.children:
            where = f"{path}: equality {item.name}"
            given = item.attributes
            if given.get("active", "true") == "false":
                continue
            if item.name != "connect":
                raise ModelError(f"{where}: is not supported, expected connect")
            if "body1" not in given or "anchor" not in given:
                raise ModelError(f"{where}: expected body1 and anchor")
            between = given["body1"], given.get("body2", WORLD)
            anchor = [float(word) for word in given["anchor"].split()]
            yield _loop(where, between=between, at=anchor, type="ball")


def _of_sdf(root: Element, path: Path) -> Iterator[LoopSpec]:
    model = _first_model(root)
    seen: set[str] = set()
    for joint in model.children:
        if joint.name != "joint":
            continue
        child = joint.child_text("child")
        if child in seen:
            yield _of_sdf_joint(joint, child, path)
        seen.add(child)


def _first_model(root: Element) -> Element:
    """The model that DART reads."""
    worlds = [item for item in root.children if item.name == "world"]
    models = (item for part in (root, *worlds) for item in part.children if item.name == "model")
    return next(models, Element("model", {}))


def _of_sdf_joint(joint: Element, child: str, path: Path) -> LoopSpec:
    where = f"{path}: joint {joint.attributes.get('name', '')[:100]!r}"
    kind = joint.attributes.get("type", "")
    if kind not in ("ball", "revolute"):
        raise ModelError(
            f"{where}: type {kind[:100]!r}: closes a loop, because {child[:100]} is the child of "
            "another joint too, expected ball or revolute"
        )
    pose = joint.child("pose")
    if pose.attributes.get("relative_to", child) != child:
        raise ModelError(f"{where}: pose relative_to: expected the child, or none")
    numbers = [float(word) for word in pose.text.split()] or [0.0] * 6
    fields: dict[str, object] = {"at": numbers[:3], "type": kind}
    if kind == "revolute":
        fields["axis"] = _axis(joint, numbers[3:], where)
    return _loop(where, between=(child, joint.child_text("parent")), **fields)


def _axis(joint: Element, turned_rad: list[float], where: str) -> list[float]:
    """Axis of a joint in its child's frame, from that of the joint."""
    axis = joint.child("axis")
    xyz = axis.child("xyz")
    if axis.child_text("use_parent_model_frame") in ("1", "true"):
        raise ModelError(f"{where}: axis use_parent_model_frame: expected 0, or none")
    if xyz.attributes.get("expressed_in", "") != "":
        raise ModelError(f"{where}: axis expressed_in: expected none, the joint's own frame")
    x, y, z = (float(word) for word in xyz.text.split() or ("0", "0", "1"))
    roll, pitch, yaw = turned_rad
    y, z = _turned(y, z, roll)
    z, x = _turned(z, x, pitch)
    x, y = _turned(x, y, yaw)
    return [x, y, z]


def _turned(a: float, b: float, angle_rad: float) -> tuple[float, float]:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return c * a - s * b, s * a + c * b


def _loop(where: str, **fields: object) -> LoopSpec:
    return validate(LoopSpec, fields, where)
