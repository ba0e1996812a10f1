"""A machine to test the gap workflow on: servos and a finger in NumPy, with effects hidden in them.

It shares nothing with the fitted model but the meaning of the names: other equations of motion (a
finger in closed form), another integrator (leapfrog, linearly implicit), another treatment of
friction (stick and slip as a complementarity), float64, and a step several times finer. All
trajectories, of several plants too, advance together, one array operation for all.

Effects: those of :data:`vd.kernels.servo.effects.EFFECTS`, and :data:`OUTSIDE` the table. SI units,
radians.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.signal import lfilter

from vd.gap.bench.hidden_finger import Finger, slip

STEP_S = 4.0e-4
"""Time step [s]: five times finer than the fitted model's, second order where the motion is
smooth.
"""
PARTS = 8
"""Parts of a step in which the reference is kept: a motor at its limit must not act before the
command arrives, nor a profile stop late."""
EQUILIBRIUM_SWEEPS = 60
"""Fixed-point sweeps for the droop under gravity at the start; each gains a digit or more."""
CABLE = "cable_spring"
COGGING = "cogging"
WARMING = "temperature_friction"

OUTSIDE: dict[str, dict[str, float]] = {
    COGGING: {"amplitude_nm": 0.05, "per_turn": 24.0},
    CABLE: {"k_nm_rad": 0.5, "slack_rad": 0.2},
    WARMING: {"cold_nm": 0.12, "warm_nm": 0.03, "time_s": 60.0},
}
"""Effects that are not in the table, with typical sizes: torque ripple amplitude sin(n q); a cable
that pulls back once its slack is used up; friction that falls as the joint warms over the
session.
"""


@dataclass(frozen=True)
class Physics:
    """How a plant obeys the same laws otherwise than the one that the analysis was tuned on (the default).

    Attributes:
        step_s: Time step [s].
        presliding_rad: Travel over which dry friction builds up, as the teeth of a gear bend [rad];
            0: none.
        noise_s: Correlation time of the reading's noise [s]; 0: white.
        ripple_nm: Amplitude of a torque that the gears of every joint add [N m].
        ripple_per_turn: Its periods in a radian of travel.
    """

    step_s: float = STEP_S
    presliding_rad: float = 0.0
    noise_s: float = 0.0
    ripple_nm: float = 0.0
    ripple_per_turn: float = 0.0


TUNED = Physics()
"""The plant that the rules of the search were tuned on."""


@dataclass(frozen=True, eq=False)
class HiddenPlant:
    """One machine; arrays have one entry per joint [J].

    Attributes:
        joints: Names.
        kp: Stiffness at full P gain [N m/rad].
        kd: Damping [N m s/rad].
        velocity_limit: Largest speed [rad/s].
        inertia: Inertia about each axis that is no link's: rotor, or the whole load [kg m^2].
        gravity_torque: Gravity load -g sin(q) of a pendulum [N m].
        body: Of a finger, MuJoCo's model with a payload [kg] at its tip; None for joints on their
            own.
        effects: Name to parameter to values [J].
        full_gain: P gain, as recordings name it, at which ``kp`` holds.
        effort: Largest torque of the drives [N m]; None: no limit.
        physics: How it obeys its laws.
    """

    joints: tuple[str, ...]
    kp: np.ndarray
    kd: np.ndarray
    velocity_limit: np.ndarray
    inertia: np.ndarray
    gravity_torque: np.ndarray
    body: Callable[[float], Any] | None = None
    effects: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    full_gain: float = 1.0
    effort: np.ndarray | None = None
    physics: Physics = TUNED


@dataclass(frozen=True, eq=False)
class PlantRun:
    """One trajectory to simulate on a plant.

    Attributes:
        plant: The machine.
        time: Stamps of commands and readings [T] [s].
        command: Commands [T, J] [rad].
        enabled: Torque on [T, J].
        conditions: ``p_gain`` and ``payload_kg`` act.
        session_s: Time since the machine was switched on, at the start [s].
        seed: Of the jitter of the commands.
    """

    plant: HiddenPlant
    time: np.ndarray
    command: np.ndarray
    enabled: np.ndarray
    conditions: Mapping[str, Any] = field(default_factory=dict)
    session_s: float = 0.0
    seed: int = 0


def simulate(runs: Sequence[PlantRun], *, dt: float | None = None) -> list[np.ndarray]:
    """Simulate runs together.

    Args:
        runs: Trajectories; all plants have the same number of joints, and all have a finger or
            none.
        dt: Time step [s]; that of the first plant by default.

    Returns:
        What an ideal sensor would record at the stamps of each run [T, J] [rad].

    Raises:
        ValueError: An effect is too stiff for the time step.
    """
    dt = runs[0].plant.physics.step_s if dt is None else dt
    batch = _Batch(runs, dt)
    path = batch.integrate(batch.references())
    grid = np.arange(path.shape[0]) * dt
    delay = batch.of("read_delay", "delay_s")
    bias = batch.of("encoder_bias", "bias_rad")
    recorded = []
    for b, run in enumerate(runs):
        position = np.empty((len(run.time), batch.count))
        for j in range(batch.count):
            position[:, j] = np.interp(run.time - delay[b, j], grid, path[:, b, j])
        recorded.append(position + bias[b])
    return recorded


def stacked(things: Sequence[Any], name: str) -> np.ndarray:
    """An attribute of each [B, ..]."""
    return np.stack([getattr(thing, name) for thing in things])


class _Batch:
    """Runs as arrays [B, J], and their integration."""

    def __init__(self, runs: Sequence[PlantRun], dt: float):
        self.runs = runs
        self.dt = dt
        self.plants = [run.plant for run in runs]
        self.count = len(self.plants[0].joints)
        self.steps = int(np.ceil(max(run.time[-1] for run in runs) / dt)) + 1
        self.kp = stacked(self.plants, "kp")
        self.kd = stacked(self.plants, "kd")
        self.limit = stacked(self.plants, "velocity_limit")
        self.pendulum = stacked(self.plants, "gravity_torque")
        inertia = stacked(self.plants, "inertia")
        self.inertia = inertia + self.of("payload_inertia", "j_kgm2")
        self.gain = np.ones_like(self.kp)
        bodies = []
        for row, run in zip(self.gain, runs, strict=True):
            full = run.plant.full_gain
            row *= float(run.conditions.get("p_gain", full)) / full
            if run.plant.body:
                bodies.append(run.plant.body(float(run.conditions.get("payload_kg", 0.0))))
        self.body = Finger(bodies) if bodies else None

    def of(self, effect: str, parameter: str) -> np.ndarray:
        """A parameter of an effect for every run and joint [B, J]; 0 where the effect is absent."""
        values = np.zeros((len(self.plants), self.count))
        for row, plant in zip(values, self.plants, strict=True):
            row[:] = plant.effects.get(effect, {}).get(parameter, 0.0)
        return values

    def references(self) -> np.ndarray:
        """What the servos pull to, before the joint has a say.

        The command's path [K, PARTS, B, J] [rad].
        """
        dt = self.dt / PARTS
        edges = np.arange(self.steps * PARTS + 1) * dt
        delay = self.of("command_delay", "delay_s")
        sigma = self.of("command_jitter", "sigma_s")
        drop = self.of("command_jitter", "p_drop")
        tau = self.of("command_filter", "tau_s")
        result = np.empty((self.steps * PARTS, len(self.runs), self.count))
        for b, run in enumerate(self.runs):
            rng = np.random.default_rng(run.seed)
            for j in range(self.count):
                arrival, command = _arrivals(
                    run.time, run.command[:, j], sigma[b, j], drop[b, j], rng
                )
                # The mean of the held command over each step, so that a delay need not be whole
                # steps.
                held = _hold_mean(arrival + delay[b, j], command, edges)
                if tau[b, j] > 0.0:
                    keep = np.exp(-dt / tau[b, j])
                    ends, _ = lfilter([1.0 - keep], [1.0, -keep], held, zi=[keep * held[0]])
                    held = 0.5 * (np.concatenate([held[:1], ends[:-1]]) + ends)
                result[:, b, j] = held
        self._profile(result, self.of("acceleration_limit", "a_max_rad_s2"))
        self._play(result, 0.5 * self.of("backlash", "width_rad"))
        return result.reshape(self.steps, PARTS, len(self.runs), self.count)

    def _profile(self, reference: np.ndarray, limit: np.ndarray) -> None:
        """Follow the reference with bounded acceleration, braking in time to stop on it.

        In place.
        """
        on = limit > 0.0
        if not on.any():
            return
        dt = self.dt / PARTS
        bound = limit[on]
        position = reference[0][on]
        speed = np.zeros(int(on.sum()))
        for k in range(len(reference)):
            start = position
            away = reference[k][on] - position
            far = np.abs(away)
            # Braking at the limit from this speed, seen half a step ahead, ends on the target.
            wish = np.sqrt(2.0 * bound * far + (0.5 * bound * dt) ** 2) - 0.5 * bound * dt
            wish = np.copysign(np.minimum(wish, far / dt), away)
            speed = speed + np.minimum(np.maximum(wish - speed, -bound * dt), bound * dt)
            position = position + dt * speed
            reference[k][on] = 0.5 * (start + position)

    def _play(self, reference: np.ndarray, half: np.ndarray) -> None:
        """Let the reference lag by the play at every reversal; in place."""
        on = half > 0.0
        if not on.any():
            return
        gap = half[on]
        output = reference[0][on]
        for k in range(len(reference)):
            target = reference[k][on]
            output = np.minimum(np.maximum(output, target - gap), target + gap)
            reference[k][on] = output

    def _switch(self) -> np.ndarray:
        """Whether each servo is on in each step [K, B, J] float."""
        grid = np.arange(self.steps) * self.dt
        on = np.empty((self.steps, len(self.runs), self.count))
        for b, run in enumerate(self.runs):
            on[:, b] = run.enabled[np.maximum(np.searchsorted(run.time, grid, side="right") - 1, 0)]
        return on

    def integrate(self, reference: np.ndarray) -> np.ndarray:
        """Positions [K + 1, B, J] from rest at the equilibrium of the first of the :meth:`references`."""
        dt = self.dt
        half = 0.5 * self.dt
        loads = _Loads(self, dt)
        motor = _Servo(self)
        switch = self._switch()
        dead = 0.5 * self.of("dead_zone", "width_rad")
        integral_gain = self.of("integral_action", "k_i")
        coupling = np.zeros((*self.kp.shape, self.count))
        for i in range(self.count):
            coupling[:, :, i] = self.of("joint_coupling", f"from_{i + 1}")
        coupling *= 1.0 - np.eye(self.count)
        q = self._equilibrium(reference[0, 0], switch[0], coupling)
        v = np.zeros_like(q)
        wound = np.zeros_like(q)
        path = np.empty((self.steps + 1, *q.shape))
        path[0] = q
        loads.start(q)
        for k, on in enumerate(switch):
            gain = self.gain * on
            # Open terminals carry no current: the damping of a servo that is off, mostly back-EMF,
            # is gone.
            damping = self.kd * (on > 0.0)
            middle = q + half * v
            error = reference[k] - middle + np.einsum("bij,bj->bi", coupling, middle)
            error = error - np.clip(error, -dead, dead)
            wound = wound + dt * _mean(error) * (on > 0.0)
            wanted = gain * (self.kp * error + integral_gain * wound)
            torque, slope, carried = motor(wanted - damping * v, v, k * dt)
            load = loads(middle, v)
            new = self._speed(
                middle, v, torque + load, 0.5 * slope * damping, loads, carried, v, k * dt
            )
            if loads.loads or motor.stalls:
                # Both follow the speed: once more with that of the middle of the step.
                mean = 0.5 * (v + new)
                torque, _, carried = motor(wanted - damping * mean, mean, k * dt)
                new = self._speed(middle, v, torque + load, 0.0, loads, carried, mean, k * dt)
            v = np.clip(new, -self.limit, self.limit)
            q = middle + half * v
            loads.bend(v)
            path[k + 1] = q
        return path

    def _speed(
        self,
        middle: np.ndarray,
        v: np.ndarray,
        push: np.ndarray,
        resisting: Any,
        loads: "_Loads",
        carried: np.ndarray,
        sliding: np.ndarray,
        time: float,
    ) -> np.ndarray:
        """Speeds after a step [B, J] from ``v``, friction as of a torque carried and a sliding speed."""
        minus, plus = loads.friction(carried, sliding, time)
        elastic = loads.presliding > 0.0
        push = push - np.where(elastic, loads.bent(v, minus, plus), 0.0)
        minus = np.where(elastic, 0.0, minus)
        plus = np.where(elastic, 0.0, plus)
        if self.body is not None:
            zero = np.zeros_like(v)
            return self.body.velocity(
                middle, v, push, resisting + zero, minus, plus, self.inertia, self.dt
            )
        mass = self.inertia / self.dt + resisting
        return slip(mass * v + push, minus, plus) / mass

    def _equilibrium(
        self, reference: np.ndarray, on: np.ndarray, coupling: np.ndarray
    ) -> np.ndarray:
        """Where the joints hang at rest on their springs [B, J].

        One that is off starts at the reference.
        """
        tau = self.of("gravity_load", "tau_g_nm")
        phase = self.of("gravity_load", "phase_rad")
        stiffness = np.maximum(self.kp * self.gain, 1e-9)
        q = reference.copy()
        for _ in range(EQUILIBRIUM_SWEEPS):
            weight = self.pendulum * np.sin(q) + tau * np.sin(q + phase)
            if self.body is not None:
                weight = weight + self.body.weight(q)
            pulled = reference + np.einsum("bij,bj->bi", coupling, q) - weight / stiffness
            q = np.where(on > 0.0, 0.5 * q + 0.5 * pulled, reference)
        return q


def _arrivals(
    time: np.ndarray, command: np.ndarray, sigma: float, drop: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """When each write arrives, in order, and what it says; dropped writes are absent."""
    if sigma <= 0.0 and drop <= 0.0:
        return time, command
    late = time + np.abs(rng.normal(0.0, sigma, len(time)))
    kept = rng.random(len(time)) >= drop
    kept[0] = True
    return np.maximum.accumulate(late)[kept], command[kept]


def _hold_mean(arrival: np.ndarray, command: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Means over [edges_k, edges_k+1] of a command held from each arrival on (the first also before)."""
    knots = np.concatenate(
        [[min(arrival[0], 0.0) - 1.0], arrival, [max(edges[-1], arrival[-1]) + 1.0]]
    )
    held = np.concatenate([command[:1], command])
    area = np.concatenate([[0.0], np.cumsum(held * np.diff(knots))])
    return np.diff(np.interp(edges, knots, area)) / np.diff(edges)


class _Servo:
    """Torque of the motors for what the controllers want, and its slope, which the implicit damping needs."""

    def __init__(self, batch: _Batch):
        self.sag = batch.of("supply_sag", "relative")
        self.rate = batch.of("thermal_drift", "rate_per_s")
        self.soft = np.minimum(_where_on(batch.of("torque_saturation", "tau_s_nm")), 1e9)
        self.hard = _where_on(batch.of("torque_limit", "tau_max_nm"))
        for row, plant in zip(self.hard, batch.plants, strict=True):
            if plant.effort is not None:
                row[:] = np.minimum(row, plant.effort)
        self.stall = _where_on(batch.of("torque_speed_limit", "tau_stall_nm"))
        self.idle = _where_on(batch.of("torque_speed_limit", "omega_0_rad_s"))
        self.stalls = np.isfinite(self.stall).any()

    def __call__(self, wanted: np.ndarray, speed: np.ndarray, time: float) -> tuple[Any, Any, Any]:
        """Mean torque, its mean slope by the torque wanted, and its mean size.

        Args:
            wanted: Torque wanted, in parts of the step [PARTS, B, J] [N m].
            speed: Speed of the joints [B, J] [rad/s].
            time: Time since the start [s].
        """
        share = 1.0 / (1.0 + self.sag * np.abs(wanted))
        cool = np.exp(-self.rate * time)
        torque = cool * share * wanted
        slope = cool * share * share
        bent = np.tanh(torque / self.soft)
        torque = self.soft * bent
        slope = slope * (1.0 - bent * bent)
        slope = slope * (np.abs(torque) < self.hard)
        torque = np.clip(torque, -self.hard, self.hard)
        if self.stalls:
            available = self.stall * np.maximum(0.0, 1.0 - np.abs(speed) / self.idle)
            bound = np.where(torque * speed > 0.0, available, self.stall)
            slope = slope * (np.abs(torque) < bound)
            torque = np.clip(torque, -bound, bound)
        return _mean(torque), _mean(slope), _mean(np.abs(torque))


def _mean(parts: np.ndarray) -> np.ndarray:
    """Mean over the parts of a step; the method of arrays takes three times as long for so few."""
    return np.add.reduce(parts, axis=0) / PARTS


def _where_on(values: np.ndarray) -> np.ndarray:
    """Infinity in place of 0, for limits that are absent."""
    return np.where(values > 0.0, values, np.inf)


class _Loads:
    """Torques on the joints that are no motor's, and the bounds of dry friction."""

    def __init__(self, batch: _Batch, dt: float):
        of = batch.of
        self.dt = dt
        self.pendulum = batch.pendulum
        self.weight = of("gravity_load", "tau_g_nm")
        self.phase = of("gravity_load", "phase_rad")
        self.ripple = of(COGGING, "amplitude_nm")
        self.turns = of(COGGING, "per_turn")
        self.cable = of(CABLE, "k_nm_rad")
        self.slack = of(CABLE, "slack_rad")
        spring = "elastic_transmission"
        self.spring = of(spring, "k_nm_rad")
        self.loss = of(spring, "c_nms_rad")
        self.mass = np.where(self.spring > 0.0, of(spring, "j_kgm2"), 1.0)
        if (self.spring * dt * dt + self.loss * dt >= self.mass).any():
            raise ValueError(
                f"{spring} is too stiff for a step of {dt:g} s: raise j_kgm2, or lower k_nm_rad"
            )
        self.load = of("load_friction", "k_load")
        self.static = of("stribeck_friction", "tau_s_nm")
        self.sliding = of("stribeck_friction", "tau_c_nm")
        self.scale = _where_on(of("stribeck_friction", "v_s_rad_s"))
        self.minus = of("asymmetric_friction", "tau_minus_nm")
        self.plus = of("asymmetric_friction", "tau_plus_nm")
        self.constant = of("coulomb_friction", "tau_c_nm") + self.sliding
        self.cold = of(WARMING, "cold_nm")
        self.warm = of(WARMING, "warm_nm")
        self.warming = _where_on(of(WARMING, "time_s"))
        self.session = stacked(batch.runs, "session_s")[:, None]
        self.loads = self.load.any()
        self.turn = self.rate = self.strain = np.zeros_like(self.weight)
        physics = [plant.physics for plant in batch.plants]
        self.presliding = stacked(physics, "presliding_rad")[:, None] + self.strain
        self.gear = stacked(physics, "ripple_nm")[:, None]
        self.teeth = stacked(physics, "ripple_per_turn")[:, None]

    def bend(self, v: np.ndarray) -> None:
        """Bend what carries dry friction by a step at speeds [B, J]."""
        self.strain = self._bent(v)

    def bent(self, v: np.ndarray, minus: np.ndarray, plus: np.ndarray) -> np.ndarray:
        """Friction torque [B, J] [N m] as far as a step at speeds ``v`` has it build up to its bounds."""
        strain = self._bent(v)
        return np.where(strain > 0.0, plus, minus) * strain

    def _bent(self, v: np.ndarray) -> np.ndarray:
        return np.clip(self.strain + v * self.dt / np.maximum(self.presliding, 1e-12), -1.0, 1.0)

    def start(self, q: np.ndarray) -> None:
        """Put the second masses at rest on the joints."""
        self.turn = q.copy()
        self.rate = np.zeros_like(q)

    def __call__(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Torques [B, J] [N m] at positions and speeds; the second masses move on."""
        middle = self.turn + 0.5 * self.dt * self.rate
        drag = self.spring * (middle - q) + self.loss * (self.rate - v)
        self.rate = self.rate - self.dt * drag / self.mass
        self.turn = middle + 0.5 * self.dt * self.rate
        weight = self.pendulum * np.sin(q) + self.weight * np.sin(q + self.phase)
        ripple = self.ripple * np.sin(self.turns * q) + self.gear * np.sin(self.teeth * q)
        return drag - weight + ripple - self.cable * np.maximum(q - self.slack, 0.0)

    def friction(
        self, motor: np.ndarray, v: np.ndarray, time: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the friction torque against negative and positive motion [B, J] [N m].

        Args:
            motor: Size of the motors' torque [B, J] [N m].
            v: Speed [B, J] [rad/s].
            time: Time since the start [s].
        """
        fading = (self.static - self.sliding) * np.exp(-np.square(v / self.scale))
        cooling = (self.cold - self.warm) * np.exp(-(self.session + time) / self.warming)
        bound = self.constant + self.load * motor + fading + self.warm + cooling
        return bound + self.minus, bound + self.plus
