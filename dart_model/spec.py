"""A model: bodies, joints and struts, as a frozen value read from and written to YAML."""

import re
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    PlainSerializer,
    Tag,
    model_validator,
)
from pydantic_core import PydanticCustomError

from can_dbc.errors import expected_name
from can_dbc.yaml_file import Finite, NotNegative, Positive, parse_mapping, read_text, validate
from dart_model.effects import CATALOGUE, effect
from dart_model.errors import ModelError
from dart_model.skeleton_file import list_includes

MODELS = Path(__file__).parent / "models"
"""Folder of the models that come with the package."""

WORLD = "world"

Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_.-]{0,63}$")]
InputName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,63}$")]
Vector = tuple[Finite, Finite, Finite]

_PERCENTAGE = re.compile(r"([0-9]{1,20}(?:\.[0-9]{1,40})?) ?%")


def _share_of_percentage(value: object) -> float:
    match = _PERCENTAGE.fullmatch(value) if isinstance(value, str) else None
    share = float(Decimal(match[1]) / 100) if match else 0.0
    if not 0.0 < share <= 10.0:
        raise PydanticCustomError("percentage", "expected a percentage up to 1000 %, such as 20 %")
    return share


def _percentage_of_share(share: float) -> str:
    # In decimal digits, so that what is written is read back as the same share.
    return f"{(Decimal(repr(share)) * 100).normalize():f} %"


Share = Annotated[
    float,
    BeforeValidator(_share_of_percentage),
    PlainSerializer(_percentage_of_share, return_type=str),
]
"""A share of a nominal value, in a model file a percentage such as ``20 %``."""


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


def _with_a_direction(axis: Vector) -> Vector:
    if sum(x * x for x in axis) < 1e-12:
        raise ValueError(f"{list(axis)}: expected a direction that is not zero")
    return axis


Axis = Annotated[Vector, AfterValidator(_with_a_direction)]
"""A direction, of any length."""


class JointSpec(_Frozen):
    """Joint between a body and its parent.

    Attributes:
        type: `prismatic`, `revolute`, `ball` or `free`.
        axis: Direction of a prismatic or revolute joint in the parent's frame, of any length.
        parent: Name of the parent body, or `world`.
        offset_m: Origin of the joint in the parent's frame.
    """

    type: Literal["prismatic", "revolute", "ball", "free"]
    axis: Axis = (0.0, 0.0, 1.0)
    parent: Name = WORLD
    offset_m: Vector = (0.0, 0.0, 0.0)


class BodySpec(_Frozen):
    """Rigid body.

    Attributes:
        name: Unique name.
        mass_kg: Mass in kg.
        joint: Joint between the body and its parent.
        inertia_kg_m2: Principal moments of inertia about the centre of mass, which is the origin of
            the body's frame. If absent, each moment has the numerical value of the mass (10 kg:
            10 kg·m²), which is arbitrary: state the moments of every body that rotates.
    """

    name: Name
    mass_kg: Positive
    joint: JointSpec
    inertia_kg_m2: tuple[Positive, Positive, Positive] | None = None


class LoopSpec(_Frozen):
    """A joint that closes a chain of bodies: the two bodies have a point in common.

    Attributes:
        between: The two bodies; either may be `world`.
        at: The common point, in the frame of the first body. In the second body it is the point
            that lies there when all joint coordinates are zero.
        type: `ball`: the bodies turn freely about the point; or `revolute`: about an axis through
            it.
        axis: Axis of a revolute joint in the frame of the first body, of any length.
    """

    between: tuple[Name, Name]
    at: Vector
    type: Literal["ball", "revolute"]
    axis: Axis | None = None

    @model_validator(mode="after")
    def _joins_two_bodies(self) -> "LoopSpec":
        if self.between[0] == self.between[1]:
            raise ValueError(f"between {list(self.between)}: expected two different bodies")
        if (self.type == "revolute") != (self.axis is not None):
            expected = "one, a direction" if self.axis is None else "none"
            raise ValueError(f"axis of a {self.type} joint: expected {expected}")
        return self


class InlineSkeleton(_Frozen):
    """Bodies given in the model file itself.

    Attributes:
        bodies: Rigid bodies, parents before children; required if there is no `file`.
        loops: Joints that close chains of bodies, such as that between wishbone and upright; those
            that an MJCF or SDF file states itself are read from there.
    """

    bodies: Annotated[tuple[BodySpec, ...], Field(min_length=1, max_length=256)]
    loops: Annotated[tuple[LoopSpec, ...], Field(max_length=64)] = ()


def _file_in_its_folder(file: str) -> str:
    path = Path(file)
    if path.is_absolute() or ".." in path.parts:
        raise ValueError(f"file {file!r}: expected a path inside the model's own folder")
    return file


InFolder = Annotated[str, Field(min_length=1, max_length=255), AfterValidator(_file_in_its_folder)]
"""A file in the model file's folder."""


class FileSkeleton(_Frozen):
    """Bodies given by a URDF, SDF, SKEL or MJCF file in the model file's folder.

    Attributes:
        file: Path of a URDF, SDF, SKEL or MJCF file in the model file's folder; required if there
            are no `bodies`.
        loops: Joints that close chains of bodies, such as that between wishbone and upright; those
            that an MJCF or SDF file states itself are read from there.
    """

    file: InFolder
    loops: Annotated[tuple[LoopSpec, ...], Field(max_length=64)] = ()


def _skeleton_kind(skeleton: object) -> str:
    """Tag of the kind, so that an error is about this one alone."""
    is_file = isinstance(skeleton, FileSkeleton) or (
        isinstance(skeleton, dict) and "file" in skeleton
    )
    return "<file>" if is_file else "<bodies>"


class EffectSpec(_Frozen):
    """An effect of the catalogue with its parameters.

    Attributes:
        name: Name of the effect, as on the page Effects.
        parameters: Values by name; all parameters of the effect are required.
    """

    name: str
    parameters: dict[str, Finite] = Field(default_factory=dict[str, float])

    @model_validator(mode="after")
    def _is_in_the_catalogue(self) -> "EffectSpec":
        if self.name not in CATALOGUE:
            raise ValueError(f"name {self.name!r}: {expected_name(self.name, sorted(CATALOGUE))}")
        expected = [parameter.name for parameter in effect(self.name).parameters]
        missing = [name for name in expected if name not in self.parameters]
        unknown = [name for name in self.parameters if name not in expected]
        if missing or unknown:
            wrong = f"unknown {unknown[0]!r}" if unknown else f"{missing[0]!r} is missing"
            raise ValueError(
                f"parameters of {self.name}: {wrong}, expected {', '.join(expected) or 'none'}"
            )
        for item in effect(self.name).parameters:
            value = self.parameters[item.name]
            if not item.low <= value <= item.high:
                limits = f"{item.low:.10g} to {item.high:.10g} {item.unit}".rstrip()
                raise ValueError(
                    f"parameters of {self.name}: {item.name} = {value}: expected {limits}"
                )
        return self

    def values(self) -> list[float]:
        """Parameters in the order of the law's arguments."""
        return [self.parameters[parameter.name] for parameter in effect(self.name).parameters]


Variable = Annotated[str, Field(min_length=1, max_length=200)]
"""A variable of an FMU; with a minus before it, its sign is the other one."""


class FmuSpec(_Frozen):
    """A functional mock-up unit that gives a strut's force, or stands for a whole guided bench.

    Attributes:
        file: The FMU, in the model file's folder.
        height: Variable of the strut's height in m: an input or a state.
        velocity: Variable of the time derivative of the height in m/s, positive in rebound: an
            input or a state.
        force: Variable of the strut's force in N, positive when it pushes the ends apart.
        acceleration: Instead of `force`, if the FMU models the whole bench: variable of the second
            derivative of the height in m/s². Exactly one of the two is required.
        mass_kg: Only with `acceleration`: mass in kg that moves along the height.
        temperature: Input variable for the damper temperature in °C.
        applied_force: Input variable for the applied force in N.
        parameters: Start values of the FMU's parameters, by name.
    """

    file: InFolder
    height: Variable
    velocity: Variable
    force: Variable | None = None
    acceleration: Variable | None = None
    mass_kg: Positive = 1.0
    temperature: Variable | None = None
    applied_force: Variable | None = None
    parameters: dict[str, Finite] = Field(default_factory=dict[str, float])

    @model_validator(mode="after")
    def _gives_a_force(self) -> "FmuSpec":
        if (self.force is None) == (self.acceleration is None):
            raise ValueError("force and acceleration: expected one of them")
        return self


class StrutSpec(_Frozen):
    """Spring-damper: force = -stiffness * (height - free length) - damping * velocity.

    Attributes:
        name: Unique name.
        between: Body at the lower and body at the upper end, in this order; either may be
            `world`.
        free_length_m: Height at which the force of the spring is zero.
        stiffness_n_per_m: Linear stiffness.
        damping_n_s_per_m: Linear damping.
        attachments_m: Attachment points at the lower and at the upper body, each in its body's
            frame.
        carries: Body whose mass the strut's motion depends on: a diagnosis corrects it, and effects
            that add mass load it. By default the upper body, or the lower one if the upper one is
            `world`; of a strut on a suspension arm rather the upright or wheel.
        effects: Effects in addition to the linear spring and damper.
        fmu: A functional mock-up unit (FMU) that computes an additional force in the strut, or
            (with `acceleration`) replaces the whole guided bench. A minus before the name of a
            variable reverses its sign.
    """

    name: Name
    between: tuple[Name, Name]
    free_length_m: Finite
    stiffness_n_per_m: NotNegative
    damping_n_s_per_m: NotNegative
    attachments_m: tuple[Vector, Vector] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    carries: Name | None = None
    effects: tuple[EffectSpec, ...] = ()
    fmu: FmuSpec | None = None

    @model_validator(mode="after")
    def _has_two_ends(self) -> "StrutSpec":
        if self.between[0] == self.between[1]:
            raise ValueError(f"between {list(self.between)}: expected two different bodies")
        return self

    @property
    def carried(self) -> str:
        """The body that it carries."""
        lower, upper = self.between
        return self.carries or (upper if upper != WORLD else lower)


class ForceInput(_Frozen):
    """A force on a body, in N.

    Attributes:
        force_on: Body on which the force acts.
        at: Point of the body at which it acts, in the body's frame.
        axis: Direction of what is positive: of a force in the world's frame, of a motion along its
            joint in the frame of the joint's parent.
    """

    force_on: Name
    at: Vector = (0.0, 0.0, 0.0)
    axis: Axis = (0.0, 0.0, 1.0)


class TorqueInput(_Frozen):
    """A torque on a revolute joint, in N·m.

    Attributes:
        torque_on: Joint on which the torque acts, positive about the joint's axis. The joint of a
            body of `bodies` is called as the body with `_joint` behind it.
    """

    torque_on: Name


class MotionInput(_Frozen):
    """A measured motion of a body, in m: the body moves as measured, whatever force it takes.

    Attributes:
        motion_of: Body that moves; its joint is prismatic and has no other coordinate.
        axis: Direction of what is positive: of a force in the world's frame, of a motion along its
            joint in the frame of the joint's parent.
    """

    motion_of: Name
    axis: Axis = (0.0, 0.0, 1.0)


_INPUT_KINDS = {"force_on": ForceInput, "torque_on": TorqueInput, "motion_of": MotionInput}


def _input_kind(given: object) -> str | None:
    """Tag of the kind, so that an error is about this one alone."""
    for key, kind in _INPUT_KINDS.items():
        if isinstance(given, kind) or (isinstance(given, dict) and key in given):
            return f"<{key}>"
    return None


InputSpec = Annotated[
    Annotated[ForceInput, Tag("<force_on>")]
    | Annotated[TorqueInput, Tag("<torque_on>")]
    | Annotated[MotionInput, Tag("<motion_of>")],
    Discriminator(
        _input_kind,
        custom_error_type="input_kind",
        custom_error_message="expected one of force_on, torque_on and motion_of",
    ),
]
"""What drives the bench."""

APPLIED_FORCE = "applied_force"
"""Name of the input of a model that states none."""


class ModelTolerance(_Frozen):
    """Prior standard deviation of the bench's parameters from the model's values.

    A diagnosis uses it as prior of the linear corrections; a value that is not given has a default.

    Attributes:
        mass_kg: Standard deviation of each mass, in percent; 5 % if absent.
        stiffness_n_per_m: Standard deviation of each strut's stiffness, in percent; 20 % if absent.
        damping_n_s_per_m: Standard deviation of each strut's damping, in percent; 40 % if absent.
        preload_n: Standard deviation of a constant force in each strut, in N, such as the stiffness
            times the standard deviation of the free length; if absent, a tenth of the sum of
            the spring's change of force over the recorded stroke and the linear damper's force at
            the RMS velocity.
        input_gain: Standard deviation of the gain of the applied force, in percent; 2 % if absent.
        free_length_m: Standard deviation of the length about which laws such as a cubic spring act,
            in m; if absent, a tenth of the recorded stroke.
    """

    mass_kg: Share | None = None
    stiffness_n_per_m: Share | None = None
    damping_n_s_per_m: Share | None = None
    preload_n: Positive | None = None
    input_gain: Share | None = None
    free_length_m: Positive | None = None


class ModelSpec(_Frozen):
    """A multibody model of the bench.

    Attributes:
        name: Name of the model.
        gravity_m_per_s2: Gravitational acceleration, in the direction of -z.
        skeleton: Bodies and joints: either `bodies` or `file`.
        inputs: What drives the bench, by name: forces, torques and measured motions. If absent,
            there is one force in the direction of +z, called `applied_force`.
        struts: Spring-dampers; each may have an observer.
        applied_force_body: Without `inputs`: body at whose origin the applied force acts; by
            default the upper body of the last strut, or its lower body if the upper one is
            `world`.
        tolerance: Prior standard deviation of the bench's parameters from the values in this file.
        folder: Folder of the model file, where a skeleton file is looked for; not part of the YAML.
    """

    name: Name
    gravity_m_per_s2: Finite = 9.81
    skeleton: Annotated[
        Annotated[InlineSkeleton, Tag("<bodies>")] | Annotated[FileSkeleton, Tag("<file>")],
        Discriminator(_skeleton_kind),
    ]
    inputs: Annotated[dict[InputName, InputSpec], Field(min_length=1, max_length=64)] | None = None
    struts: Annotated[tuple[StrutSpec, ...], Field(min_length=1, max_length=64)]
    applied_force_body: Name | None = None
    tolerance: ModelTolerance | None = None
    folder: Annotated[Path, Field(exclude=True)] = Path()

    @model_validator(mode="after")
    def _names_fit(self) -> "ModelSpec":
        _refuse_duplicates("strut", (strut.name for strut in self.struts))
        if self.inputs is not None and self.applied_force_body is not None:
            raise ValueError(
                "applied_force_body: expected none together with inputs, of which each names its "
                "body or joint"
            )
        if isinstance(self.skeleton, InlineSkeleton):
            self._check_bodies(self.skeleton)
        return self

    def _check_bodies(self, skeleton: InlineSkeleton) -> None:
        _refuse_duplicates("body", (body.name for body in skeleton.bodies))
        known = [WORLD]
        for body in skeleton.bodies:
            if body.name == WORLD:
                raise ValueError(f"body {WORLD!r}: expected another name, this one is the world's")
            if body.joint.parent not in known:
                raise ValueError(
                    f"body {body.name}: joint.parent {body.joint.parent!r}: "
                    f"{expected_name(body.joint.parent, known)} (parents stand before children)"
                )
            known.append(body.name)
        for where, name, choices in self._names_of_bodies(skeleton, known):
            if name not in choices:
                raise ValueError(f"{where} {name!r}: {expected_name(name, choices)}")

    def _names_of_bodies(
        self, skeleton: InlineSkeleton, known: list[str]
    ) -> Iterator[tuple[str, str, list[str]]]:
        """Where a body or joint is named, its name, and the names that there are."""
        bodies = known[1:]
        for strut in self.struts:
            yield from ((f"strut {strut.name}: between", end, known) for end in strut.between)
            yield f"strut {strut.name}: carries", strut.carried, bodies
        for k, loop in enumerate(skeleton.loops):
            yield from ((f"loops.{k}: between", end, known) for end in loop.between)
        if self.applied_force_body is not None:
            yield "applied_force_body", self.applied_force_body, bodies
        for name, item in (self.inputs or {}).items():
            ((key, acts_on),) = item.model_dump(include=set(_INPUT_KINDS)).items()
            choices = [f"{body}_joint" for body in bodies] if key == "torque_on" else bodies
            yield f"inputs.{name}: {key}", acts_on, choices

    @property
    def drive(self) -> Mapping[str, ForceInput | TorqueInput | MotionInput]:
        """What drives the bench, by name: its inputs, or the one applied force of a model without.

        The order is that of the input vector of a plant.
        """
        if self.inputs is not None:
            return self.inputs
        lower, upper = self.struts[-1].between
        body = self.applied_force_body or (upper if upper != WORLD else lower)
        return {APPLIED_FORCE: ForceInput(force_on=body)}

    def strut(self, name: str) -> StrutSpec:
        """The strut called `name`.

        Raises:
            ModelError: There is none.
        """
        for strut in self.struts:
            if strut.name == name:
                return strut
        choices = ", ".join(strut.name for strut in self.struts)
        raise ModelError(f"model {self.name}: strut {name!r}: expected one of {choices}")

    def with_effects(self, strut_name: str, effects: Iterable[EffectSpec]) -> "ModelSpec":
        """The same model with `effects` as all the effects of one strut."""
        changed = self.strut(strut_name).model_copy(update={"effects": tuple(effects)})
        struts = tuple(changed if strut.name == strut_name else strut for strut in self.struts)
        return self.model_copy(update={"struts": struts})


def parse_model(text: str, source: str, folder: Path = Path()) -> ModelSpec:
    """Model from YAML text as the guide documents it; its files are looked for in `folder`.

    Raises:
        ModelError: One line that names file, key, value and what was expected.
    """
    spec = validate(ModelSpec, parse_mapping(text, source), source)
    return spec.model_copy(update={"folder": folder})


def model_file(name: str, folder: Path) -> Path:
    """The file of a model: absolute or from a folder on, or the shipped one of that name.

    Raises:
        ModelError: There is neither.
    """
    for path in (folder / name, MODELS / f"{name}.yaml"):
        if path.is_file():
            return path
    choices = ", ".join(shipped_models())
    raise ModelError(f"model {name!r}: expected a file in {folder}, or one of {choices}")


def load_model(path: Path) -> ModelSpec:
    """Model from a YAML file.

    Raises:
        ModelError: One line that names file, key, value and what was expected.
    """
    return parse_model(read_text(path), str(path), path.parent)


def shipped_models() -> list[str]:
    """Names of the models that come with the package."""
    return sorted(path.stem for path in MODELS.glob("*.yaml"))


def load_named_model(name: str, folder: Path, named_by: Path | None = None) -> ModelSpec:
    """Model from its file, absolute or from a folder on, or a shipped one by its name.

    Messages name `named_by`, the file that names the model; None for the user.

    Raises:
        ModelError: One line that names file, key, value and what was expected.
    """
    try:
        path = model_file(name, folder)
    except ModelError as error:
        raise (error if named_by is None else ModelError(f"{named_by}: {error}")) from None
    return load_model(path)


def dump_model(spec: ModelSpec) -> str:
    """YAML text that `parse_model` reads back to an equal value."""
    data = spec.model_dump(mode="json", exclude_none=True)
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True)


def files_of(spec: ModelSpec) -> list[str]:
    """Files that a model needs, from its folder on: skeleton, what that includes, and FMUs.

    Raises:
        FileError: A skeleton file cannot be read.
        ModelError: What it includes is wrong.
    """
    files: list[str] = []
    if isinstance(spec.skeleton, FileSkeleton):
        name = spec.skeleton.file
        included = list_includes(spec.folder / name)
        files += [name, *(str(Path(name).parent / other) for other in included)]
    files += [strut.fmu.file for strut in spec.struts if strut.fmu is not None]
    return list(dict.fromkeys(files))


def copy_files(spec: ModelSpec, folder: Path) -> None:
    """Copy the files that a model needs to where `dump_model`'s text will look for them.

    Raises:
        FileError: A skeleton file cannot be read.
        ModelError: What it includes is wrong.
        OSError: The folder cannot be written.
    """
    for name in files_of(spec):
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        source = spec.folder / name
        if not (target.exists() and target.samefile(source)):
            shutil.copyfile(source, target)


def _refuse_duplicates(what: str, names: Iterable[str]) -> None:
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise ValueError(f"{what} {name!r} occurs {count} times, expected unique names")
