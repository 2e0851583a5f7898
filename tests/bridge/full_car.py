"""A full car: its model as a URDF file, and its bench by Lagrange's equations."""

import math
from typing import ClassVar

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

from dart_model.spec import load_model

GRAVITY = 9.81


class FullCar:
    """A body that heaves, pitches and rolls on four wheels, as a URDF file."""

    corners: ClassVar = {"fl": (1.3, 0.7), "fr": (1.3, -0.7), "rl": (-1.4, 0.7), "rr": (-1.4, -0.7)}
    body_kg, pitch_kg_m2, roll_kg_m2, wheel_kg = 1200.0, 1500.0, 500.0, 40.0
    stiffness: ClassVar = {"fl": 22e3, "fr": 22e3, "rl": 26e3, "rr": 30e3}
    damping: ClassVar = {"fl": 1500.0, "fr": 1500.0, "rl": 1700.0, "rr": 1900.0}
    tyre, tyre_damping, tyre_free_m, free_m = 200e3, 300.0, 0.35, 0.45

    cubic_n_per_m3: ClassVar = {"fl": 9e5, "fr": 9e5, "rl": 11e5, "rr": 12e5}
    yaw_kg_m2, body_m, wheel_m = 1800.0, 0.66, 0.33

    def urdf(self):
        def link(name, mass_kg, xx, yy, zz):
            return (
                f'<link name="{name}"><inertial><mass value="{mass_kg}"/><inertia ixx="{xx}" '
                f'iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            )

        links = [
            link("heaving", 1e-6, 1e-9, 1e-9, 1e-9),
            link("pitching", 1e-6, 1e-9, 1e-9, 1e-9),
            link("body", self.body_kg, self.roll_kg_m2, self.pitch_kg_m2, self.yaw_kg_m2),
            *(link(name, self.wheel_kg, 1.0, 1.0, 1.0) for name in self.corners),
        ]
        joints = [
            ("heave", "prismatic", "ground", "heaving", "0 0 1", "0 0 0.66"),
            ("pitch", "revolute", "heaving", "pitching", "0 1 0", "0 0 0"),
            ("roll", "revolute", "pitching", "body", "1 0 0", "0 0 0"),
            *(
                (f"of_{name}", "prismatic", "ground", name, "0 0 1", f"{x} {y} 0.33")
                for name, (x, y) in self.corners.items()
            ),
        ]
        texts = [
            f'<joint name="{name}" type="{kind}"><origin xyz="{origin}"/>'
            f'<parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
            f'<limit lower="-10" upper="10" effort="1e9" velocity="1e4"/></joint>'
            for name, kind, parent, child, axis, origin in joints
        ]
        head = '<?xml version="1.0"?>\n<robot name="full_car">\n<link name="ground"/>'
        return "\n".join([head, *links, *texts, "</robot>"])

    def model(self, folder, corrected=()):
        """The car with linear suspensions, and with the bench's at the `corrected` corners."""
        (folder / "full_car.urdf").write_text(self.urdf())
        lines = [
            "name: full_car",
            "gravity_m_per_s2: 9.81",
            "skeleton: {file: full_car.urdf}",
            "applied_force_body: body",
            "struts:",
        ]
        for name, (x, y) in self.corners.items():
            lines += [
                f"  - name: tyre_{name}",
                f"    between: [world, {name}]",
                f"    attachments_m: [[{x}, {y}, 0], [0, 0, 0]]",
                f"    free_length_m: {self.tyre_free_m}",
                f"    stiffness_n_per_m: {self.tyre}",
                f"    damping_n_s_per_m: {self.tyre_damping}",
            ]
        for name, (x, y) in self.corners.items():
            lines += [
                f"  - name: suspension_{name}",
                f"    between: [{name}, body]",
                f"    attachments_m: [[0, 0, 0], [{x}, {y}, 0]]",
                f"    free_length_m: {self.free_m}",
                f"    stiffness_n_per_m: {self.stiffness[name]}",
                f"    damping_n_s_per_m: {self.damping[name]}",
            ]
            if name in corrected:
                lines += self.effect(name)
        (folder / "full_car.yaml").write_text("\n".join(lines) + "\n")
        return load_model(folder / "full_car.yaml")

    def effect(self, name):
        """The bench's spring beside the linear one, in a model file."""
        cubic = self.cubic_n_per_m3[name]
        return [
            f"    effects: [{{name: cubic_stiffness, parameters: {{stiffness_n_per_m3: {cubic}}}}}]"
        ]

    @staticmethod
    def load_n(t):
        """Applied force at the body's centre; it swells, so that the bench starts at rest."""
        tones = ((1.0, 0.9), (0.8, 2.3), (0.5, 4.7))
        return 1500.0 * min(t, 1.0) * sum(a * math.sin(2.0 * math.pi * f * t) for a, f in tones)

    def _places(self, q):
        """Heights of tyres and suspensions, and the latter's slopes by the coordinates, (4, 7)."""
        (x, y), (rise, pitch, roll) = np.array(list(self.corners.values())).T, q[:3]
        sp, cp, sr, cr = np.sin(pitch), np.cos(pitch), np.sin(roll), np.cos(roll)
        above = np.stack(
            [x * cp + y * sr * sp - x, y * cr - y, self.body_m + rise - x * sp + y * sr * cp], 1
        )
        wheels = self.wheel_m + q[3:]
        above[:, 2] -= wheels
        by_pitch = np.stack([-x * sp + y * sr * cp, 0.0 * y, -x * cp - y * sr * sp], 1)
        by_roll = np.stack([y * cr * sp, -y * sr, y * cr * cp], 1)
        lengths = np.linalg.norm(above, axis=1)
        along = above / lengths[:, None]
        slopes = np.zeros((4, 7))
        slopes[:, 0] = along[:, 2]
        slopes[:, 1], slopes[:, 2] = np.sum(along * by_pitch, 1), np.sum(along * by_roll, 1)
        slopes[np.arange(4), 3 + np.arange(4)] = -along[:, 2]
        return wheels, lengths, slopes

    def _forces(self, q, v):
        """Forces of tyres and suspensions, and the latter's slopes."""
        wheels, lengths, slopes = self._places(q)
        z, rates = lengths - self.free_m, slopes @ v
        stiffness, damping, cubic = (
            np.array(list(of.values()))
            for of in (self.stiffness, self.damping, self.cubic_n_per_m3)
        )
        tyres_n = -self.tyre * (wheels - self.tyre_free_m) - self.tyre_damping * v[3:]
        return tyres_n, -stiffness * z - cubic * z**3 - damping * rates, slopes

    def _rates(self, t, x):
        """Lagrange's equations of a body that heaves, then pitches, then rolls, and four wheels."""
        q, v = x[:7], x[7:]
        tyres_n, suspensions_n, slopes = self._forces(q, v)
        force = slopes.T @ suspensions_n
        force[3:] += tyres_n - self.wheel_kg * GRAVITY
        force[0] += (self.load_n(t) if t >= 0.0 else 0.0) - self.body_kg * GRAVITY
        sine, cosine = math.sin(q[2]), math.cos(q[2])
        twist = (self.yaw_kg_m2 - self.pitch_kg_m2) * sine * cosine
        pitching = self.pitch_kg_m2 * cosine**2 + self.yaw_kg_m2 * sine**2
        a = np.empty(7)
        a[0] = force[0] / self.body_kg
        a[1] = (force[1] - 2.0 * v[1] * v[2] * twist) / pitching
        a[2] = (force[2] + v[1] ** 2 * twist) / self.roll_kg_m2
        a[3:] = force[3:] / self.wheel_kg
        return np.concatenate([v, a])

    def run(self, t_s):
        """Heights, rates and forces at times, (N, 8) each, tyres first, from rest."""
        still = np.zeros(7)
        rest = fsolve(lambda q: self._rates(-1.0, np.concatenate([q, still]))[7:], still - 0.02)
        found = solve_ivp(
            self._rates,
            (0.0, t_s[-1]),
            np.concatenate([rest, still]),
            method="DOP853",
            t_eval=t_s,
            rtol=1e-9,
            atol=1e-11,
        )
        heights, rates, forces = [], [], []
        for x in found.y.T:
            q, v = x[:7], x[7:]
            wheels, lengths, slopes = self._places(q)
            tyres_n, suspensions_n, _ = self._forces(q, v)
            heights.append([*wheels, *lengths])
            rates.append([*v[3:], *(slopes @ v)])
            forces.append([*tyres_n, *suspensions_n])
        return np.array(heights), np.array(rates), np.array(forces)
