"""A tracking policy at work, in a simulator or on a robot."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from vd.assets_usd.hand_data import CameraModel, HandModel
from vd.assets_usd.objects.model import ObjectModel
from vd.envs.cfg import ReorientCfg
from vd.geometry.arrays import Array, library_of
from vd.geometry.frame_maps import FrameMaps
from vd.policy.senses import CameraDecision, Senses
from vd.tracking.camera_observer import CameraObserver
from vd.tracking.policy import TrackingPolicy


class Tracker:
    """Finds the objects of N hands, and lets the teacher act on them.

    ``camera`` is posed in the base frame. By default there is one hand, with the first object in
    its size; else ``world_object`` and ``world_scale`` [N] tell the objects of the hands, and size
    factors.

    Attributes:
        observer: Finds and follows the objects.
    """

    def __init__(
        self,
        policy: TrackingPolicy,
        hand: HandModel,
        objects: Sequence[ObjectModel],
        camera: CameraModel,
        *,
        world_object: np.ndarray | None = None,
        world_scale: np.ndarray | None = None,
        device: str = "cpu",
    ):
        teacher = policy.teacher
        task = ReorientCfg.of(policy)
        objects_of = np.zeros(1, dtype=int) if world_object is None else world_object
        place = wp.device_to_torch(device)
        self._teacher: Any = teacher.network.to(place)
        self._xp = xp = library_of(self._teacher.offset)
        self.observer = CameraObserver(
            hand,
            objects,
            teacher.num_observations,
            world_object=objects_of,
            world_scale=np.ones(len(objects_of)) if world_scale is None else world_scale,
            camera=camera,
            control_hz=task.sim.control_hz,
            alignment=policy.alignment,
            device=device,
            library=xp,
        )

        def array(values: Any, dtype: str) -> Array:
            return xp.asarray(values, dtype=getattr(xp, dtype), device=place, copy=True)

        seen = task.observation
        self._maps: FrameMaps | None = None
        if seen.view != "world":
            self._maps = FrameMaps(hand, seen, array)

    @property
    def pose(self) -> Array:
        """Where the objects' frames are believed to be, base frame [N, 7]."""
        return self.observer.finder.pose[:, 0]

    def step(self, senses: Senses) -> CameraDecision:
        """One control step: see, find, observe, choose a symmetry frame, act."""
        observation, angle = self.observer(senses)
        if self._maps is None:
            action = self._teacher(self._guessed(observation))
        else:
            frame = self._maps.choose(observation)  # in whose sector the goal is believed to lie
            action = self._teacher(self._guessed(self._maps.take(observation, frame)))
            action = self._maps.world_action(action, frame)
        found = self.observer.found
        assert found is not None
        return CameraDecision(action, angle, found.position, found.orientation, found.voxels)

    def _guessed(self, seen: Array) -> Array:
        """Observations as a frame shows them [N, O], with the teacher's mean for what no camera shows."""
        return self._xp.where(self.observer.known > 0.0, seen, self._teacher.offset)
