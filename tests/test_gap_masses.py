"""Links of other mass: found from the motions of all joints of a finger, within bounds, and no finding."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vd.kernels.actuators as servo
from vd.assets_usd.hands import load_hand
from vd.gap.chain import Chain, chains
from vd.gap.design import design
from vd.gap.explanation import Accepted, Explanation
from vd.gap.fit import JointProblem
from vd.gap.joint_fit import JointFit
from vd.gap.joints import Joint, _beside_masses
from vd.gap.masses import RANGE, Masses, fit_masses
from vd.gap.recording import Recording, Trajectory
from vd.gap.rollout import Rollouts
from vd.gap.team import Bench, JointSpec, Team
from vd.gap.workflow import baseline_of

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
            parts.append(
                Trajectory(
                    file=f"{joint}_{name}.csv",
                    excitation=name,
                    joints=(joint,),
                    conditions={},
                    time=time,
                    command=command,
                    position=np.zeros_like(command),
                    enabled=np.ones(command.shape, bool),
                )
            )
    return Recording(Path("made up"), "dclaw3", JOINTS, {}, 1e-5, tuple(parts))


def recorded(factors: tuple[float, float, float], friction: float = 0.0) -> tuple[Recording, Chain]:
    """What a finger with links of other mass would have answered, and the chain of the model."""
    recording = blank()
    (chain,) = chains(recording, load_hand("dclaw3"))
    scale = np.array(factors)
    true = replace(chain, mass=chain.mass * scale, inertia=chain.inertia * scale[:, None, None])
    rows = chain.start_row.copy()
    rows[:, servo.COULOMB_TORQUE] = friction
    rollouts = Rollouts(true, recording, dt=DT)
    path = rollouts.predict(rows[None])[0]
    path = path + np.random.default_rng(0).normal(0.0, NOISE, path.shape)
    parts = [
        replace(t, position=path[rollouts.sample_trajectory == i].astype(float))
        for i, t in enumerate(recording.trajectories)
    ]
    return replace(recording, trajectories=tuple(parts)), chain


def fitted(recording: Recording, chain: Chain) -> tuple[list[JointFit], Masses]:
    """The plain models of the joints, and those with masses."""
    rollouts = Rollouts(chain, recording, dt=DT)
    problems, fits = [], []
    for joint in range(3):
        trajectories, folds = design(recording, chain, joint)
        problem = JointProblem(rollouts, joint, trajectories, folds, NOISE, baseline_of(chain))
        scales = problem.scales(chain.start_row[joint], NOISE)
        problems.append(problem)
        fits.append(problem.fit(chain.start_row, (), [{}], scales, iterations=8))
    return fits, fit_masses(problems, fits)


def test_masses_of_links_explain_what_no_stiffness_does() -> None:
    fits, masses = fitted(*recorded((0.85, 1.15, 0.9)))
    assert max(fit.rmse for fit in fits) > 1.2 * NOISE  # the plain model is not enough
    assert masses.errors == pytest.approx(np.full(3, NOISE), rel=0.05)
    assert masses.factors == pytest.approx([0.85, 1.15, 0.9], abs=0.03)


def test_friction_is_no_mass() -> None:
    _, masses = fitted(*recorded((1.0, 1.0, 1.0), friction=0.02))
    assert masses.errors.max() > 2.0 * NOISE


@pytest.mark.parametrize(("core", "explained"), [("coulomb_friction", True), ("command_filter", False)])
def test_beside_an_effect_other_masses_are_no_second_one(core: str, explained: bool) -> None:
    """Only what all joints lack is kept where masses are the rest; nothing changes where they are not."""
    recording, chain = recorded((0.86, 1.14, 0.9), friction=0.03)
    both = ("coulomb_friction", "command_filter")
    with Team(Bench(recording, [chain], DT, "cpu"), workers=1) as team:
        joints, found = [], []
        for index, name in enumerate(JOINTS):
            trajectories, folds = design(recording, chain, index)
            spec = JointSpec(0, index, trajectories, folds, NOISE, baseline_of(chain))
            problem = team.bench.problem(spec)
            scales = problem.scales(chain.start_row[index], NOISE)
            plain = problem.fit(chain.start_row, (), [{}], scales, iterations=8)
            joints.append(Joint(name, spec, scales, plain))
            effects = both if index else (core,)
            start = {"coulomb_friction.tau_c_nm": 0.03, "command_filter.tau_s": 1e-3}
            final = problem.fit(
                plain.rows, effects, [{k: start[k] for k in start if k.split(".")[0] in effects}], scales
            )
            accepted = tuple(Accepted(effect, 1.0, {}, (), (), False) for effect in effects)
            found.append(Explanation(plain, final, "unknown", "structure is left", accepted))
        told = _beside_masses(team, joints, found)
    if not explained:
        assert told == found
        return
    assert [each.verdict for each in told] == ["effects"] * 3
    for each in told:
        assert [one.name for one in each.accepted] == ["coulomb_friction"]
        assert each.accepted[0].estimates["tau_c_nm"][0] == pytest.approx(0.03, rel=0.05)
        assert "with the masses of its links" in each.reason


def test_masses_stay_in_the_range_that_policies_are_trained_on() -> None:
    _, masses = fitted(*recorded((1.0, 1.8, 1.8)))
    assert (masses.factors <= RANGE[1] + 1e-9).all() and (masses.factors >= RANGE[0] - 1e-9).all()
    assert masses.errors.max() > 1.15 * NOISE


def test_other_links_move_a_rollout_and_leave_the_first_as_it_was() -> None:
    recording, chain = recorded((1.0, 1.0, 1.0))
    rollouts = Rollouts(chain, recording, dt=DT)
    before = rollouts.predict(chain.start_row[None])
    heavier = rollouts.with_chain(replace(chain, mass=1.2 * chain.mass))
    assert np.abs(heavier.predict(chain.start_row[None]) - before).max() > 1e-3
    assert np.array_equal(rollouts.predict(chain.start_row[None]), before)
