"""When a hand is stuck and opens, against a NumPy oracle that keeps its own counts."""

import numpy as np
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, device_array, settings_array, unwritten

from vd.kernels.retries import RetryParams, retry_kernel

JOINTS, STEP = 3, 0.25


def oracle(open_q, settings, seen):
    """Actions of one world over its steps, by looking back instead of counting."""
    beyond, speed, still_steps, open_steps = settings
    actions, quiet, until = [], [], -1
    for t, (action, q, qd, distance, predicted, steps) in enumerate(seen):
        if steps == 0:
            quiet, until = [], -1
        if t > until:
            error = predicted if predicted >= 0.0 else distance
            quiet = [*quiet, error > beyond and np.linalg.norm(qd) <= speed]
            if len(quiet) >= still_steps and all(quiet[-still_steps:]):
                quiet, until = [], t + open_steps - 1
        opened = np.clip((open_q - q) / STEP, -1.0, 1.0)
        actions.append(opened if t <= until else action)
    return np.array(actions)


@EXAMPLES
@given(seed=st.integers(0, 2**31), worlds=st.integers(1, 4), still=st.integers(1, 3), opens=st.integers(1, 3))
def test_stuck_hands_open_and_others_act(device, seed, worlds, still, opens):
    random = np.random.default_rng(seed)
    steps = 16
    open_q = random.uniform(-1, 1, JOINTS).astype(np.float32)
    action = random.uniform(-1, 1, (steps, worlds, JOINTS)).astype(np.float32)
    q = random.uniform(-1, 1, (steps, worlds, JOINTS + 2)).astype(np.float32)
    # Speeds and distances well to either side of their bounds, mostly still and far.
    qd = np.where(random.random((steps, worlds, 1)) < 0.8, 0.01, 2.0) * np.ones(JOINTS + 2)
    distance = np.where(random.random((steps, worlds)) < 0.8, 1.0, 0.1)
    predicted = random.choice([-1.0, -1.0, 0.1, 1.0], (steps, worlds))
    count = np.where(random.random((steps, worlds)) < 0.1, 0, 5)

    params = settings_array(
        RetryParams, device, beyond=0.4, joint_speed=0.3, still_steps=still, open_steps=opens, step_rad=STEP
    )
    stills, opening = (device_array(np.zeros(worlds), int, device) for _ in range(2))
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
                device_array(qd[t], float, device),
                device_array(distance[t], float, device),
                device_array(predicted[t], float, device),
                device_array(count[t], int, device),
                stills,
                opening,
            ],
            outputs=[out],
            device=device,
        )
        found.append(out.numpy())
    for world in range(worlds):
        seen = [
            (action[t, world], q[t, world, :JOINTS], qd[t, world, :JOINTS], distance[t, world],
             predicted[t, world], count[t, world])
            for t in range(steps)
        ]  # fmt: skip
        expected = oracle(open_q, (0.4, 0.3, still, opens), seen)
        assert np.allclose(np.array(found)[:, world], expected, atol=1e-5)
