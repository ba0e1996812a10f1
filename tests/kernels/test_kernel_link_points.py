import numpy as np
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import (
    EXAMPLES,
    device_array,
    floats,
    launch,
    pose_matrix,
    quaternions,
    transforms,
    unwritten,
)

from vd.kernels.sensor.link_points import CloudModel, link_points_kernel

BASE, OBJECT = 0, 1
GOAL_POSITION = np.array([0.1, -0.2, -0.08])


def cloud_model(hand, body, samples, world_object, world_scale, device, shown=None):
    model = CloudModel()
    model.hand_points = device_array(hand, wp.vec3, device)
    model.hand_body = device_array(body, int, device)
    model.object_points = device_array(samples, wp.vec3, device)
    model.goal_points = device_array(samples if shown is None else shown, wp.vec3, device)
    model.world_object = device_array(world_object, int, device)
    model.world_scale = device_array(world_scale, float, device)
    model.base_body, model.object_body = BASE, OBJECT
    model.goal_position = wp.vec3(*GOAL_POSITION)
    return model


@st.composite
def scenes(draw):
    """Samples of hand and objects, and the poses that carry them."""
    worlds, rows = draw(st.integers(1, 3)), draw(st.integers(1, 4))
    bodies, hand = draw(st.integers(2, 4)), draw(st.integers(1, 6))
    objects, samples = draw(st.integers(1, 3)), draw(st.integers(1, 4))

    def indices(count, highest):
        return np.array(draw(st.lists(st.integers(0, highest - 1), min_size=count, max_size=count)))

    return {
        "hand": draw(floats((hand, 3), -0.1, 0.1)),
        "body": indices(hand, bodies),
        "samples": draw(floats((objects, samples, 3), -0.05, 0.05)),
        "world_object": indices(worlds, objects),
        "world_scale": draw(floats((worlds,), 0.9, 1.1)),
        "world": indices(rows, worlds),
        "body_q": draw(transforms((rows, bodies))),
        "goal": draw(quaternions((rows,))),
    }


def expected_points(scene):
    """Goal, hand, object in the base frame by homogeneous matrices, row by row."""
    clouds = []
    for row, poses in enumerate(pose_matrix(scene["body_q"])):
        world = scene["world"][row]
        to_base = np.linalg.inv(poses[BASE])

        def carry(matrix, points, to_base=to_base):
            return (to_base @ matrix @ np.append(points, np.ones((len(points), 1)), axis=1).T).T[:, :3]

        hand = [
            carry(poses[b], p[None])[0]
            for b, p in zip(scene["body"], scene["hand"].astype(float), strict=True)
        ]
        item = scene["samples"][scene["world_object"][world]].astype(float) * scene["world_scale"][world]
        turn = pose_matrix(np.append(np.zeros(3), scene["goal"][row]))[:3, :3]
        goal = (to_base[:3, :3] @ turn @ item.T).T + GOAL_POSITION
        clouds.append(np.concatenate([goal, hand, carry(poses[OBJECT], item)]))
    return np.array(clouds)


def points_of(scene, device, *, with_object=True, spare=0, shown=None):
    hand, samples = len(scene["hand"]), scene["samples"].shape[1]
    rows = len(scene["goal"])
    model = cloud_model(
        *(scene[key] for key in ("hand", "body", "samples", "world_object", "world_scale")),
        device,
        shown,
    )
    columns = hand + samples * (2 if with_object else 1)
    out = unwritten((rows, columns + spare), wp.vec3, device)
    launch(
        link_points_kernel,
        (rows, columns),
        [model, scene["world"], scene["body_q"], scene["goal"], out],
        device,
    )
    return out.numpy()


@EXAMPLES
@given(scene=scenes())
def test_points_match_homogeneous_matrices(device, scene):
    np.testing.assert_allclose(points_of(scene, device), expected_points(scene), atol=1e-6)


@EXAMPLES
@given(scene=scenes())
def test_a_shorter_launch_leaves_the_object_out_and_room_for_a_camera(device, scene):
    points = points_of(scene, device, with_object=False, spare=3)
    expected = expected_points(scene)[:, : -scene["samples"].shape[1]]
    np.testing.assert_allclose(points[:, :-3], expected, atol=1e-6)
    assert np.isnan(points[:, -3:]).all()


@EXAMPLES
@given(scene=scenes())
def test_a_goal_is_shown_by_samples_of_its_own(device, scene):
    """Those of a scan, for example: here the same in another order."""
    goal = scene["samples"].shape[1]
    expected, points = expected_points(scene), points_of(scene, device, shown=scene["samples"][:, ::-1])
    np.testing.assert_allclose(points[:, goal:], expected[:, goal:], atol=1e-6)
    np.testing.assert_allclose(points[:, :goal], expected[:, :goal][:, ::-1], atol=1e-6)
