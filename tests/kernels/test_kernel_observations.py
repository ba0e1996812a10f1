import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import (
    ALPHA,
    EXAMPLES,
    floats,
    goals,
    launch,
    pose_matrix,
    quaternions,
    relative_quaternion,
    streams,
    transforms,
)
from scipy import stats

from vd.kernels.task.observations import (
    fingertip_kernel,
    teacher_observation_kernel,
    teacher_observation_size,
    teacher_observation_slices,
)
from vd.paper import PAPER


@st.composite
def scenes(draw: st.DrawFn) -> dict[str, np.ndarray]:
    """A state of N worlds with a hand of 3 or 4 fingers, and everything the observation is made of."""
    fingers, worlds = draw(st.sampled_from([3, 4])), draw(st.integers(1, 3))
    joints, bodies = 3 * fingers, 3 * fingers + 2
    orientation = draw(quaternions((worlds,)))
    return {
        "lower": draw(floats((joints,), -2, -0.4)),
        "upper": draw(floats((joints,), 0.4, 2)),
        "tip_body": np.array(draw(st.permutations(range(bodies)))[:fingers]),
        "tip_offset": draw(transforms((fingers,))),
        "body_com": draw(floats((bodies, 3), -0.1, 0.1)),
        "q": np.concatenate([draw(floats((worlds, joints + 3))), orientation], axis=1),
        "measured_q": draw(floats((worlds, joints))),
        "measured_qd": draw(floats((worlds, joints), -5, 5)),
        "qd": draw(floats((worlds, joints + 6), -5, 5)),
        "body_q": draw(transforms((worlds, bodies))),
        "body_qd": draw(floats((worlds, bodies, 6), -3, 3)),
        "goal": draw(goals(orientation)),
        "smoothed": draw(floats((worlds, joints), -1, 1)),
        "offset": draw(
            floats((worlds, teacher_observation_size(fingers, 3 * fingers)), -0.01, 0.01)
        ),
    }


def observe(
    device, scene, *, noise_mean=0.0, noise_std=0.0, seed=0, file_axes=True, canonical=False
):
    """Launch the kernel on a scene; returns observation and streams."""
    worlds = len(scene["q"])
    params = {
        "velocity_scale": PAPER.observation.velocity_scale,
        "noise_mean": noise_mean,
        "noise_std": noise_std,
        "file_axes": float(file_axes),
        "canonical": float(canonical),
    }
    rng = streams(worlds, seed, device)
    model = [scene[name] for name in ("lower", "upper", "tip_body", "tip_offset", "body_com")]
    names = [
        "measured_q",
        "measured_qd",
        "q",
        "qd",
        "body_q",
        "body_qd",
        "goal",
        "smoothed",
        "offset",
    ]
    inputs = [*model, params, *(scene[name] for name in names), rng]
    shape = (worlds, teacher_observation_size(len(scene["tip_body"]), 3 * len(scene["tip_body"])))
    return launch(teacher_observation_kernel, worlds, inputs, device, shape)[0], rng.numpy()


def expected_observation(scene):
    """The observation without noise and offset, computed part by part in float64."""
    joints = len(scene["lower"])
    worlds, fingers = len(scene["q"]), len(scene["tip_body"])
    q, qd = scene["q"].astype(np.float64), scene["qd"].astype(np.float64)
    middle, half = (scene["upper"] + scene["lower"]) / 2.0, (scene["upper"] - scene["lower"]) / 2.0
    body = pose_matrix(scene["body_q"])[:, scene["tip_body"]]
    tip = body @ pose_matrix(scene["tip_offset"])
    com = (
        np.einsum("nfij,fj->nfi", body[..., :3, :3], scene["body_com"][scene["tip_body"]])
        + body[..., :3, 3]
    )
    linear, angular = np.split(
        scene["body_qd"][:, scene["tip_body"]].astype(np.float64), 2, axis=-1
    )
    tip_quat = np.empty((worlds, fingers, 4))
    for f in range(fingers):  # the sign of the product quaternion is part of the observation
        inverse_offset = scene["tip_offset"][f, 3:] * [-1, -1, -1, 1]
        tip_quat[:, f] = relative_quaternion(
            scene["body_q"][:, scene["tip_body"][f], 3:], inverse_offset
        )
    tips = np.concatenate(
        [tip[..., :3, 3], tip_quat, linear + np.cross(angular, tip[..., :3, 3] - com), angular],
        axis=-1,
    )
    return np.concatenate(
        [
            (scene["measured_q"].astype(np.float64) - middle) / half,
            0.2 * scene["measured_qd"].astype(np.float64),
            q[:, joints:],
            qd[:, joints : joints + 3],
            0.2 * qd[:, joints + 3 :],
            scene["goal"],
            relative_quaternion(q[:, joints + 3 :], scene["goal"]),
            tips.reshape(worlds, -1),
            scene["smoothed"],
        ],
        axis=1,
    )


def measured(fingers):
    """Mask of the columns that a sensor measures."""
    slices = teacher_observation_slices(fingers, 3 * fingers)
    mask = np.ones(teacher_observation_size(fingers, 3 * fingers), bool)
    mask[slices["goal_orientation"]] = False
    mask[slices["previous_action"]] = False
    return mask


@EXAMPLES
@given(scene=scenes(), file_axes=st.booleans())
def test_observation_matches_the_oracle(device, scene, file_axes):
    """Without the axes of the file the orientations that are in them are zeros."""
    out, _ = observe(device, scene, file_axes=file_axes)
    expected = expected_observation(scene)
    mask = measured(len(scene["tip_body"]))
    expected[:, mask] += scene["offset"][:, mask]
    slices = teacher_observation_slices(len(scene["tip_body"]), 3 * len(scene["tip_body"]))
    for name in ("object_orientation", "goal_orientation"):
        expected[:, slices[name]] *= file_axes
    np.testing.assert_allclose(out, expected, rtol=1e-5, atol=1e-5)


@EXAMPLES
@given(scene=scenes())
def test_canonical_orientations_do_not_tell_which_quaternion_they_came_from(device, scene):
    scene["offset"][:] = 0.0
    out, _ = observe(device, scene, canonical=True)
    expected = expected_observation(scene)
    slices = teacher_observation_slices(len(scene["tip_body"]), 3 * len(scene["tip_body"]))
    for name in ("object_orientation", "goal_orientation", "relative_orientation"):
        for row in expected[:, slices[name]]:
            first = next(v for v in row[[3, 0, 1, 2]] if abs(v) > 1e-7)
            row *= np.sign(first)
        # A rotation by half a turn, to rounding, is either of the two.
        turned = np.abs(out[:, slices[name]][:, 3]) < 1e-6
        found, wanted = out[:, slices[name]][~turned], expected[:, slices[name]][~turned]
        np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-5)
    joints = len(scene["lower"])
    for object_sign in (1.0, -1.0):
        for goal_sign in (1.0, -1.0):
            q = scene["q"].copy()
            q[:, joints + 3 :] *= object_sign
            same, _ = observe(
                device, scene | {"q": q, "goal": goal_sign * scene["goal"]}, canonical=True
            )
            np.testing.assert_array_equal(same, out)


@EXAMPLES
@given(scene=scenes())
def test_fingertip_positions_are_those_observed(device, scene):
    shape = (len(scene["q"]), len(scene["tip_body"]))
    inputs = [scene["tip_body"], scene["tip_offset"], scene["body_q"]]
    (out,) = launch(fingertip_kernel, shape, inputs, device, shape)
    tip = pose_matrix(scene["body_q"])[:, scene["tip_body"]] @ pose_matrix(scene["tip_offset"])
    np.testing.assert_allclose(out, tip[..., :3, 3], atol=1e-6)


def uniform_scene(fingers, worlds):
    """The same resting state in every world."""
    joints = 3 * fingers
    pose = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    still = {
        "q": np.append(np.zeros(joints), pose),
        "qd": np.zeros(joints + 6),
        "body_q": np.tile(pose, (joints, 1)),
        "body_qd": np.zeros((joints, 6)),
        "goal": pose[3:],
        "offset": np.zeros(teacher_observation_size(fingers, 3 * fingers)),
        **dict.fromkeys(("measured_q", "measured_qd", "smoothed"), np.zeros(joints)),
    }
    hand = {
        "lower": np.full(joints, -2.0),
        "upper": np.full(joints, 2.0),
        "tip_body": np.arange(fingers),
    }
    hand |= {"tip_offset": np.tile(pose, (fingers, 1)), "body_com": np.zeros((joints, 3))}
    return hand | {
        name: np.broadcast_to(value, (worlds, *value.shape)) for name, value in still.items()
    }


@pytest.mark.parametrize("fingers", [3, 4])
def test_noise_of_table_s3_on_measured_values_only(device, fingers):
    mean, std = PAPER.observation.noise_mean, PAPER.observation.noise_std
    scene = uniform_scene(fingers, 20_000)
    clean, _ = observe(device, scene)
    noisy, rng = observe(device, scene, noise_mean=mean, noise_std=std, seed=9)
    mask = measured(fingers)
    np.testing.assert_array_equal(noisy[:, ~mask], clean[:, ~mask])
    noise = (noisy - clean)[:, mask]
    bound = 6 / np.sqrt(len(noise))
    np.testing.assert_allclose(noise.mean(axis=0), mean, atol=std * bound)
    np.testing.assert_allclose(noise.std(axis=0), std, rtol=bound)
    assert stats.kstest((noise[:, 0] - mean) / std, stats.norm.cdf).pvalue > ALPHA
    assert np.abs(np.corrcoef(noise.T) - np.eye(mask.sum())).max() < bound, "values share noise"
    assert np.abs(np.corrcoef(noise[:50]) - np.eye(50)).max() < 0.7, "worlds share noise"
    assert not np.any(rng == streams(len(noise), 9, device).numpy()), "the streams did not advance"
