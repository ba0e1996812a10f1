"""Links of other mass: found from the motions of all joints of a finger, within bounds, and no finding."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_gap_judge import made_up

import vd.kernels.servo.actuators as servo
from vd.assets_usd.hands import load_hand
from vd.gap import finger_masses
from vd.gap.chain import Chain, chains
from vd.gap.coordinates import Coordinate, Scales
from vd.gap.design import design
from vd.gap.explanation import Accepted, Explanation, intervals
from vd.gap.finger_masses import masses_beside
from vd.gap.fit import JointProblem
from vd.gap.joint_fit import JointFit
from vd.gap.masses import RANGE, Masses, fit_masses, widened, with_free_masses
from vd.gap.one_joint import Joint
from vd.gap.recording import Recording, Trajectory
from vd.gap.rollout import Rollouts
from vd.gap.team import Bench, JointSpec, Team
from vd.gap.workflow import baseline_of

JOINTS = ("f0_j1", "f0_j2", "f0_j3")
NOISE = 3e-4
DT = 1.0 / 240.0
NO_STRUCTURE = (np.zeros((2, 10)),) * 3


class SameStep(JointProblem):
    """A problem whose time step is fine enough."""

    def finer(self) -> JointProblem:
        """The same."""
        return self


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


def recorded(
    factors: tuple[float, float, float], lacks: dict[int, float] | None = None
) -> tuple[Recording, Chain]:
    """What a finger with links of other mass would have answered, and the chain of the model.

    Args:
        factors: Masses as shares of the model's.
        lacks: What its joints have besides, by column of a parameter row.
    """
    recording = blank()
    (chain,) = chains(recording, load_hand("dclaw3"))
    scale = np.array(factors)
    true = replace(chain, mass=chain.mass * scale, inertia=chain.inertia * scale[:, None, None])
    rows = chain.start_row.copy()
    for column, value in (lacks or {}).items():
        rows[:, column] = value
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
    _, masses = fitted(*recorded((1.0, 1.0, 1.0), {servo.COULOMB_TORQUE: 0.02}))
    assert masses.errors.max() > 2.0 * NOISE


def beside_masses(
    recording: Recording, chain: Chain, effects: Sequence[tuple[str, ...]], start: dict[str, float]
) -> tuple[list[Explanation], list[Explanation]]:
    """Fits with effects on each joint that are no answer, and what they are beside other masses."""
    with Team(Bench(recording, [chain], DT, "cpu"), workers=1) as team:
        every, found = [], []
        for index, (name, own) in enumerate(zip(JOINTS, effects, strict=True)):
            trajectories, folds = design(recording, chain, index)
            spec = JointSpec(0, index, trajectories, folds, NOISE, baseline_of(chain))
            problem = team.bench.problem(spec)
            scales = problem.scales(chain.start_row[index], NOISE)
            plain = problem.fit(chain.start_row, (), [{}], scales, iterations=8)
            every.append(Joint(name, spec, scales, plain))
            given = {key: value for key, value in start.items() if key.split(".")[0] in own}
            final = problem.fit(plain.rows, own, [given], scales)
            accepted = tuple(Accepted(effect, 1.0, {}, (), (), False) for effect in own)
            found.append(Explanation(plain, final, "unknown", "structure is left", accepted))
        return found, masses_beside(team, every, found)


@pytest.mark.parametrize(
    ("first", "others", "explained"),
    [
        (("coulomb_friction",), ("coulomb_friction", "command_filter"), True),
        (("command_filter",), ("coulomb_friction", "command_filter"), True),
        (("command_filter",), ("command_filter",), False),
    ],
    ids=["all have it", "most have it", "none has it"],
)
def test_beside_an_effect_other_masses_are_no_second_one(
    first: tuple[str, ...], others: tuple[str, ...], explained: bool
) -> None:
    """Only what all joints lack is kept where masses are the rest; nothing changes where they are not."""
    recording, chain = recorded((0.86, 1.14, 0.9), {servo.COULOMB_TORQUE: 0.03})
    start = {"coulomb_friction.tau_c_nm": 0.03, "command_filter.tau_s": 1e-3}
    found, told = beside_masses(recording, chain, [first, others, others], start)
    if not explained:
        assert told == found
        return
    assert [each.verdict for each in told] == ["effects"] * 3
    for each in told:
        assert [one.name for one in each.accepted] == ["coulomb_friction"]
        value, low, high = each.accepted[0].estimates["tau_c_nm"]
        assert value == pytest.approx(0.03, rel=0.05)
        assert low < 0.03 < high
        assert "with the masses of its links" in each.reason


@pytest.mark.parametrize(
    ("share", "off", "verdict"), [(1.0, 0.1, "unknown"), (-1.0, 0.1, "effects"), (-1.0, 0.02, "unknown")]
)
def test_beside_other_masses_a_spring_is_no_load_with_an_offset(
    share: float, off: float, verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The table has no spring: a load and an offset that cancel at rest are not named in its place.

    Nor is anything else where the masses are not others: it is not they that are the rest.
    """
    masses = Masses(np.array([1.0, 1.0 - off, 1.0]), np.full(3, NOISE), NO_STRUCTURE, np.zeros(3))
    monkeypatch.setattr(finger_masses, "fit_masses", lambda *_: masses)
    monkeypatch.setattr(finger_masses, "with_free_masses", lambda *_: [{}] * 3)
    monkeypatch.setattr(finger_masses, "_cores", lambda _: [("gravity_load", "encoder_bias")])
    recording = blank()
    (chain,) = chains(recording, load_hand("dclaw3"))
    load, phase = 0.05, -1.3
    offset = share * load * np.sin(phase) / float(chain.start_row[0, servo.KP])
    values = {
        "gravity_load.tau_g_nm": load,
        "gravity_load.phase_rad": phase,
        "encoder_bias.bias_rad": offset,
    }
    fit = replace(
        made_up(("gravity_load", "encoder_bias"), NOISE),
        coordinates=tuple(Coordinate(key, 0, False, 1.0, -9.0, 9.0) for key in ("kp", "kd", *values)),
        x=np.array([1.0, 1.0, *values.values()]),
        rows=chain.start_row,
    )
    bench = SimpleNamespace(chains=[chain], recording=recording, problem=lambda _: None)
    team = SimpleNamespace(bench=bench, run=lambda *_: [fit])
    accepted = tuple(Accepted(effect, 1.0, {}, (), (), False) for effect in fit.effects)
    scales = Scales(1.0, 1.0, 2.0, 3.0, 10.0, 1e-3, 0.01, 6.0)
    own, found = [], []
    for index, name in enumerate(JOINTS):
        spec = JointSpec(0, index, *design(recording, chain, index), NOISE, ())
        own.append(Joint(name, spec, scales, replace(fit, effects=())))
        found.append(Explanation(own[-1].fit, fit, "unknown", "structure is left", accepted))
    told = masses_beside(team, own, found)  # type: ignore[arg-type]
    assert [each.verdict for each in told] == [verdict] * 3


def test_intervals_beside_other_masses_know_that_these_are_open() -> None:
    """Stiffness follows the masses that the model has; with them free its interval holds the true one."""
    recording, chain = recorded((0.82, 1.18, 0.85))
    rollouts = Rollouts(chain, recording, dt=DT)
    problems, fits = [], []
    for joint in range(3):
        trajectories, folds = design(recording, chain, joint)
        # A recording that is simulated with one step is analysed with it: finer ones are others' business.
        problem = SameStep(rollouts, joint, trajectories, folds, NOISE, baseline_of(chain))
        problems.append(problem)
        fits.append(problem.fit(chain.start_row, (), [{}], problem.scales(chain.start_row[joint], NOISE)))
    free = with_free_masses(problems, fits, fit_masses(problems, fits))
    missed, wider = 0, []
    for joint, (fit, extents) in enumerate(zip(fits, free, strict=True)):
        true, own = float(chain.start_row[joint, servo.KP]), intervals(fit, NOISE)["kp"]
        assert extents["kp"][0] < true < extents["kp"][1]
        missed += not own[0] < true < own[1]
        both = widened(fit, NOISE, extents)
        low, high = intervals(both, NOISE)["kp"]
        wider.append(low <= min(own[0], extents["kp"][0]) and high >= max(own[1], extents["kp"][1]))
    assert missed and all(wider), "with the masses of the drawing it is sure of another"


@pytest.mark.parametrize(
    ("backlash", "friction", "structure", "named"),
    [
        (1.0, 1.1, 0.0, "backlash"),
        (1.2, 1.0, 0.0, "coulomb_friction"),
        (1.0, 1.0, 0.0, ""),  # both do
        (1.0, 1.1, 0.4, ""),  # another joint lacks more than other masses
    ],
    ids=["the first", "the second", "both", "structure elsewhere"],
)
def test_masses_name_one_of_a_set_only_where_it_alone_leaves_noise_with_them(
    backlash: float, friction: float, structure: float, named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All members of a set are tried beside other masses, and all joints must be left with noise."""
    left = {"backlash": backlash, "coulomb_friction": friction}
    kept = np.stack([np.full(10, structure * NOISE**2 * 100.0), np.full(10, 100.0)])

    def masses(_: Sequence[JointProblem], fits: Sequence[JointFit]) -> Masses:
        errors = NOISE * np.array([left[fits[0].effects[0]], 1.0, 1.0])
        structure = (NO_STRUCTURE[0], kept, NO_STRUCTURE[0])
        return Masses(np.array([1.1, 1.0, 1.0]), errors, structure, np.zeros(3))

    monkeypatch.setattr(finger_masses, "fit_masses", masses)
    monkeypatch.setattr(finger_masses, "with_free_masses", lambda *_: [{}] * 3)
    recording = blank()
    (chain,) = chains(recording, load_hand("dclaw3"))

    def fit(*effects: str) -> JointFit:
        # At the floor without structure, made up of parameters that no effect has.
        return replace(made_up(effects, NOISE), rows=chain.start_row)

    bench = SimpleNamespace(chains=[chain], recording=recording, problem=lambda _: None)
    team = SimpleNamespace(bench=bench, run=lambda _, calls: [fit(*calls[0][1]["effects"])])
    accepted = Accepted("backlash", 0.6, {}, (), ("coulomb_friction",), False)
    rivals = {"backlash": [fit("backlash"), fit("coulomb_friction")]}
    gap = Explanation(fit(), fit("backlash"), "ambiguous", "a set", (accepted,), (), rivals)
    found = [gap, *[Explanation(fit(), fit(), "no_gap", "")] * 2]
    specs = [JointSpec(0, index, *design(recording, chain, index), NOISE, ()) for index in range(3)]
    scales = Scales(1.0, 1.0, 2.0, 3.0, 10.0, 1e-3, 0.01, 6.0)
    own = [Joint(name, spec, scales, fit()) for name, spec in zip(JOINTS, specs, strict=True)]
    monkeypatch.setattr(finger_masses, "polished", lambda explanation, *_: explanation)
    told = masses_beside(team, own, found)  # type: ignore[arg-type]
    assert told[1:] == found[1:]
    assert [one.name for one in told[0].accepted if one.named] == ([named] if named else [])
    assert (told[0] is gap) == (not named)


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
