"""Joints of a finger: links of other mass are no finding, and one cause on all of them is named once."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vd.kernels.servo.actuators as servo
from vd.assets_usd.hands import load_hand
from vd.gap.chain import Chain, chains
from vd.gap.design import design
from vd.gap.explanation import intervals
from vd.gap.fit import JointProblem
from vd.gap.joint_fit import JointFit
from vd.gap.masses import RANGE, fit_masses, widened, with_free_masses
from vd.gap.recording import Recording, Trajectory
from vd.gap.rollout import Rollouts
from vd.gap.workflow import baseline_of, explain

JOINTS = ("f0_j1", "f0_j2", "f0_j3")
NOISE = 3e-4
DT = 1.0 / 240.0


def blank() -> Recording:
    """Steps and sines of each joint of a finger, one after the other."""
    time = np.arange(0.0, 2.0, 0.01)
    step = np.where(time > 0.3, 0.7, 0.0) - np.where(time > 1.1, 1.2, 0.0)
    shapes = {"step": step, "slow": 0.7 * np.sin(np.pi * time), "fast": 0.6 * np.sin(3.0 * np.pi * time)}
    parts = []
    for column, joint in enumerate(JOINTS):
        for name, shape in shapes.items():
            command = np.zeros((len(time), 3))
            command[:, column] = shape
            still, on = np.zeros_like(command), np.ones(command.shape, bool)
            file = f"{joint}_{name}.csv"
            parts.append(Trajectory(file, name, (joint,), {}, time, command, still, on))
    return Recording(Path("made up"), "dclaw3", JOINTS, {}, 1e-5, tuple(parts))


def recorded(
    factors: tuple[float, float, float], lacks: dict[int, float] | None = None, dt: float = DT
) -> tuple[Recording, Chain]:
    """What a finger with links of other mass would have answered, and the chain of the model.

    Args:
        factors: Masses as shares of the model's.
        lacks: What its joints have besides, by column of a parameter row.
        dt: Time step [s].
    """
    recording = blank()
    (chain,) = chains(recording, load_hand("dclaw3"))
    scale = np.array(factors)
    true = replace(chain, mass=chain.mass * scale, inertia=chain.inertia * scale[:, None, None])
    rows = chain.start_row.copy()
    for column, value in (lacks or {}).items():
        rows[:, column] = value
    rollouts = Rollouts(true, recording, dt=dt)
    path = rollouts.predict(rows[None])[0]
    path = path + np.random.default_rng(0).normal(0.0, NOISE, path.shape)
    parts = [
        replace(t, position=path[rollouts.sample_trajectory == i].astype(float))
        for i, t in enumerate(recording.trajectories)
    ]
    return replace(recording, trajectories=tuple(parts)), chain


class SameStep(JointProblem):
    """A problem whose time step is fine enough: the recording was made with it."""

    def finer(self) -> JointProblem:
        """The same."""
        return self


def fitted(recording: Recording, chain: Chain) -> tuple[list[JointProblem], list[JointFit]]:
    """The plain models of the joints."""
    rollouts = Rollouts(chain, recording, dt=DT)
    problems, fits = [], []
    for joint in range(3):
        problem = SameStep(rollouts, joint, *design(recording, chain, joint), NOISE, baseline_of(chain))
        scales = problem.scales(chain.start_row[joint], NOISE)
        problems.append(problem)
        fits.append(problem.fit(chain.start_row, (), [{}], scales))
    return problems, fits


def test_masses_of_links_explain_what_no_stiffness_does_and_friction_is_no_mass() -> None:
    problems, fits = fitted(*recorded((0.85, 1.15, 0.9)))
    masses = fit_masses(problems, fits)
    assert max(fit.rmse for fit in fits) > 1.2 * NOISE, "the plain model is not enough"
    assert masses.errors == pytest.approx(np.full(3, NOISE), rel=0.05)
    assert masses.factors == pytest.approx([0.85, 1.15, 0.9], abs=0.03)
    rubbing = fitted(*recorded((1.0, 1.0, 1.0), {servo.COULOMB_TORQUE: 0.02}))
    assert fit_masses(*rubbing).errors.max() > 2.0 * NOISE


def test_masses_stay_in_the_range_that_policies_are_trained_on() -> None:
    masses = fit_masses(*fitted(*recorded((1.0, 1.8, 1.8))))
    assert (masses.factors <= RANGE[1] + 1e-9).all() and (masses.factors >= RANGE[0] - 1e-9).all()
    assert masses.errors.max() > 1.15 * NOISE


def test_intervals_beside_other_masses_know_that_these_are_open() -> None:
    """Stiffness follows the masses that the model has; with them free its interval holds the true one."""
    recording, chain = recorded((0.82, 1.18, 0.85))
    problems, fits = fitted(recording, chain)
    free = with_free_masses(problems, fits, fit_masses(problems, fits))
    missed = 0
    for joint, (fit, extents) in enumerate(zip(fits, free, strict=True)):
        true, own = float(chain.start_row[joint, servo.KP]), intervals(fit, NOISE)["kp"]
        assert extents["kp"][0] < true < extents["kp"][1]
        missed += not own[0] < true < own[1]
        low, high = intervals(widened(fit, NOISE, extents), NOISE)["kp"]
        assert low <= min(own[0], extents["kp"][0]) and high >= max(own[1], extents["kp"][1])
    assert missed, "with the masses of the drawing it is sure of another"


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.0, 0.03])
def test_links_of_other_mass_are_no_finding_and_friction_beside_them_is_named(
    friction: float, tmp_path: Path
) -> None:
    recording, _ = recorded((0.86, 1.14, 0.9), {servo.COULOMB_TORQUE: friction}, dt=1.0 / 960.0)
    effects = ("coulomb_friction", "gravity_load")
    report = explain(recording, load_hand("dclaw3"), tmp_path, effects=effects, workers=1)
    assert all("with the masses of its links" in joint.reason for joint in report.joints)
    assert report.verdict == ("effects" if friction else "no_gap")
    for effect in report.effects:
        assert effect.name == "coulomb_friction" and effect.joints == JOINTS
        assert effect.parameters["tau_c_nm"].value == pytest.approx(friction, rel=0.1)
