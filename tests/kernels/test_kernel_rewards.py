import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import (
    EXAMPLES,
    angle_between,
    device_array,
    floats,
    goals,
    indices,
    launch,
    quaternions,
)

from vd.kernels.task.rewards import (
    FINGERTIP_MEAN,
    FINGERTIP_SQUARED_SUM,
    REWARD_TERMS,
    reward_kernel,
)
from vd.kernels.task.success import success_kernel
from vd.paper import PAPER

GOAL_M = (0.0, 0.0, 0.08)
"""Where objects are handled."""
REWARD = {
    "success": PAPER.reward.success,
    "rotation": PAPER.reward.rotation,
    "rotation_epsilon": PAPER.reward.rotation_epsilon_rad,
    "fingertip": PAPER.reward.fingertip,
    "fingertip_form": FINGERTIP_SQUARED_SUM,
    "energy": PAPER.reward.energy,
    "energy_clip": 0.0,
    "fall": PAPER.reward.fall,
    "table_contact": PAPER.reward.table_contact,
    "table_contact_force": PAPER.reward.table_contact_force_n,
    "fingertip_height": PAPER.reward.fingertip_height,
    "height_limit": PAPER.reward.fingertip_height_m,
    "progress": 0.0,
    "lift": 0.0,
    "lift_height": 0.02,
    "scale": 1.0,
}
SUCCESS = {
    "rotation": PAPER.success.rotation_rad,
    "joint_speed": PAPER.success.joint_speed_rad_s,
    "object_speed": PAPER.success.object_speed_m_s,
    "object_spin": PAPER.success.object_spin_rad_s,
    "action_norm": PAPER.success.action_norm,
    "table_contact_force": PAPER.reward.table_contact_force_n,
    "fall_distance": PAPER.success.fall_m,
    "fall_center": wp.vec3(*GOAL_M),
}
STILLNESS = ("joint_speed", "object_speed", "object_spin", "action_norm")


def rest(fingers=3, worlds=1):
    """Worlds that stand still at their goal, in the middle of the space, with every tip at the object."""
    joints = 3 * fingers
    pose = [*GOAL_M, 0.0, 0.0, 0.0, 1.0]
    return {
        "q": np.tile(np.append(np.zeros(joints), pose), (worlds, 1)),
        "qd": np.zeros((worlds, joints + 6)),
        "tips": np.tile(pose[:3], (worlds, fingers, 1)),
        "effort": np.zeros((worlds, joints)),
        "goal": np.tile([0.0, 0.0, 0.0, 1.0], (worlds, 1)),
        "smoothed": np.zeros((worlds, joints)),
        "table_force": np.zeros(worlds),
        "clearance": np.zeros(worlds),
        "must_lift": np.zeros(worlds, np.int32),
        "previous_error": np.zeros(worlds),
    }


def evaluate(device, state, reward=None, success=None):
    """Launch the kernels, success first; returns their outputs by name."""
    envs = len(state["q"])
    previous_error = device_array(state["previous_error"], float, device)
    seen = [state[name] for name in ("q", "qd", "goal", "smoothed", "table_force", "must_lift")]
    found = launch(success_kernel, envs, [SUCCESS | (success or {}), *seen], device, *[envs] * 4)
    out = dict(zip(("error", "still", "success", "fell"), found, strict=True))
    seen = [state[name] for name in ("q", "qd", "tips", "effort", "table_force", "clearance")]
    seen += [*(out[name] for name in ("error", "success", "fell")), previous_error]
    inputs = [REWARD | (reward or {}), *seen]
    out["reward"], out["terms"] = launch(
        reward_kernel, envs, inputs, device, envs, (envs, len(REWARD_TERMS))
    )
    return out | {"previous_error": previous_error.numpy()}


def oracle(state, reward, success):
    """Terms, error, stillness, success and fall by the equations.

    How near each world is to a threshold.
    """
    s = {name: np.asarray(value, np.float64) for name, value in state.items()}
    joints = s["effort"].shape[1]
    position, orientation = s["q"][:, joints : joints + 3], s["q"][:, joints + 3 :]
    qd, v, w = np.split(s["qd"], [joints, joints + 3], axis=1)
    error = angle_between(orientation, s["goal"])
    distance = np.linalg.norm(s["tips"] - position[:, None], axis=-1)
    power = np.sum(np.abs(qd) * np.abs(s["effort"]), axis=1)
    if reward["energy_clip"] > 0:
        power = np.minimum(power, reward["energy_clip"])
    mean_form = reward["fingertip_form"] == FINGERTIP_MEAN
    reach = distance.mean(axis=1) if mean_form else (distance**2).sum(axis=1)
    fall_distance = np.linalg.norm(position - np.array(success["fall_center"]), axis=1)
    margins = {
        "rotation": success["rotation"] - error,
        "joint_speed": success["joint_speed"] - np.linalg.norm(qd, axis=1),
        "object_speed": success["object_speed"] - np.linalg.norm(v, axis=1),
        "object_spin": success["object_spin"] - np.linalg.norm(w, axis=1),
        "action_norm": success["action_norm"] - np.linalg.norm(s["smoothed"], axis=1),
    }
    contact_margin = s["table_force"] - reward["table_contact_force"]
    height_margin = s["tips"][..., 2] - reward["height_limit"]
    still = (contact_margin <= 0) | (s["must_lift"] == 0)
    for name in STILLNESS:
        if success[name] > 0:
            still &= margins[name] >= 0
    reached = still & (margins["rotation"] >= 0)
    fell = (success["fall_distance"] > 0) & (fall_distance >= success["fall_distance"])
    terms = np.stack(
        [
            reward["success"] * reached,
            reward["rotation"] / (error + reward["rotation_epsilon"]),
            reward["fingertip"] * reach,
            reward["energy"] * power,
            reward["fall"] * fell,
            reward["table_contact"] * (contact_margin > 0),
            reward["fingertip_height"] * (height_margin > 0).sum(axis=1),
            reward["progress"] * (s["previous_error"] - error),
            reward["lift"] * np.interp(s["clearance"], [0.0, reward["lift_height"]], [0.0, 1.0]),
        ],
        axis=1,
    )
    near = np.abs(
        np.stack([*margins.values(), contact_margin, fall_distance - success["fall_distance"]])
    )
    # The float32 asin is good to 1e-3 rad near pi, far from any tolerance used here.
    decided = (near.min(axis=0) > 1e-5) & (np.abs(height_margin).min(axis=1) > 1e-6)
    return terms, error, still, reached, fell, decided


@st.composite
def states(draw: st.DrawFn) -> dict[str, np.ndarray]:
    """States with still and moving worlds, near and far from the goal, on and off the table."""
    fingers, worlds = draw(st.sampled_from([3, 4])), draw(st.integers(1, 4))
    joints = 3 * fingers
    orientation = draw(quaternions((worlds,)))
    speed = draw(st.sampled_from([0.0, 0.02, 1.0]))
    hand = draw(floats((worlds, joints)))
    position = draw(floats((worlds, 3), -0.12, 0.12)) + np.array(GOAL_M)
    return {
        "q": np.concatenate([hand, position, orientation], axis=1).astype(np.float32),
        "qd": (speed * draw(floats((worlds, joints + 6)))).astype(np.float32),
        "tips": draw(floats((worlds, fingers, 3), -0.2, 0.2)),
        "effort": draw(floats((worlds, joints), -2.6, 2.6)),
        "goal": draw(goals(orientation)),
        "smoothed": draw(floats((worlds, joints), -0.5, 0.5)),
        "table_force": draw(floats((worlds,), 0.0, 1.0)),
        "clearance": draw(floats((worlds,), -0.1, 0.1)),
        "must_lift": draw(indices(worlds, 2)),
        "previous_error": draw(floats((worlds,), 0.0, 3.0)),
    }


@EXAMPLES
@given(
    state=states(),
    form=st.sampled_from([FINGERTIP_SQUARED_SUM, FINGERTIP_MEAN]),
    clip=st.sampled_from([0.0, PAPER.reward.energy_clip_w_code]),
    progress=st.sampled_from([0.0, 20.0]),
    lift=st.sampled_from([(0.0, 0.02), (3.0, 0.02), (3.0, 0.2)]),
    scale=st.sampled_from([1.0, 0.01]),
    tolerance=st.sampled_from([0.4, 0.1, 2.0]),
    disabled=st.sets(st.sampled_from([*STILLNESS, "fall_distance"])),
)
def test_terms_match_the_equations(
    device, state, form, clip, progress, lift, scale, tolerance, disabled
):
    reward = {
        **REWARD,
        "fingertip_form": form,
        "energy_clip": clip,
        "progress": progress,
        "scale": scale,
    }
    reward |= {"lift": lift[0], "lift_height": lift[1]}
    success = {**SUCCESS, "rotation": tolerance, **dict.fromkeys(disabled, 0.0)}
    out = evaluate(device, state, reward, success)
    terms, error, still, reached, fell, decided = oracle(state, reward, success)
    np.testing.assert_allclose(out["error"], error, atol=2e-3)
    np.testing.assert_array_equal(out["previous_error"], out["error"])
    np.testing.assert_array_equal(out["still"][decided], still[decided])
    np.testing.assert_array_equal(out["success"][decided], reached[decided])
    np.testing.assert_array_equal(out["fell"][decided], fell[decided])
    tolerances = np.array([0, 3e-3, 1e-5, 1e-3, 0, 0, 0, 20 * 2e-3, 1e-5])
    assert np.all(
        np.abs(out["terms"] - terms)[decided] <= tolerances + 1e-5 * np.abs(terms)[decided]
    )
    np.testing.assert_allclose(
        out["reward"], scale * out["terms"].sum(axis=1), rtol=1e-5, atol=1e-3
    )


def test_all_coefficients_of_table_s1(device):
    """The values by hand for one world where every term is on."""
    state = rest(fingers=3)
    state["q"][0, 9:12] = [0.2, 0.0, 0.08]
    state["tips"][0] = [[0.2, 0.0, 0.18], [0.2, 0.3, 0.08], [0.2, 0.0, 0.08]]
    state["qd"][0, 0], state["effort"][0, 0] = 0.125, -2.0
    state["table_force"][0] = 1.0
    state["previous_error"][0], state["clearance"][0] = 0.5, 0.005
    out = evaluate(device, state, {"progress": 20.0, "lift": 4.0})
    expected = [800.0, 2.5, -(0.01 + 0.09), -20 * 0.25, -100.0, -1.0, -2.0, 10.0, 1.0]
    np.testing.assert_allclose(out["terms"][0], expected, rtol=1e-5)
    assert out["reward"][0] == pytest.approx(sum(expected), rel=1e-5)
    assert (out["success"][0], out["fell"][0]) == (1, 1)


# Thresholds that float32 represents exactly, so that "exactly at" means it.
AT = {"joint_speed": 0.25, "object_speed": 0.0625, "object_spin": 0.5, "action_norm": 1.0}


@pytest.mark.parametrize(
    ("offset", "succeeds"), [(-1, 1), (0, 1), (1, 0)], ids=["below", "at", "above"]
)
@pytest.mark.parametrize("name", STILLNESS)
def test_success_includes_its_thresholds_of_stillness(device, name, offset, succeeds):
    state = rest()
    joints = state["effort"].shape[1]
    place = {
        "joint_speed": ("qd", 4),
        "object_speed": ("qd", joints + 1),
        "object_spin": ("qd", joints + 5),
        "action_norm": ("smoothed", 2),
    }
    array, column = place[name]
    state[array][0, column] = -(AT[name] + offset * 1e-6)
    assert evaluate(device, state, success=AT)["success"][0] == succeeds
    for off in (0.0, -1.0, np.inf):
        assert evaluate(device, state, success={**AT, name: off})["success"][0] == 1


@pytest.mark.parametrize(
    ("offset", "succeeds"), [(-1, 0), (0, 1), (1, 1)], ids=["below", "at", "above"]
)
def test_success_includes_its_rotation_threshold(device, offset, succeeds):
    state = rest()
    state["goal"][:] = [1.0, 0.0, 0.0, 0.0]
    threshold = float(np.float32(np.pi)) + offset * 1e-5
    assert evaluate(device, state, success={"rotation": threshold})["success"][0] == succeeds
