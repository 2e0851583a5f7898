"""Struts on joints: the equations of motion that the integrator advances."""

import math
from collections.abc import Sequence
from typing import Generic

import numpy as np

from dart_model.plant.backend import Backend, Value
from dart_model.plant.geometry import Geometry, Jacobians
from dart_model.plant.integrator import Course, Internal, advance
from dart_model.plant.state import Loaded, PlantState
from dart_model.plant.strut import Strut

_MOST_STEPS = 10_000
"""Steps of one call; one that is so late that it would need more takes longer ones."""


_Configuration = tuple[tuple[tuple[Strut, float, Value, Value], ...], Value]
"""Struts in one configuration, ``height = offset + row @ q`` (strut, offset in m, row of the
Jacobian, generalised force per newton), and the columns of the inputs. The last two differ where a
body is moved: no force changes its motion."""


class EquationsOfMotion(Generic[Value]):
    """Equations of motion of a model, over time."""

    def __init__(
        self, backend: Backend[Value], struts: Sequence[Strut], geometry: Geometry
    ) -> None:
        self._backend = backend
        self._struts = tuple(struts)
        self._no_rates = [0.0] * sum(strut.states for strut in struts)
        self._geometry = geometry
        self._is_free = geometry.is_free
        self._is_moved = not all(geometry.is_free)
        constant = geometry.constant
        self._constant = None if constant is None else self._configuration(constant)
        # The next force is computed where a tick ends: its configuration is computed once.
        self._newest: tuple[tuple[float, ...], _Configuration[Value]] | None = None

    def state(
        self,
        positions: Sequence[float],
        velocities: Sequence[float],
        internal: Internal,
        t_s: float,
    ) -> PlantState:
        """State with given coordinates; arguments as of `PlantState`."""
        value = self._backend.value
        return self._state(value(positions), value(velocities), internal, t_s)

    def load(
        self,
        state: PlantState,
        virtual_forces_n: Sequence[float],
        inputs: Sequence[float],
        temperature_c: float,
    ) -> Loaded:
        """Let forces act on a state."""
        backend, internal, t_s = self._backend, state.internal, state.t_s
        q, v = backend.value(state.positions), backend.value(state.velocities)
        struts, columns = self._constant or self._at(q)
        rates = self._no_rates.copy()
        drive = backend.value(inputs)
        total, applied_force_n = backend.drive(columns, drive), backend.applied_force_n(drive)
        forces: list[float] = []
        for index, (strut, _, _, push) in enumerate(struts):
            height_m, velocity_m_per_s = state.struts[index]
            force = strut.force_n(
                height_m, velocity_m_per_s, internal, t_s, applied_force_n, temperature_c
            )
            if internal:
                strut.write_rates(
                    height_m, velocity_m_per_s, internal, t_s, applied_force_n, temperature_c, rates
                )
            forces.append(force)
            total = total + (force + virtual_forces_n[index]) * push
        acceleration = backend.acceleration(q, v, total)
        accelerations: list[float] = []
        for _, _, row, _ in struts:
            accelerations.append(backend.dot(row, acceleration))
        if self._constant is None:
            q_now, v_now = np.array(state.positions), np.array(state.velocities)
            further = self._geometry.centripetal(q_now, v_now).tolist()
            accelerations = [a + b for a, b in zip(accelerations, further, strict=True)]
        return Loaded(
            state,
            tuple(virtual_forces_n),
            tuple(inputs),
            temperature_c,
            forces,
            accelerations,
            q,
            v,
            drive,
            acceleration,
            rates,
        )

    def slopes(
        self, state: PlantState, inputs: Sequence[float], temperature_c: float
    ) -> Sequence[tuple[float, float]]:
        """Slopes of each strut's law; arguments and result as of `DartPlant.slopes`."""
        applied_force_n = self._backend.applied_force_n(self._backend.value(inputs))
        rest = state.internal, state.t_s, applied_force_n, temperature_c
        return [
            strut.slopes(*motion, *rest)
            for strut, motion in zip(self._struts, state.struts, strict=True)
        ]

    def step(
        self, loaded: Loaded, dt_s: float, inputs_end: Sequence[float], longest_s: float
    ) -> PlantState:
        """Advance in steps of at most `longest_s`; other arguments as of `DartPlant.step`."""
        backend, state, constant = self._backend, loaded.state, self._constant
        virtual_forces_n, temperature_c = loaded.virtual_forces_n, loaded.temperature_c
        dot, acceleration, no_rates = backend.dot, backend.acceleration, self._no_rates
        drive, put_moved, applied = backend.drive, backend.put_moved, backend.applied_force_n
        begin, end = loaded.drive, backend.value(inputs_end)
        rise = end - begin
        is_moved = self._is_moved
        write_motions = backend.motions_between(begin, end, dt_s) if is_moved else None

        def slope(
            q: Value, v: Value, internal: Internal, t_s: float, share: float
        ) -> tuple[Value, Sequence[float]]:
            inputs = begin + share * rise
            if is_moved:
                if write_motions:
                    write_motions(inputs, share)
                put_moved(q, v, inputs)
            struts, columns = constant or self._at(q)
            rates = no_rates.copy()
            total, applied_force_n = drive(columns, inputs), applied(inputs)
            for index, (strut, offset_m, row, push) in enumerate(struts):
                height_m, velocity_m_per_s = offset_m + dot(row, q), dot(row, v)
                force = strut.force_n(
                    height_m, velocity_m_per_s, internal, t_s, applied_force_n, temperature_c
                )
                if internal:
                    strut.write_rates(
                        height_m, velocity_m_per_s, internal, t_s, applied_force_n, temperature_c,
                        rates,
                    )  # fmt: skip
                total = total + (force + virtual_forces_n[index]) * push
            return acceleration(q, v, total), rates

        q, v, internal = advance(
            slope,
            backend.move,
            (loaded.position, loaded.velocity, state.internal),
            (loaded.acceleration, loaded.internal_rates),
            Course(state.t_s, dt_s, count_steps(dt_s, longest_s)),
        )
        if is_moved:
            put_moved(q, v, end)
        q, v = backend.closed(q, v)
        return self._state(q, v, internal, state.t_s + dt_s)

    def _state(self, q: Value, v: Value, internal: Internal, t_s: float) -> PlantState:
        backend, dot = self._backend, self._backend.dot
        struts, _ = self._constant or self._at(q)
        motions: list[tuple[float, float]] = []
        for _, offset_m, row, _ in struts:
            motions.append((offset_m + dot(row, q), dot(row, v)))
        return PlantState(backend.numbers(q), backend.numbers(v), internal, t_s, motions)

    def _at(self, q: Value) -> _Configuration[Value]:
        numbers = self._backend.numbers(q)
        if self._newest is None or self._newest[0] != numbers:
            self._newest = numbers, self._configuration(self._geometry.at(np.array(numbers)))
        return self._newest[1]

    def _configuration(self, jacobians: Jacobians) -> _Configuration[Value]:
        value = self._backend.value
        columns = self._struts, jacobians.offsets_m.tolist(), jacobians.struts
        rows = (
            (strut, offset_m, value(row.tolist()), value((row * self._is_free).tolist()))
            for strut, offset_m, row in zip(*columns, strict=True)
        )
        return tuple(rows), self._backend.columns(jacobians.inputs)


def count_steps(dt_s: float, longest_s: float) -> int:
    """Number of equal steps of at most `longest_s`."""
    if dt_s <= longest_s * (1.0 + 1e-9):  # a tick of one step must not become two by rounding
        return 1
    return min(math.ceil(dt_s / longest_s), _MOST_STEPS)
