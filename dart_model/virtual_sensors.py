"""Variables of a model that no sensor measures, as a configuration names them.

Every variable of a model that follows its bench is an estimate of what cannot be measured: the load
under a tyre, the acceleration at a seat, the force in a joint.
"""

from types import MappingProxyType
from typing import Annotated, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, model_validator

from can_dbc.units import Dimension
from dart_model.spec import Axis, Vector


class SensedQuantity(NamedTuple):
    """What a virtual sensor reads.

    Attributes:
        of: What it is of: ``body``, ``joint`` or ``strut``.
        dimension: What it measures, in SI.
        suffix: End of its column in the log: the quantity and its unit.
        meaning: For the guide.
        known_by: What its standard deviation follows from: the ``force`` of the struts, which
            changes it at once, or the ``height`` or the ``rate`` of those whose height is measured;
            empty where it has none.
    """

    of: str
    dimension: Dimension
    suffix: str
    meaning: str
    known_by: Literal["", "force", "height", "rate"] = ""


KINDS = MappingProxyType({
    "position_of": SensedQuantity(
        "body",
        Dimension.LENGTH,
        "position_m",
        "position of a point of a body along an axis",
        known_by="height",
    ),
    "velocity_of": SensedQuantity(
        "body",
        Dimension.VELOCITY,
        "velocity_m_per_s",
        "velocity of such a point",
        known_by="rate",
    ),
    "acceleration_of": SensedQuantity(
        "body",
        Dimension.ACCELERATION,
        "acceleration_m_per_s2",
        "acceleration of such a point; an accelerometer there shows gravity in addition",
        known_by="force",
    ),
    "angle_of": SensedQuantity(
        "body",
        Dimension.ANGLE,
        "angle_rad",
        "angle by which a body is turned about an axis",
        known_by="height",
    ),
    "rate_of": SensedQuantity(
        "body",
        Dimension.ANGULAR_VELOCITY,
        "rate_rad_per_s",
        "angular velocity of a body about an axis",
        known_by="rate",
    ),
    "coordinate_of": SensedQuantity(
        "joint",
        Dimension.LENGTH,
        "coordinate_m",
        "coordinate of a joint with one: in m, or in rad of one that turns",
        known_by="height",
    ),
    "speed_of": SensedQuantity(
        "joint",
        Dimension.VELOCITY,
        "speed_m_per_s",
        "rate of such a coordinate",
        known_by="rate",
    ),
    "reaction_of": SensedQuantity(
        "joint",
        Dimension.FORCE,
        "reaction_n",
        "force along an axis that a joint exerts on its child body",
        known_by="force",
    ),
    "torque_of": SensedQuantity(
        "joint",
        Dimension.TORQUE,
        "torque_n_m",
        "torque about an axis through the joint that it exerts on its child body",
        known_by="force",
    ),
    "force_of": SensedQuantity(
        "strut",
        Dimension.FORCE,
        "force_n",
        "force of a strut, as it is published of it",
        known_by="force",
    ),
    "power_of": SensedQuantity(
        "strut",
        Dimension.POWER,
        "power_w",
        "power that a strut takes from its bodies",
        known_by="force",
    ),
    "energy_of": SensedQuantity(
        "strut",
        Dimension.ENERGY,
        "energy_j",
        "energy that a strut has taken since the estimate began: what it dissipated and stores",
    ),
})  # fmt: skip
"""Keys of a virtual sensor, of which each has one."""

_TURNING = {
    "coordinate_of": SensedQuantity("joint", Dimension.ANGLE, "coordinate_rad", "", "height"),
    "speed_of": SensedQuantity("joint", Dimension.ANGULAR_VELOCITY, "speed_rad_per_s", "", "rate"),
}
"""The same of a joint that turns."""

QUANTITIES = MappingProxyType({it.suffix: it for it in (*KINDS.values(), *_TURNING.values())})
"""What the columns of virtual sensors hold, by the ends of their names."""

_UPWARDS = (0.0, 0.0, 1.0)

Target = Annotated[str, Field(min_length=1, max_length=64)]


class VirtualSensor(BaseModel):
    """A variable of the model.

    Attributes:
        position_of: Body of whose point the position along `axis` is read, in m.
        velocity_of: Body of whose point the velocity along `axis` is read, in m/s.
        acceleration_of: Body of whose point the acceleration along `axis` is read, in m/s².
        angle_of: Body whose angle about `axis` is read, in rad.
        rate_of: Body whose angular velocity about `axis` is read, in rad/s.
        coordinate_of: Joint whose coordinate is read, in m or rad.
        speed_of: Joint whose coordinate's rate is read, in m/s or rad/s.
        reaction_of: Joint whose force on its child body along `axis` is read, in N.
        torque_of: Joint whose torque on its child body about `axis` is read, in N·m.
        force_of: Strut whose force is read, in N.
        power_of: Strut whose power is read, in W: what it takes from its bodies.
        energy_of: Strut whose energy is read, in J: that power since the estimate began.
        at: Point in the frame of the body, in m.
        axis: Direction in the world's frame, of any length.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    position_of: Target | None = None
    velocity_of: Target | None = None
    acceleration_of: Target | None = None
    angle_of: Target | None = None
    rate_of: Target | None = None
    coordinate_of: Target | None = None
    speed_of: Target | None = None
    reaction_of: Target | None = None
    torque_of: Target | None = None
    force_of: Target | None = None
    power_of: Target | None = None
    energy_of: Target | None = None
    at: Vector = (0.0, 0.0, 0.0)
    axis: Axis = _UPWARDS

    @model_validator(mode="after")
    def _has_one_kind(self) -> "VirtualSensor":
        given = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(given) != 1:
            found = f"{' and '.join(given)} are given" if given else "none is given"
            raise ValueError(f"{found}, expected one of {', '.join(KINDS)}")
        allowed = {"position_of", "velocity_of", "acceleration_of"}
        if given[0] not in allowed and any(self.at):
            raise ValueError(f"at: expected with {', '.join(sorted(allowed))} alone")
        if KINDS[given[0]].of == "strut" and self.axis != _UPWARDS:
            raise ValueError(f"axis: expected none with {given[0]}")
        return self

    @property
    def kind(self) -> str:
        """Its key of `KINDS`."""
        return next(kind for kind in KINDS if getattr(self, kind) is not None)

    @property
    def target(self) -> str:
        """Name of the body, joint or strut."""
        return getattr(self, self.kind)

    def quantity(self, *, is_turning: bool) -> SensedQuantity:
        """What it reads; of a joint that turns in rad."""
        return _TURNING.get(self.kind, KINDS[self.kind]) if is_turning else KINDS[self.kind]
