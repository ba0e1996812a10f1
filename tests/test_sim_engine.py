"""MuJoCo's own engine in the place of MuJoCo Warp: the same worlds, the same motion."""

import dataclasses

import numpy as np
import pytest
import warp as wp

from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate.cfg import EvalCfg
from vd.evaluate.cli import main
from vd.evaluate.conditions import CONDITIONS, EXACT
from vd.evaluate.result import Result
from vd.kernels.inverse_weights import inverse_weights_kernel
from vd.kernels.launch import launch
from vd.sim.cfg import SimCfg, in_mujoco
from vd.sim.engine import mend_weights

WORLDS = 4
FINE = in_mujoco(SimCfg())
GRAVITY = 9.81


def make(engine: str = "mujoco", **changes) -> ReorientEnv:
    """Two objects of other shapes, two worlds each."""
    cfg = ReorientCfg(hand="dclaw3", objects=("symmetric",), num_envs=WORLDS, randomisation=EXACT)
    sim = dataclasses.replace(FINE, engine=engine)
    return ReorientEnv(dataclasses.replace(cfg, sim=sim, **changes), "cpu")


def moved(env: ReorientEnv, steps: int) -> np.ndarray:
    """Positions after each of some steps of random actions, [steps, N, D + 7]."""
    rng, path = np.random.default_rng(0), []
    for _ in range(steps):
        env.action.assign(rng.uniform(-1.0, 1.0, env.action.shape).astype(np.float32))
        env.step(env.action)
        path.append(env.sim.joint_q.numpy().copy())
    env.check()
    return np.array(path)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"randomisation": CONDITIONS["mixed"]},
        {"randomisation": RandomisationCfg(object_com_m=0.01), "fingertip": "soft"},
    ],
    ids=["nominal", "mixed", "soft and off-centre"],
)
def test_both_engines_move_alike_in_equal_steps(changes):
    """Objects fall, land, and are pushed.

    Single precision leaves 0.01 mm, and in one world of some a contact that begins a step later.
    Of four draws in each case three quarters of the joints agree within 3e-6 rad, nine tenths of
    the objects' coordinates within 1.3 mm. A mass that did not arrive makes the latter 2.5 mm,
    a friction 42, a centre of mass 45.
    """
    newton, mujoco = (moved(make(engine, **changes), 8) for engine in ("newton", "mujoco"))
    assert np.ptp(newton[:, :, 11], axis=0).min() > 0.01, "all fell"
    apart = np.abs(mujoco - newton)
    assert np.quantile(apart[:, :, :9], 0.75) < 3e-5
    assert np.quantile(apart[:, :, 9:], 0.9) < 2e-3
    assert not np.array_equal(mujoco, newton), "two engines"


def test_the_weight_of_links_that_only_turn_is_that_of_rotation():
    """Rounding of 4e-15 in place of 0 made an Allegro's contact with its palm 1e15 times too stiff."""
    given = np.array([[[0, 0], [0, 300], [4e-15, 500], [0.03, 400], [10, 12000]]], np.float32)
    expected = [[[0, 0], [300, 300], [500, 500], [0.03, 400], [10, 12000]]]
    weights = wp.array(given, dtype=wp.vec2)
    launch(inverse_weights_kernel, weights.shape, [], [weights])
    mend_weights(given)
    for mended in (weights.numpy(), given):
        np.testing.assert_array_equal(mended, np.float32(expected))


def test_the_table_carries_what_each_object_weighs_until_it_leaves():
    env = make(randomisation=dataclasses.replace(EXACT, object_mass_kg=(0.03, 0.3)))
    q = env.sim.joint_q.numpy()
    q[:, 9:12] = [0.3, 0.0, 0.06]  # out of reach of the fingers
    env.sim.joint_q.assign(q)
    for _ in range(12):
        env.hold()
    masses = env.randomiser.object_mass.numpy()
    assert np.ptp(masses) > 0.05
    np.testing.assert_allclose(env.sim.table_force.numpy(), GRAVITY * masses, rtol=0.01)
    before = env.object_pose()
    env.sim.place_table(present=False)
    env.hold()
    assert (env.object_pose()[:, 2] < before[:, 2] - 0.02).all()
    assert not env.sim.table_force.numpy().any()


def test_threads_and_a_saved_state_do_not_change_the_motion(monkeypatch):
    paths = []
    for threads in (1, 3):
        monkeypatch.setenv("OMP_NUM_THREADS", str(threads))
        env = make(randomisation=CONDITIONS["mixed"], num_envs=6)
        moved(env, 3)
        saved = env.state_dict()
        paths.append(moved(env, 3))
        env.load_state_dict(saved)
        paths.append(moved(env, 3))
    for path in paths[1:]:
        np.testing.assert_array_equal(path, paths[0])


def test_an_evaluation_says_whose_physics_it_was(tmp_path):
    few = [
        "--episodes",
        "1",
        "--episode-s",
        "0.3",
        "--out",
        str(tmp_path),
        "--condition",
        "stiff-contacts",
    ]
    assert main(["zero", "--engine", "mujoco", *few]) == 0
    (row, *_) = Result.read(tmp_path / "eval.json").rows
    assert row.protocol.engine == "mujoco"
    assert "engine mujoco" in (tmp_path / "eval.html").read_text()


def test_what_the_engine_cannot_do_is_refused():
    with pytest.raises(ValueError, match=r"--engine mujoco .*--device"):
        EvalCfg(policies=("zero",), engine="mujoco", device="cuda:0").validate()
