import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, device_array, floats, pose_matrix, quaternions, transforms, unwritten

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


def launch(scene, device, *, with_object=True, spare=0, shown=None):
    hand, samples = len(scene["hand"]), scene["samples"].shape[1]
    rows = len(scene["goal"])
    model = cloud_model(
        *(scene[key] for key in ("hand", "body", "samples", "world_object", "world_scale")),
        device,
        shown,
    )
    columns = hand + samples * (2 if with_object else 1)
    out = unwritten((rows, columns + spare), wp.vec3, device)
    wp.launch(
        link_points_kernel,
        dim=(rows, columns),
        inputs=[
            model,
            device_array(scene["world"], int, device),
            device_array(scene["body_q"], wp.transform, device),
            device_array(scene["goal"], wp.quat, device),
        ],
        outputs=[out],
        device=device,
    )
    return out.numpy()


@EXAMPLES
@given(scene=scenes())
def test_points_match_homogeneous_matrices(device, scene):
    np.testing.assert_allclose(launch(scene, device), expected_points(scene), atol=1e-6)


@EXAMPLES
@given(scene=scenes())
def test_a_shorter_launch_leaves_the_object_out_and_room_for_a_camera(device, scene):
    points = launch(scene, device, with_object=False, spare=3)
    expected = expected_points(scene)[:, : -scene["samples"].shape[1]]
    np.testing.assert_allclose(points[:, :-3], expected, atol=1e-6)
    assert np.isnan(points[:, -3:]).all()


@EXAMPLES
@given(scene=scenes())
def test_a_goal_is_shown_by_samples_of_its_own(device, scene):
    """Those of a scan, for example: here the same in another order."""
    goal = scene["samples"].shape[1]
    expected, points = expected_points(scene), launch(scene, device, shown=scene["samples"][:, ::-1])
    np.testing.assert_allclose(points[:, goal:], expected[:, goal:], atol=1e-6)
    np.testing.assert_allclose(points[:, :goal], expected[:, :goal][:, ::-1], atol=1e-6)


def test_goal_reached_means_equal_clouds_but_for_the_place(device):
    """Where the object has the wanted orientation, object and goal clouds differ by a translation."""
    generator = np.random.default_rng(0)
    samples = generator.normal(size=(1, 20, 3)).astype(np.float32) * 0.03
    quat = generator.normal(size=4)
    quat /= np.linalg.norm(quat)
    poses = np.array([[[0, 0, 0.25, 0, 1, 0, 0], [0.01, 0.02, 0.1, *quat]]], np.float32)
    scene = {
        "hand": np.zeros((1, 3), np.float32),
        "body": [0],
        "samples": samples,
        "world_object": [0],
        "world_scale": [1.05],
        "world": [0],
        "body_q": poses,
        "goal": quat[None].astype(np.float32),
    }
    points = launch(scene, device)[0]
    shift = points[:20] - points[21:]
    np.testing.assert_allclose(shift, np.tile(shift[0], (20, 1)), atol=1e-6)
    # the base looks down: 0.15 m below it is +0.15 along its z, and x is mirrored
    np.testing.assert_allclose(shift[0], GOAL_POSITION - [-0.01, 0.02, 0.15], atol=1e-6)


@pytest.mark.skipif(not wp.is_cuda_available(), reason="graphs are captured on CUDA")
def test_the_launch_can_be_captured():
    device = "cuda:0"
    model = cloud_model(np.ones((1, 3)), [0], np.ones((1, 1, 3)), [0], [1.0], device)
    poses = wp.array(np.tile([0, 0, 0, 0, 0, 0, 1.0], (1, 2, 1)), dtype=wp.transform, device=device)
    world = wp.zeros(1, dtype=int, device=device)
    goal = wp.array([[0, 0, 0, 1.0]], dtype=wp.quat, device=device)
    out = unwritten((1, 3), wp.vec3, device)
    with wp.ScopedCapture(device=device) as capture:
        wp.launch(
            link_points_kernel, dim=(1, 3), inputs=[model, world, poses, goal], outputs=[out], device=device
        )
    wp.capture_launch(capture.graph)
    np.testing.assert_allclose(out.numpy()[0, 1], [1.0, 1.0, 1.0])
