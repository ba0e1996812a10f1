"""What the preflight finds of a camera.

One that is as it should be, and each thing that can be wrong.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from simulated_clock import SimulatedClock

from vd.assets_usd.hand_data import Intrinsics
from vd.assets_usd.hands import load_hand
from vd.deploy.camera.camera import Frame, StaleCamera
from vd.deploy.camera.check_camera import camera_findings

HAND = load_hand("dclaw3")
PLACE = HAND.camera


@dataclass
class Camera:
    """Images of a wall, ``fps`` a second, each ``age_s`` old when it comes."""

    clock: SimulatedClock = field(default_factory=SimulatedClock)
    intrinsics: Intrinsics = PLACE
    fps: float = 30.0
    age_s: float = 0.03
    images: int = 1000
    depth: np.ndarray = field(default_factory=lambda: np.full((180, 320), 0.6, dtype=np.float32))

    def read(self, timeout_s: float) -> Frame:
        """The next image."""
        self.images -= 1
        wait_s = 1.0 / self.fps if self.images >= 0 else np.inf
        self.clock.sleep(min(wait_s, timeout_s))
        if wait_s > timeout_s:
            raise StaleCamera(f"no image from the camera within {timeout_s:.2f} s; check its cable")
        return Frame(self.depth, self.clock.now() - self.age_s)

    def close(self) -> None:
        """Nothing to stop."""


def look(camera: Camera, place=PLACE) -> dict[str, tuple[bool, str]]:
    found = camera_findings(camera, place, HAND.goal_in_base, fps=30.0, clock=camera.clock)
    return {one.what.removeprefix("camera "): (one.ok, one.words) for one in found}


def wrong(found: dict[str, tuple[bool, str]]) -> list[str]:
    return [what for what, (ok, _) in found.items() if not ok]


def test_a_camera_as_it_should_be():
    found = look(Camera())
    assert list(found) == ["streams", "rate", "lens", "depth"] and not wrong(found)
    assert "30.0 images a second, longest gap 33 ms, 30 ms old" in found["rate"][1]
    assert "0.61 m away" in found["lens"][1]
    assert found["depth"][1].startswith("100 % of the pixels have it, 100 % of those around")


@pytest.mark.parametrize("images", [0, 20])
def test_a_camera_that_falls_silent_is_named_and_nothing_else_looked_at(images):
    found = look(Camera(images=images))
    assert wrong(found) == list(found) == ["streams"] and "check its cable" in found["streams"][1]


def test_few_and_old_images_are_named():
    slow = look(Camera(fps=15.0))
    assert wrong(slow) == ["rate"] and "15.0 images a second" in slow["rate"][1]
    old = look(Camera(age_s=0.2))
    assert wrong(old) == ["rate"] and "200 ms old" in old["rate"][1]
    ahead = look(Camera(age_s=-1.0))
    assert wrong(ahead) == ["rate"] and "1.00 s from the future" in ahead["rate"][1]


def test_a_camera_that_looks_elsewhere_is_named():
    turned = replace(PLACE, quaternion=PLACE.quaternion[[3, 2, 1, 0]] * [1, -1, 1, -1])
    found = look(Camera(), turned)
    assert "lens" in wrong(found) and "not in view" in found["lens"][1]


def test_depth_counts_where_the_object_is_handled():
    column, row, _ = PLACE.project(np.array([0.0, 0.0, 0.17]))
    depth = np.full((180, 320), 0.6, dtype=np.float32)
    depth[int(row) - 40 : int(row) + 40, int(column) - 40 : int(column) + 40] = 0.0
    found = look(Camera(depth=depth))
    assert wrong(found) == ["depth"] and "0 % of the pixels" in found["depth"][1]
    # Out of range.
    assert "depth" in wrong(look(Camera(depth=np.full((180, 320), 9.0, dtype=np.float32))))
    rng = np.random.default_rng(0)
    for noise_m, blind in ((0.002, []), (0.03, ["depth"])):
        noisy = rng.normal(0.6, noise_m, (180, 320)).astype(np.float32)
        assert wrong(look(Camera(depth=noisy))) == blind
