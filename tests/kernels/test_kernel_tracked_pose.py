import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, device_array, floats, launch, quaternions, streams
from scipy.spatial.transform import Rotation

from vd.kernels.task.tracked_pose import (
    CAME,
    FIRST,
    begin_tracked_pose_kernel,
    hold_pose_kernel,
    take_pose_kernel,
)

SLOTS, DT = 64, 1.0 / 120.0


def settings(**changes) -> dict:
    """A tracker without errors."""
    none = {
        "rate_hz": wp.vec2(10.0, 30.0),
        "age_s": wp.vec2(0.03, 0.15),
        "dropped": 0.0,
        "jumping": 0.0,
        "jump": wp.vec2(),
        "noise": wp.vec2(),
    }
    return none | changes


@EXAMPLES
@given(
    rate=st.floats(5.0, 40.0),
    delay=st.floats(0.0, 0.2),
    phase=st.floats(0.0, 0.99),
    steps=st.lists(st.integers(1, 20), min_size=1, max_size=8),
    dropped=st.sampled_from([0.0, 1.0]),
)
def test_the_newest_pose_that_came_is_told_with_its_age(device, rate, delay, phase, steps, dropped):
    """Of poses at phase / rate - delay + k / rate, each comes its delay later."""
    kinds = {"rng": streams(1, 0, device)}
    state = {name: device_array([0.0], float, device) for name in ("clock", "latency")}
    state["due"] = device_array([phase / rate - delay], float, device)
    whole = {name: device_array([0], wp.int32, device) for name in ("head", "came")}
    head, now, held, nearest = 0, 0.0, None, np.inf
    due = float(np.float32(phase / rate - delay))
    for count in steps:
        head = (head + count) % SLOTS
        now += count * DT
        given_now = [np.array([rate]), np.array([delay]), np.array([head])]
        changing = [kinds["rng"], whole["head"], state["clock"], state["due"]]
        both = [state["latency"], whole["came"]]
        launch(
            take_pose_kernel,
            1,
            [settings(dropped=dropped), SLOTS, DT, *given_now, *changing, *both],
            device,
        )
        came = False
        while due + delay <= now:
            nearest = min(nearest, now - due - delay)
            held, came = due, dropped == 0.0
            due += 1.0 / rate
        nearest = min(nearest, due + delay - now)
        if nearest < 1e-4:
            return  # rounding decides
        assert whole["came"].numpy()[0] == (CAME if came else 0)
        wanted = now if held is None or dropped else now - held
        assert state["latency"].numpy()[0] == pytest.approx(wanted, abs=1e-4)


def test_rates_delays_and_phases_are_drawn_in_their_ranges_and_others_stay(device):
    worlds = 2000
    mask = np.arange(worlds) % 4 != 0
    inputs = [settings(), mask, np.full(worlds, 7), streams(worlds, 3, device)]
    found = launch(begin_tracked_pose_kernel, worlds, inputs, device, *[worlds] * 8)
    rate, delay, clock, head, due, held_s, latency, came = (values[mask] for values in found)
    assert np.isnan(found[0][~mask]).all() and (found[7][~mask] != FIRST).all()
    for values, low, high in ((rate, 10.0, 30.0), (delay, 0.03, 0.15)):
        assert low <= values.min() < values.max() <= high
        assert abs(values.mean() - (low + high) / 2) < 0.05 * (high - low)
    phase = (due + delay) * rate
    assert phase.min() >= -1e-5 and phase.max() <= 1.0 and abs(phase.mean() - 0.5) < 0.05
    np.testing.assert_allclose((due - held_s) * rate, 1.0, atol=1e-4)
    assert not clock.any() and not latency.any() and (head == 7).all() and (came == FIRST).all()


@EXAMPLES
@given(data=st.data(), came=st.sampled_from([0, CAME, FIRST]), between=st.floats(0.03, 0.3))
def test_a_pose_is_held_until_the_next_and_velocity_is_their_difference(
    device, data, came, between
):
    joints, worlds = 4, 2
    pose = np.concatenate([data.draw(floats((worlds, 3))), data.draw(quaternions((worlds,)))], 1)
    before = np.concatenate([data.draw(floats((worlds, 3))), data.draw(quaternions((worlds,)))], 1)
    q = np.concatenate([data.draw(floats((worlds, joints))), pose], axis=1)
    qd = data.draw(floats((worlds, joints + 6)))
    twist = data.draw(floats((worlds, 6)))
    clock, age = np.full(worlds, 2.0), np.full(worlds, 0.1)
    held = device_array(before, wp.transform, device)
    held_s = device_array(clock - age - between, float, device)
    came_there = device_array(np.full(worlds, came), wp.int32, device)
    inputs = [settings(), clock, age, q, qd, streams(worlds, 0, device), came_there, held_s, held]
    told_q, told_qd = launch(
        hold_pose_kernel,
        worlds,
        [*inputs, device_array(twist, wp.spatial_vector, device)],
        device,
        q.shape,
        qd.shape,
    )
    np.testing.assert_array_equal(told_q[:, :joints], q[:, :joints])
    np.testing.assert_array_equal(told_qd[:, :joints], qd[:, :joints])
    wanted, velocity = before, twist
    if came == FIRST:
        wanted, velocity = pose, np.zeros((worlds, 6))
    if came == CAME:
        turn = Rotation.from_quat(pose[:, 3:]) * Rotation.from_quat(before[:, 3:]).inv()
        if (turn.magnitude() > np.pi - 0.01).any():
            return  # either way round
        moved = pose[:, :3] - before[:, :3]
        wanted, velocity = pose, np.concatenate([moved, turn.as_rotvec()], axis=1) / between
    np.testing.assert_allclose(told_q[:, joints:], wanted, atol=1e-6)
    np.testing.assert_allclose(told_qd[:, joints:], velocity, atol=2e-3, rtol=2e-3)
    assert not came_there.numpy().any()
    wanted_s = 1.9 if came == CAME else 1.9 - between
    np.testing.assert_allclose(held_s.numpy(), wanted_s, atol=1e-5)


def test_jumps_and_noise_have_their_share_and_size(device):
    worlds, jump, noise = 4000, (0.02, 0.5), (0.001, 0.02)
    q = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (worlds, 1))
    found = {}
    for name, change in (
        ("jump", {"jump": wp.vec2(*jump), "jumping": 0.25}),
        ("noise", {"noise": wp.vec2(*noise)}),
    ):
        zeros = np.zeros(worlds)
        start = device_array(q, wp.transform, device)
        twist = device_array(np.zeros((worlds, 6)), wp.spatial_vector, device)
        inputs = [settings(**change), zeros, zeros, q, np.zeros((worlds, 6))]
        state = [streams(worlds, 1, device), np.full(worlds, CAME), zeros - 1.0, start, twist]
        told, _ = launch(hold_pose_kernel, worlds, [*inputs, *state], device, q.shape, (worlds, 6))
        found[name] = told[:, :3], Rotation.from_quat(told[:, 3:]).as_rotvec()
    for vectors, length in zip(found["jump"], jump, strict=True):
        sizes = np.linalg.norm(vectors, axis=1)
        away = sizes > 1e-6
        assert abs(away.mean() - 0.25) < 0.03
        np.testing.assert_allclose(sizes[away], length, rtol=1e-4)
        assert np.abs(vectors[away].mean(axis=0)).max() < 0.1 * length
    for vectors, std in zip(found["noise"], noise, strict=True):
        np.testing.assert_allclose(vectors.std(axis=0), std, rtol=0.05)
        assert np.abs(vectors.mean(axis=0)).max() < 0.1 * std


def test_dropped_poses_have_their_share(device):
    worlds = 2000
    came = device_array(np.zeros(worlds), wp.int32, device)
    zeros = [device_array(np.zeros(worlds), float, device) for _ in range(3)]
    inputs = [settings(dropped=0.3), SLOTS, DT, np.full(worlds, 12.0), np.zeros(worlds)]
    head = device_array(np.zeros(worlds), wp.int32, device)
    changing = [streams(worlds, 5, device), head, *zeros, came]
    zeros[1].fill_(0.01)  # one pose is due in the next 10 steps
    launch(take_pose_kernel, worlds, [*inputs, np.full(worlds, 10), *changing], device)
    assert abs((came.numpy() == CAME).mean() - 0.7) < 0.04
