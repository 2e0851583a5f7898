"""The bodies and joints of a model in DART, from its YAML or from a file by DART's own parsers."""

import contextlib
import os
import sys
import tempfile
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import dartpy
import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from dart_model.errors import ModelError
from dart_model.plant.coordinates import Move, move_of
from dart_model.plant.dart_types import DartBody, DartSkeleton
from dart_model.plant.inputs import Inputs
from dart_model.plant.loops import Loops
from dart_model.skeleton_checks import refuse_fatal
from dart_model.skeleton_file import MJCF_SUFFIXES, refuse_endless
from dart_model.skeleton_loops import loops_of_file
from dart_model.spec import WORLD, BodySpec, FileSkeleton, InlineSkeleton, ModelSpec

# dartpy ships no types.
_dart = cast("Any", dartpy)

_INSTANT_S = 1e-9
"""DART evaluates a joint's springs and dampers at the end of its time step, not of the plant's."""


class Skeleton(NamedTuple):
    """Bodies and joints in DART, and what drives them.

    Attributes:
        loops: Joints that close chains of bodies; None where there are none.
        move: How the coordinates change at given rates.
        free: Indices of the coordinates that are free to move: of all that no input moves, those
            that no loop makes depend on others.
    """

    dart: DartSkeleton
    bodies: dict[str, DartBody]
    inputs: Inputs
    loops: Loops | None
    move: Move
    free: NDArray[np.intp]

    @property
    def coordinates(self) -> int:
        """Number of joint coordinates."""
        return self.dart.getNumDofs()


def build(spec: ModelSpec) -> Skeleton:
    """The skeleton of a model, with its gravity and with the masses that effects add.

    Raises:
        ModelError: A skeleton file is wrong, a body that the model names is not in it, no joint
            moves, or an effect leaves a body no mass.
    """
    if isinstance(spec.skeleton, FileSkeleton):
        dart = _read_skeleton(spec.skeleton, spec.folder)
    else:
        dart = _inline_skeleton(spec.name, spec.skeleton)
    bodies = {body.getName(): body for body in dart.getBodyNodes()}
    for strut in spec.struts:
        where = f"model {spec.name}: strut {strut.name}"
        for end in strut.between:
            if end != WORLD and end not in bodies:
                raise ModelError(
                    f"{where}: between {end!r}: expected one of {', '.join([WORLD, *bodies])}"
                )
        if strut.carried not in bodies:
            raise ModelError(
                f"{where}: carries {strut.carried!r}: expected one of {', '.join(bodies)}"
            )
    if dart.getNumDofs() == 0:
        raise ModelError(f"model {spec.name}: skeleton has no joint that moves, expected one")
    dart.setGravity([0.0, 0.0, -spec.gravity_m_per_s2])
    dart.setTimeStep(_INSTANT_S)
    _add_masses(spec, bodies)
    _refuse_singular_mass(spec, dart)
    inputs, move = Inputs(spec, dart), move_of(dart)
    loops, closing = None, spec.skeleton.loops
    if isinstance(spec.skeleton, FileSkeleton):
        closing = loops_of_file(spec.folder / spec.skeleton.file) + closing
    if closing:
        loops = Loops(spec.name, closing, dart, inputs.free, move)
    free = inputs.free if loops is None else loops.free
    return Skeleton(dart, bodies, inputs, loops, move, free)


def _add_masses(spec: ModelSpec, bodies: dict[str, DartBody]) -> None:
    """Give DART the masses that effects add, so that it carries their weight and inertia."""
    for strut in spec.struts:
        for item in strut.effects:
            if not effect(item.name).adds_mass:
                continue
            mass = bodies[strut.carried].getMass() + item.values()[0]
            if mass <= 0.0:
                raise ModelError(
                    f"model {spec.name}: strut {strut.name}: effect {item.name} leaves "
                    f"{strut.carried} a mass of {mass} kg, expected more than zero"
                )
            bodies[strut.carried].setMass(mass)


def _refuse_singular_mass(spec: ModelSpec, dart: DartSkeleton) -> None:
    """Refuse a skeleton that moves without inertia: DART reads a mass that is no number as 0."""
    try:
        np.linalg.cholesky(dart.getMassMatrix())
    except np.linalg.LinAlgError:
        raise ModelError(
            f"model {spec.name}: skeleton: a joint moves no mass, expected axes that are not zero "
            "and bodies with mass and moments of inertia"
        ) from None


def _inline_skeleton(name: str, spec: InlineSkeleton) -> DartSkeleton:
    skeleton = _dart.dynamics.Skeleton(name)
    bodies: dict[str, DartBody] = {}
    for body in spec.bodies:
        create, properties = _joint(body, skeleton)
        _, node = create(bodies.get(body.joint.parent), properties)
        node.setName(body.name)
        moments = body.inertia_kg_m2 or (body.mass_kg,) * 3
        inertia = _dart.dynamics.Inertia(body.mass_kg, np.zeros(3), np.diag(moments))
        node.setInertia(inertia)
        bodies[body.name] = node
    return skeleton


def _joint(body: BodySpec, skeleton: object) -> tuple[Callable[..., Any], object]:
    kinds = {
        "prismatic": (_dart.dynamics.PrismaticJointProperties, "Prismatic"),
        "revolute": (_dart.dynamics.RevoluteJointProperties, "Revolute"),
        "free": (_dart.dynamics.FreeJointProperties, "Free"),
        "ball": (_dart.dynamics.BallJointProperties, "Ball"),
    }
    make, kind = kinds[body.joint.type]
    properties = make()
    properties.mName = f"{body.name}_joint"
    if body.joint.type in ("prismatic", "revolute"):
        axis = np.array(body.joint.axis)
        properties.mAxis = axis / np.linalg.norm(axis)
    offset = _dart.math.Isometry3()
    offset.set_translation(np.array(body.joint.offset_m))
    properties.mT_ParentBodyToJoint = offset
    return getattr(skeleton, f"create{kind}JointAndBodyNodePair"), properties


def _read_skeleton(spec: FileSkeleton, folder: Path) -> DartSkeleton:
    # No link is followed: what the file includes is in its folder, also where it was copied to.
    path = (folder / spec.file).absolute()
    if not path.is_file():
        raise ModelError(f"{path}: skeleton.file: no such file, expected URDF, SDF, SKEL or MJCF")
    suffix = path.suffix.lower()
    if suffix not in _PARSERS:
        raise ModelError(f"{path}: suffix {suffix!r}: expected {', '.join(_PARSERS)}")
    refuse_endless(path)
    refuse_fatal(path)
    try:
        with _captured_stderr() as written:
            skeleton = _PARSERS[suffix](str(path))
    except _OF_THE_PARSERS as error:
        reason = " ".join(str(error).split())[:200]
        raise ModelError(
            f"{path}: DART cannot read it ({reason}), expected a valid {suffix} file, whose values "
            "are numbers where they should be"
        ) from error
    reason = _first_error(written)
    if skeleton is None or reason:
        raise ModelError(
            f"{path}: DART reads no skeleton from it{reason}, expected a valid {suffix} file"
        )
    if suffix in MJCF_SUFFIXES:
        _refuse_bodies_without_shape(skeleton, path)
    return skeleton


@contextlib.contextmanager
def _captured_stderr() -> Generator[list[str]]:
    """Lines that a parser in C++ writes to standard error, complete after the block.

    They name the place of an error, which the parser does not return.
    """
    lines: list[str] = []
    sys.stderr.flush()
    with tempfile.TemporaryFile() as file:
        kept = os.dup(2)
        os.dup2(file.fileno(), 2)
        try:
            yield lines
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            lines += file.read().decode("utf-8", "replace").splitlines()


def _first_error(lines: Sequence[str]) -> str:
    """The first error among a parser's lines, in brackets; empty if there is none."""
    errors = (line.removeprefix("Error:") for line in lines if line.startswith("Error:"))
    return next((f" ({' '.join(error.split())[:200]})" for error in errors), "")


def _read_urdf(uri: str) -> DartSkeleton | None:
    loader = _dart.utils.DartLoader()
    options = loader.getOptions()
    # A bench stands on the ground; DART would let the root link fly.
    options.mDefaultRootJointType = _dart.utils.DartLoaderRootJointType.FIXED
    loader.setOptions(options)
    return loader.parseSkeleton(uri)


def _first_skeleton(world: Any) -> DartSkeleton | None:
    return world.getSkeleton(0) if world is not None and world.getNumSkeletons() > 0 else None


def _joined_skeletons(world: Any) -> DartSkeleton | None:
    """All of an MJCF file, of whose bodies on the world DART makes a skeleton each."""
    first = cast("Any", _first_skeleton(world))
    for k in range(1, 0 if first is None else world.getNumSkeletons()):
        other = world.getSkeleton(k)
        while other.getNumBodyNodes():
            other.getBodyNode(0).moveTo(first, None)
    return first


_PARSERS: dict[str, Callable[[str], DartSkeleton | None]] = {
    ".urdf": _read_urdf,
    ".sdf": _dart.utils.SdfParser.readSkeleton,
    ".skel": lambda uri: _first_skeleton(_dart.utils.SkelParser.readWorld(uri)),
    **dict.fromkeys(
        MJCF_SUFFIXES, lambda uri: _joined_skeletons(_dart.utils.MjcfParser.readWorld(uri))
    ),
}
"""DART's parser for each suffix."""

_OF_THE_PARSERS = (RuntimeError, ValueError, LookupError, ArithmeticError, MemoryError)
"""What exceptions of C++ become: of a word that is no number, and of a number out of range."""


def _refuse_bodies_without_shape(skeleton: DartSkeleton, path: Path) -> None:
    """Refuse bodies without a geom: DART's MJCF parser gives them 1 kg, whatever their inertial."""
    for body in skeleton.getBodyNodes():
        if body.getNumShapeNodes() == 0:
            raise ModelError(
                f"{path}: body {body.getName()}: no geom, expected one: DART reads no mass without"
            )
