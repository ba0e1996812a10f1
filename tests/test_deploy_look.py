"""A student on a hand sees by the real camera's lens, from where calibration found it to be."""

import numpy as np

from vd.assets_usd.camera_layer import read_camera, write_camera_layer
from vd.assets_usd.hand_data import Intrinsics
from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set
from vd.config import to_dict
from vd.deploy.loop.policy_runner import Sensed, StudentRunner, load_runner
from vd.envs.cfg import ReorientCfg
from vd.sensors.cfg import DepthCameraCfg
from vd.stopping import StoppingRule
from vd.vision.cfg import PRESETS
from vd.vision.network import Student
from vd.vision.saved import SavedStudent, StudentSpec

SHIFT_M = 0.01


LENS = Intrinsics(64, 36, 55.0, 55.0, 31.0, 19.0)
"""Another one than the training's."""


def make_student(**rules):
    """A student of stage 2 with random weights."""
    network = PRESETS["small"]
    task, depth = to_dict(ReorientCfg(hand="dclaw3", objects=("cube",))), to_dict(DepthCameraCfg(points=500))
    return SavedStudent(
        StudentSpec(network=network, num_actions=9, stage=2, **rules),
        Student(network, 9).eval(),
        task,
        depth,
        1,
        1,
    )


def test_a_runner_stops_by_the_rule_for_its_tolerance():
    near, precise = StoppingRule(0.37, 2.0), StoppingRule(0.07, 0.9)
    hand, (item,) = load_hand("dclaw3"), load_set("cube")
    student = make_student(stopping=near, precise=precise)
    assert StudentRunner(student, hand, item).rule == near
    assert StudentRunner(student, hand, item, tolerance_rad=0.1).rule == precise


def test_installed_trackers_stop_by_rules_from_episodes_and_say_where_there_is_none():
    (item,) = load_set("cube")
    for name in ("dclaw3", "dclaw4"):
        hand = load_hand(name)
        runners = {
            tolerance: load_runner(f"{name}-tracking", name, hand, item, tolerance_rad=tolerance)
            for tolerance in (0.4, 0.2, 0.1)
        }
        assert [runner.calibrated for runner in runners.values()] == [True, False, True]
        bounds = [runner.rule.distance_rad for runner in runners.values()]
        assert bounds[0] > bounds[1] > bounds[2] > 0.0


def test_lens_and_place_are_those_of_the_real_camera(tmp_path):
    hand = load_hand("dclaw3")
    runner = StudentRunner(make_student(), hand, load_set("cube")[0])
    zero, image = np.zeros(9), np.full((36, 64), 0.6, dtype=np.float32)
    sensed = Sensed(zero, zero, zero, np.array([0.0, 0.0, 0.0, 1.0]), depth=image)

    def middle():
        points = runner.sight.points(runner.frame(sensed))[0, runner.sight.ends[1] :].numpy()
        return points[np.isfinite(points).all(axis=1)]

    runner.look_by(LENS.seen_from(runner.camera))
    before = middle()
    # Every point is one of the image by this lens, from the place of the training.
    seen = runner.camera.project(before)
    assert len(before) == len(seen) > 100
    np.testing.assert_allclose(seen[:, 2], 0.6, atol=1e-5)
    np.testing.assert_allclose(seen[:, :2] % 1.0, 0.5, atol=2e-3)

    place = np.concatenate([hand.camera.position, hand.camera.quaternion])
    place[1] += SHIFT_M
    write_camera_layer(tmp_path / "camera.usda", hand, place, {})
    runner.look_by(LENS.seen_from(read_camera(hand, tmp_path / "camera.usda")))
    # Sideways in the base is level: the crop by height keeps the same pixels.
    np.testing.assert_allclose(np.sort(middle()[:, 1]), np.sort(before[:, 1]) + SHIFT_M, atol=1e-5)
