"""When a hand is stuck and opens, against a NumPy oracle that keeps its own counts."""

import numpy as np
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, device_array, settings_array, unwritten

from vd.kernels.retries import ANY_DISTANCE, RetryParams, retry_kernel

JOINTS, STEP = 3, 0.25


def oracle(open_q, settings, seen):
    """Actions of one world over its steps, by looking back over the distances since it began."""
    beyond, progress, patience, open_steps = settings
    actions, since, until = [], [], -1
    for t, (action, q, distance, predicted, begins) in enumerate(seen):
        if begins:
            since, until = [], -1
        if t > until:
            since.append(predicted if predicted >= 0.0 else distance)
            if stuck(since, beyond, progress, patience):
                since, until = [], t + open_steps - 1
        actions.append(np.clip((open_q - q) / STEP, -1.0, 1.0) if t <= until else action)
    return np.array(actions)


def stuck(distances, beyond, progress, patience):
    """Whether the last ``patience`` distances are all far, and none makes progress on what was before it."""
    steps, mark = [], np.inf
    for distance in distances:
        moves = distance <= beyond or distance <= mark - progress
        mark = distance if moves else mark
        steps.append(moves)
    return len(steps) >= patience and not any(steps[-patience:])


@EXAMPLES
@given(
    seed=st.integers(0, 2**31), worlds=st.integers(1, 4), patience=st.integers(1, 3), opens=st.integers(1, 3)
)
def test_stuck_hands_open_and_others_act(device, seed, worlds, patience, opens):
    random = np.random.default_rng(seed)
    steps = 20
    open_q = random.uniform(-1, 1, JOINTS).astype(np.float32)
    action = random.uniform(-1, 1, (steps, worlds, JOINTS)).astype(np.float32)
    q = random.uniform(-1, 1, (steps, worlds, JOINTS + 2)).astype(np.float32)
    # Well to either side of the bounds: multiples of 0.2 where 0.1 is progress and 0.5 is near.
    distance = 0.2 * random.integers(2, 6, (steps, worlds))
    predicted = np.where(random.random((steps, worlds)) < 0.5, -1.0, distance[::-1])
    count = np.where(random.random((steps, worlds)) < 0.08, 0, 5)
    new_goal = np.where(random.random((steps, worlds)) < 0.08, 1, 0)

    params = settings_array(
        RetryParams, device, beyond=0.5, progress=0.1, patience=patience, open_steps=opens, step_rad=STEP
    )
    least = device_array(np.full(worlds, ANY_DISTANCE), float, device)
    waited, opening = (device_array(np.zeros(worlds), int, device) for _ in range(2))
    found = []
    for t in range(steps):
        out = unwritten((worlds, JOINTS), float, device)
        wp.launch(
            retry_kernel,
            dim=worlds,
            inputs=[
                device_array(open_q, float, device),
                params,
                device_array(action[t], float, device),
                device_array(q[t], float, device),
                device_array(distance[t], float, device),
                device_array(predicted[t], float, device),
                device_array(count[t], int, device),
                device_array(new_goal[t], int, device),
                least,
                waited,
                opening,
            ],
            outputs=[out],
            device=device,
        )
        found.append(out.numpy())
    for world in range(worlds):
        begins = (count[:, world] == 0) | (new_goal[:, world] == 1)
        columns = (action, q[:, :, :JOINTS], distance, predicted)
        seen = list(zip(*(column[:, world] for column in columns), begins, strict=True))
        expected = oracle(open_q, (0.5, 0.1, patience, opens), seen)
        assert np.allclose(np.array(found)[:, world], expected, atol=1e-5)
