"""Benches that are more than a body on a straight guide, each with its own equations of motion."""

import math

import numpy as np

from dart_model.spec import load_model
from rig.recordings.recording import Recording
from tests.diagnosis.driven import driven_by
from tests.diagnosis.integrator import integrated, measured

GRAVITY = 9.81


def lines_n(scale, frequencies_hz, shift=0.0):
    """Load (N) of a time: lines whose amplitude falls with the frequency."""

    def load_n(t):
        total = 0.0
        for k, frequency in enumerate(frequencies_hz):
            omega = 2.0 * math.pi * frequency
            total += scale / (1.0 + 0.35 * k) * math.sin(omega * (t + shift) + 1.1 * k * k)
        return total

    return load_n


def recording(name, t_s, heights_m, load_n, seed):
    """Heights noisy by 10 µm and rounded to 2 µm."""
    applied_n = np.array([load_n(t) for t in t_s.tolist()])
    return Recording(name, t_s, measured(heights_m, 1e-5, 2e-6, seed), driven_by(applied_n))


class TrailingArm:
    """An arm on a hinge, its hub at the free end, a strut from the ground to the arm.

    The angle is positive where the hub is above the hinge. The force acts upwards on the hub. The
    strut's length follows from the law of cosines.
    """

    hinge_m = (0.1, 0.0, 0.6)
    hub_m = 0.45
    attachment_m = 0.32
    foot_m = (0.4, 0.0, 0.3)
    arm_kg, arm_centre_m, arm_kg_m2 = 6.0, 0.22, 0.12
    hub_kg, hub_kg_m2 = 5.0, 0.02
    free_m, stiffness, damping = 0.319, 6000.0, 120.0
    fine = 8
    load_n = staticmethod(lines_n(55.0, (0.35, 0.93, 1.71, 2.63, 3.4, 4.7, 6.3)))
    later_n = staticmethod(lines_n(50.0, (0.41, 1.07, 1.63, 2.44, 3.7, 4.3, 5.9), 13.0))

    urdf = f"""<?xml version="1.0"?>
<robot name="trailing_arm">
  <link name="ground"/>
  <link name="arm">
    <inertial><origin xyz="{arm_centre_m} 0 0"/><mass value="{arm_kg}"/>
      <inertia ixx="0.01" ixy="0" ixz="0" iyy="{arm_kg_m2}" iyz="0" izz="0.12"/></inertial>
  </link>
  <link name="hub">
    <inertial><origin xyz="0 0 0"/><mass value="{hub_kg}"/>
      <inertia ixx="0.02" ixy="0" ixz="0" iyy="{hub_kg_m2}" iyz="0" izz="0.02"/></inertial>
  </link>
  <joint name="hinge" type="revolute">
    <origin xyz="{hinge_m[0]} {hinge_m[1]} {hinge_m[2]}"/>
    <parent link="ground"/><child link="arm"/><axis xyz="0 -1 0"/>
    <limit lower="-1.5" upper="1.5" effort="100000" velocity="1000"/>
  </joint>
  <joint name="weld" type="fixed">
    <origin xyz="{hub_m} 0 0"/><parent link="arm"/><child link="hub"/>
  </joint>
</robot>
"""
    yaml = f"""
name: trailing_arm
gravity_m_per_s2: {GRAVITY}
skeleton: {{file: trailing_arm.urdf}}
applied_force_body: hub
struts:
  - name: strut
    between: [world, arm]
    attachments_m: [[{foot_m[0]}, {foot_m[1]}, {foot_m[2]}], [{attachment_m}, 0.0, 0.0]]
    free_length_m: {free_m}
    stiffness_n_per_m: {stiffness}
    damping_n_s_per_m: {damping}
"""

    def model(self, folder):
        (folder / "trailing_arm.urdf").write_text(self.urdf, "utf-8")
        (folder / "trailing_arm.yaml").write_text(self.yaml, "utf-8")
        return load_model(folder / "trailing_arm.yaml")

    def stop_n(self, height, velocity):
        """What the model lacks."""
        return 0.0

    def length(self, angle):
        """Length of the strut and its derivative by the angle."""
        along, up = (self.foot_m[i] - self.hinge_m[i] for i in (0, 2))
        reach, foot = self.attachment_m, math.hypot(along, up)
        between = angle - math.atan2(up, along)
        length = math.sqrt(reach**2 + foot**2 - 2.0 * reach * foot * math.cos(between))
        return length, reach * foot * math.sin(between) / length

    def moment_n_m(self, angle, rate, applied_n):
        height, slope = self.length(angle)
        velocity = slope * rate
        strut_n = -self.stiffness * (height - self.free_m) - self.damping * velocity
        strut_n += self.stop_n(height, velocity)
        weight = GRAVITY * (self.arm_kg * self.arm_centre_m + self.hub_kg * self.hub_m)
        return strut_n * slope + (self.hub_m * applied_n - weight) * math.cos(angle)

    def heights(self, duration_s=10.0, rate_hz=250, load_n=None):
        """Times and true lengths of the strut, from rest."""
        load_n = load_n or self.load_n
        inertia = self.arm_kg_m2 + self.arm_kg * self.arm_centre_m**2
        inertia += self.hub_kg_m2 + self.hub_kg * self.hub_m**2

        def derivative(t, x):
            return [x[1], self.moment_n_m(x[0], x[1], load_n(t)) / inertia]

        low, high = -0.5, 0.5
        for _ in range(60):  # rest by bisection
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.moment_n_m(middle, 0, 0) > 0 else (low, middle)
        samples = round(duration_s * rate_hz) + 1
        angles = integrated(derivative, [low, 0.0], samples, 1.0 / rate_hz, self.fine)[:, 0]
        lengths = [[self.length(angle)[0]] for angle in angles.tolist()]
        return np.arange(samples) / rate_hz, np.array(lengths)

    def recording(self, seed=1, load_n=None, **kwargs):
        load_n = load_n or self.load_n
        t_s, heights_m = self.heights(load_n=load_n, **kwargs)
        return recording(f"arm{seed}", t_s, heights_m, load_n, seed)


class ArmWithStop(TrailingArm):
    contact_m, stop_n_per_m, stop_n_s_per_m = 0.283, 6e4, 40.0
    fine = 40

    def stop_n(self, height, velocity):
        depth = self.contact_m - height
        push = self.stop_n_per_m * depth - self.stop_n_s_per_m * velocity
        return max(0.0, push) if depth > 0.0 else 0.0


class QuarterCar:
    """Wheel and body on a straight guide; the force acts upwards on the body.

    Heights are the wheel's above the ground and the body's above the wheel.
    """

    wheel_kg, body_kg = 3.0, 15.0
    tyre_free_m, tyre, tyre_damping = 0.3, 20000.0, 130.0
    free_m, stiffness, damping = 0.5, 800.0, 120.0
    friction_n = 0.0
    load_n = staticmethod(lines_n(30.0, (0.37, 0.9, 1.6, 2.5, 3.7, 5.2, 7.1)))
    later_n = staticmethod(lines_n(28.0, (0.43, 1.0, 1.5, 2.7, 3.5, 5.5, 6.7), 17.0))

    def heights(self, duration_s=10.0, rate_hz=500, load_n=None):
        """Times and true heights, shape (N, 2), from rest."""
        load_n = load_n or self.load_n

        def derivative(t, x):
            wheel, rise, wheel_v, body_v = x  # absolute, but for the body above the wheel
            v = body_v - wheel_v
            of_tyre = -self.tyre * (wheel - self.tyre_free_m) - self.tyre_damping * wheel_v
            strut = -self.stiffness * (rise - self.free_m) - self.damping * v
            strut -= self.friction_n * math.tanh(v / 5e-3)
            return [
                wheel_v,
                v,
                (of_tyre - strut) / self.wheel_kg - GRAVITY,
                (strut + load_n(t)) / self.body_kg - GRAVITY,
            ]

        wheel = self.tyre_free_m - (self.wheel_kg + self.body_kg) * GRAVITY / self.tyre
        rise = self.free_m - self.body_kg * GRAVITY / self.stiffness
        samples = round(duration_s * rate_hz) + 1
        found = integrated(derivative, [wheel, rise, 0.0, 0.0], samples, 1.0 / rate_hz, 8)
        return np.arange(samples) / rate_hz, found[:, :2]

    def csv(self, path, seed=1, load_n=None, **kwargs):
        """Write the file of a recording, its columns in an order of its own."""
        load_n = load_n or self.load_n
        t_s, heights_m = self.heights(load_n=load_n, **kwargs)
        measured_m = recording(path.name, t_s, heights_m, load_n, seed)
        rows = ["applied_force_n,height_m:suspension,t_s,height_m:tyre"]
        for t, force, (tyre, suspension) in zip(
            t_s.tolist(),
            measured_m.applied_force_n.tolist(),
            measured_m.heights_m.tolist(),
            strict=True,
        ):
            rows.append(f"{force!r},{suspension:.6f},{t!r},{tyre:.6f}")
        path.write_text("\n".join(rows) + "\n", "utf-8")
        return path


class QuarterCarWithFriction(QuarterCar):
    friction_n = 12.0


class SprungGuide:
    """A body on a guide that has a spring and a damper of its own, beside the strut's."""

    mass, stiffness, damping, free_m = 10.0, 1500.0, 40.0, 0.4
    own_damping = 45.0
    load_n = staticmethod(lines_n(30.0, (0.4, 1.1, 1.9, 2.8, 4.1, 5.6)))
    later_n = staticmethod(lines_n(25.0, (0.5, 1.0, 2.1, 2.6, 4.4, 5.9), 7.0))

    def __init__(self, suffix):
        self.suffix = suffix
        # A URDF joint has no spring.
        self.own_stiffness = 600.0 if suffix == "skel" else 0.0

    @property
    def skeleton(self):
        if self.suffix == "urdf":
            return f"""<?xml version="1.0"?>
<robot name="guide">
  <link name="base"/>
  <link name="body"><inertial><origin xyz="0 0 0"/><mass value="{self.mass}"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <joint name="guide" type="prismatic">
    <parent link="base"/><child link="body"/><axis xyz="0 0 1"/>
    <dynamics damping="{self.own_damping}"/>
    <limit lower="-10" upper="10" effort="100000" velocity="1000"/>
  </joint>
</robot>
"""
        return f"""<?xml version="1.0"?>
<skel version="1.0">
  <world name="world">
    <physics><time_step>0.001</time_step><gravity>0 0 -9.81</gravity></physics>
    <skeleton name="bench">
      <body name="body">
        <transformation>0 0 0 0 0 0</transformation>
        <inertia><mass>{self.mass}</mass><offset>0 0 0</offset></inertia>
      </body>
      <joint type="prismatic" name="guide">
        <parent>world</parent><child>body</child>
        <axis><xyz>0 0 1</xyz><dynamics><damping>{self.own_damping}</damping>
          <spring_stiffness>{self.own_stiffness}</spring_stiffness></dynamics></axis>
      </joint>
    </skeleton>
  </world>
</skel>
"""

    def model(self, folder):
        (folder / f"guide.{self.suffix}").write_text(self.skeleton, "utf-8")
        (folder / "guide.yaml").write_text(
            f"""
name: guide
gravity_m_per_s2: {GRAVITY}
skeleton: {{file: guide.{self.suffix}}}
struts:
  - name: strut
    between: [world, body]
    free_length_m: {self.free_m}
    stiffness_n_per_m: {self.stiffness}
    damping_n_s_per_m: {self.damping}
""",
            "utf-8",
        )
        return load_model(folder / "guide.yaml")

    def heights(self, duration_s=10.0, rate_hz=250, load_n=None):
        """Times and true heights, from rest."""
        load_n = load_n or self.load_n
        stiffness = self.stiffness + self.own_stiffness
        damping = self.damping + self.own_damping
        rest = (self.stiffness * self.free_m - self.mass * GRAVITY) / stiffness

        def derivative(t, x):
            return [x[1], (load_n(t) - stiffness * (x[0] - rest) - damping * x[1]) / self.mass]

        samples = round(duration_s * rate_hz) + 1
        found = integrated(derivative, [rest, 0.0], samples, 1.0 / rate_hz, 8)
        return np.arange(samples) / rate_hz, found[:, :1]

    def recording(self, seed=1, load_n=None, **kwargs):
        load_n = load_n or self.load_n
        t_s, heights_m = self.heights(load_n=load_n, **kwargs)
        return recording(f"guide{seed}", t_s, heights_m, load_n, seed)
