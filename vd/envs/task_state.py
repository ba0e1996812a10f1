"""What the parts of the environment share.

The task, its simulation, and arrays of a row an environment.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from vd.assets_usd.hand_model import HandModel
from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.model import ObjectModel
from vd.assets_usd.objects.sets import load_set
from vd.envs.cfg import ReorientCfg
from vd.envs.fingers import Fingers
from vd.envs.parameters import TaskParameters
from vd.envs.servo import needs_servo, servo_ranges
from vd.envs.setup import object_scales
from vd.kernels.rng import init_rng_kernel
from vd.sim.scene import Scene, build_scene
from vd.sim.simulator import Simulator


@dataclass(frozen=True)
class TaskState:
    """N environments with a hand of F fingers and D joints, and an object.

    Arrays are on ``device``.
    """

    cfg: ReorientCfg
    device: str
    hand: HandModel
    objects: list[ObjectModel]
    scene: Scene
    sim: Simulator
    fingers: Fingers
    parameters: TaskParameters
    servo_ranges: Any
    """Range (low, high) of each number of each joint's servo, [D, P, 2]; equal ends are fixed."""
    measured_q: wp.array
    """Joint positions as the encoders report them at the end of the step [rad], shape [N, *]."""
    measured_qd: wp.array
    """Joint velocities likewise: as old as the positions [rad/s], shape [N, *]."""
    lower: wp.array
    """Lower joint limits [rad], shape [D]."""
    upper: wp.array
    """Upper joint limits [rad], shape [D]."""
    smoothed: wp.array
    """Moving average of the applied actions, shape [N, D]."""
    goal_quat: wp.array
    """Wanted orientation of the object, shape [N]."""
    rng: wp.array
    """Random stream of each environment, shape [N]."""
    surface_points: wp.array
    """Samples of each object's surface in its frame, unscaled [m], shape [K, P]."""
    world_object: wp.array
    """Object of each environment, shape [N]."""
    world_scale: wp.array
    """Factor on its size, shape [N]."""
    saved: dict[str, wp.array] = field(default_factory=dict)
    """What changes from step to step, by name."""

    def zeros(self, *shape: int, dtype: Any = float, saved: str = "") -> wp.array:
        """An array of zeros on the task's device, that checkpoints save by this name."""
        array = wp.zeros(shape, dtype=dtype, device=self.device)
        if saved:
            self.saved[saved] = array
        return array

    def launch(
        self,
        kernel: wp.Kernel,
        inputs: list[Any],
        outputs: list[Any],
        *,
        dim: int | tuple[int, ...] = 0,
    ) -> None:
        """Launch a kernel on the task's device; ``dim`` is N unless it is given."""
        wp.launch(
            kernel, dim=dim or self.num_envs, inputs=inputs, outputs=outputs, device=self.device
        )

    @property
    def num_envs(self) -> int:
        """N."""
        return self.cfg.num_envs

    @property
    def num_fingers(self) -> int:
        """F."""
        return self.hand.num_fingers

    @property
    def num_joints(self) -> int:
        """D."""
        return self.hand.num_joints


def build_task(cfg: ReorientCfg, device: str) -> TaskState:
    """Read hand and objects, build the simulation and allocate what is shared.

    Raises:
        ValueError: For a configuration that cannot work, naming field and remedy.
    """
    hand = load_hand(cfg.hand, cfg.fingertip, cfg.hand_layer)
    objects = load_set(list(cfg.objects))
    if hand.palm_up and (cfg.table.away_share > 0.0 or cfg.table.lift_share > 0.0):
        raise ValueError(
            f"{hand.name} looks up, so there is no table: leave table.away_share and "
            f"table.lift_share at 0"
        )
    if cfg.fit_objects:
        objects = [item.fitted(hand.workspace.size_m) for item in objects]
    sizes = hand.workspace.size_m
    scales = [object_scales(cfg.randomisation, item.longest_side, sizes) for item in objects]
    scene = build_scene(
        hand=hand,
        objects=objects,
        num_envs=cfg.num_envs,
        cfg=cfg.sim,
        device=device,
        scales=scales,
        visuals=cfg.visuals,
    )
    ranges = servo_ranges(hand, cfg.randomisation)
    sim = Simulator(
        scene,
        cfg.sim,
        servo_rows=ranges[:, :, 1] if needs_servo(ranges) else None,
        servo_seed=cfg.seed,
    )
    n = cfg.num_envs
    goal = wp.zeros(n, dtype=wp.quat, device=device)
    rng = wp.zeros(n, dtype=wp.uint32, device=device)
    wp.launch(init_rng_kernel, dim=n, inputs=[cfg.seed], outputs=[rng], device=device)
    return TaskState(
        cfg=cfg,
        device=device,
        hand=hand,
        objects=objects,
        scene=scene,
        sim=sim,
        fingers=Fingers(hand, scene, sim),
        parameters=TaskParameters(cfg, hand, device),
        servo_ranges=ranges,
        measured_q=sim.joint_q if sim.servo is None else sim.servo.measured_q,
        measured_qd=sim.joint_qd if sim.servo is None else sim.servo.measured_qd,
        lower=wp.array(hand.lower, dtype=float, device=device),
        upper=wp.array(hand.upper, dtype=float, device=device),
        smoothed=wp.zeros((n, hand.num_joints), dtype=float, device=device),
        goal_quat=goal,
        rng=rng,
        surface_points=wp.array(
            np.stack([item.surface_points for item in objects]), dtype=wp.vec3, device=device
        ),
        world_object=wp.array(scene.world_object, dtype=wp.int32, device=device),
        world_scale=wp.array(scene.world_scale, dtype=float, device=device),
    )
