"""Candidate pairs sorted between the solver's phases.

They arrive sorted, and contacts stay as they are.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.sim import pair_order
from vd.sim.pair_order import sort_pairs

STEPS, STEPS_ON_GPU = 8, 4  # sums differ from run to run there, and worlds part sooner


def contacts(device: str, *, ordered: bool) -> tuple[np.ndarray, np.ndarray]:
    """Joint positions and object poses after some steps of a hand that closes, and contacts of each world."""
    cfg = ReorientCfg(
        hand="dclaw3",
        objects=("cube", "procedural-2-seed0"),
        num_envs=6,
        randomisation=RandomisationCfg(enabled=False),
    )
    env = ReorientEnv(cfg, device)
    solver = env.sim.solver
    if ordered:
        sort_pairs(solver.mjw_model, solver.mjw_data)
    else:
        solver.mjw_data.pair_order = None
    wp.to_torch(env.action).fill_(-0.7)
    for _ in range(STEPS if device == "cpu" else STEPS_ON_GPU):
        env.step(env.action)
    env.check()
    data = solver.mjw_data
    worlds = data.contact.worldid.numpy()[: int(data.nacon.numpy()[0])]
    found = env.sim.joint_q.numpy(), np.bincount(worlds, minlength=cfg.num_envs)
    env.close()
    return found


def test_contacts_are_the_same(device):
    plain, ordered = contacts(device, ordered=False), contacts(device, ordered=True)
    assert plain[1].sum() > 0
    np.testing.assert_array_equal(ordered[1], plain[1])
    # Forces of a world's contacts are added up in another order at most.
    if device == "cpu":
        np.testing.assert_allclose(ordered[0], plain[0], atol=1e-5)
    else:  # a world in which an edge slips off a fingertip a step sooner soon looks another
        assert np.median(np.abs(ordered[0] - plain[0]).max(axis=1)) < 1e-3


def test_the_narrow_phase_gets_them_sorted(device, monkeypatch):
    arrived = []

    def spy(model, data, found):
        count, kinds = int(data.ncollision.numpy()[0]), model.geom_type.numpy()
        pairs = found.collision_pair.numpy()[:count]
        arrived.append(8 * kinds[pairs[:, 0]] + kinds[pairs[:, 1]])

    monkeypatch.setattr(pair_order, "_in_order_found", spy)
    rng, most = np.random.default_rng(0), 40

    def of(values, dtype=wp.int32):
        return wp.array(values, dtype=dtype, device=device)

    model = SimpleNamespace(geom_type=of([0, 3, 6, 7]))
    data = SimpleNamespace(naconmax=most, ncollision=of([31]), geom_xpos=of([0.0], wp.float32))
    pairs, worlds = of(rng.integers(0, 4, (most, 2)), wp.vec2i), of(rng.integers(0, 5, most))
    found = SimpleNamespace(collision_pair=pairs, collision_pairid=pairs, collision_worldid=worlds)
    pair_order._narrowphase(model, data, found)
    sort_pairs(model, data)
    pair_order._narrowphase(model, data, found)
    before, after = arrived
    assert (np.diff(before) < 0).any() and (np.diff(after) >= 0).all()
    assert sorted(before) == list(after)


def test_kinds_that_a_key_has_no_room_for_are_refused():
    model = SimpleNamespace(geom_type=wp.array([0, 8], dtype=int, device="cpu"))
    with pytest.raises(ValueError, match="signed distance fields"):
        sort_pairs(model, None)
