import numpy as np
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, SENTINEL, floats, indices, launch, quaternions
from scipy.spatial.transform import Rotation

from vd.kernels.task.symmetry import (
    choose_frame_kernel,
    frame_observation_kernel,
    world_action_kernel,
)


@st.composite
def worlds(draw: st.DrawFn) -> dict[str, np.ndarray]:
    """N worlds with new goals or old ones, and F directions."""
    count, frames, joints = (
        draw(st.integers(1, 6)),
        draw(st.integers(1, 4)),
        draw(st.integers(0, 4)),
    )
    orientation = draw(quaternions((count,)))
    return {
        "sector": draw(floats((frames, 3), -1.0, 1.0)),
        "reset": draw(indices(count, 2)),
        "new_goal": draw(indices(count, 2)),
        "q": np.concatenate([draw(floats((count, joints + 3))), orientation], axis=1),
        "goal": draw(quaternions((count,))),
    }


@EXAMPLES
@given(scene=worlds())
def test_a_new_goal_gets_the_view_that_turns_its_axis_nearest(device, scene):
    count, joints = len(scene["reset"]), scene["q"].shape[1] - 7
    frame = wp.full(count, SENTINEL, dtype=wp.int32, device=device)
    inputs = [
        scene["sector"],
        joints,
        *(scene[name] for name in ("reset", "new_goal", "q", "goal")),
    ]
    launch(choose_frame_kernel, count, [*inputs, frame], device)
    turn = Rotation.from_quat(scene["goal"]) * Rotation.from_quat(scene["q"][:, -4:]).inv()
    half = np.sin(turn.magnitude() / 2.0)[:, None]
    axis = turn.as_rotvec() / np.maximum(turn.magnitude(), 1e-12)[:, None] * half
    score = axis @ scene["sector"].astype(float).T
    for world, chosen in enumerate(frame.numpy()):
        if not scene["reset"][world] and not scene["new_goal"][world]:
            assert chosen == SENTINEL, "a frame lasts as long as its goal"
        elif abs(turn.magnitude()[world] - np.pi) > 1e-3:  # at pi both axes are right
            assert score[world, chosen] > score[world].max() - 1e-5


@EXAMPLES
@given(data=st.data())
def test_views_take_observations_apart_and_put_actions_together(device, data):
    count, frames = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 3))
    width, terms = data.draw(st.integers(1, 6)), data.draw(st.integers(1, 3))
    source = data.draw(indices((frames, width, terms), width))
    factor = data.draw(floats((frames, width, terms)))
    offset = data.draw(floats((frames, width)))
    sign = np.sign(data.draw(floats((frames, width))) + 0.5)
    frame = data.draw(indices(count, frames))
    values = data.draw(floats((count, width)))
    dim = (count, width)
    (seen,) = launch(
        frame_observation_kernel, dim, [source, factor, offset, frame, values], device, dim
    )
    (done,) = launch(world_action_kernel, dim, [source[:, :, 0], sign, frame, values], device, dim)
    for world, k in enumerate(frame):
        expected = (factor[k].astype(float) * values[world][source[k]]).sum(axis=1) + offset[k]
        np.testing.assert_allclose(seen[world], expected, atol=1e-5)
        wanted = sign[k] * values[world][source[k, :, 0]]
        assert np.array_equal(done[world], wanted.astype(np.float32))
