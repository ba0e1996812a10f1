"""Golden values: inputs for the policy of a bundle, and the outputs that have to come back."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import HandModel
from vd.paper import PAPER
from vd.policy import TrainedPolicy

if TYPE_CHECKING:
    from vd.vision.saved import SavedStudent

STATES = 8
"""Observations of a teacher."""
STEPS = 3
"""Control steps of a student, one after the other: memory counts."""
JOINT_STD_RAD = 0.2
"""Spread of the joints about their reset positions."""
VOXEL_MARGIN = 0.1
"""No golden point is nearer to a voxel's border than this share of its side, where rounding would decide."""
TOLERANCE = 5e-3
"""Largest difference of an output from the golden one. Actions are of size 1; processors, GPUs and other
versions of torch differ by 1e-6 to 1e-3."""

SENSES = {"action": "previous_action", "position": "joint_q", "velocity": "joint_qd"}
"""Golden input behind each sense of a student."""

Golden = dict[str, torch.Tensor]


def teacher_golden(policy: TrainedPolicy) -> Golden:
    """Observations [S, O] of size 1 and the actions [S, D] for them."""
    draw = np.random.default_rng(0).normal(size=(STATES, policy.num_observations))
    observation = torch.tensor(draw, dtype=torch.float32)
    return {"observation": observation, **teacher_outputs(policy, {"observation": observation})}


def teacher_outputs(policy: TrainedPolicy, golden: Mapping[str, torch.Tensor]) -> Golden:
    """What a teacher makes of golden inputs."""
    return {"action": policy.act(golden["observation"]).cpu()}


def student_golden(student: "SavedStudent", hand: HandModel) -> Golden:
    """A short episode of clouds, and what the student makes of it.

    Inputs: ``joint_q`` [T, D] [rad]; ``object_pose`` [T, 7] in the base frame; ``goal_quat`` [4] in the world
    frame; ``points`` [T, P, 3] [m], base frame, the cloud that these give with a cube, moved away from the
    borders of voxels; ``previous_action`` [T, D]; ``joint_qd`` [T, D] [rad/s]. Outputs: ``action`` [T, D] and
    ``distance`` [T, H] [rad].
    """
    from vd.assets_usd.objects.sets import load_set
    from vd.sim.scene import hand_mount

    rng = np.random.default_rng(0)
    cube = load_set(["cube"])[0].surface_points
    mount = Rotation.from_quat(list(hand_mount())[3:])
    goal = Rotation.random(rng=rng)
    rest = np.tile(PAPER.scene.reset_joint_rad, hand.num_fingers)
    joint_q = np.clip(rest + JOINT_STD_RAD * rng.normal(size=(STEPS, len(rest))), hand.lower, hand.upper)
    place = np.array([0.0, 0.0, PAPER.scene.hand_height_m - PAPER.scene.goal_position_m[2]])
    turns = Rotation.random(STEPS, rng=rng)
    wanted = (mount.inv() * goal).apply(cube) + PAPER.cloud.goal_position_m
    scenes = [
        np.concatenate([_hand_points(hand, q), turn.apply(cube) + place])
        for q, turn in zip(joint_q, turns, strict=True)
    ]
    side = student.spec.network.voxel_m
    pose = np.concatenate([np.tile(place, (STEPS, 1)), turns.as_quat()], axis=1)
    values = {
        "joint_q": joint_q,
        "object_pose": pose,
        "goal_quat": goal.as_quat(),
        "goal_points": _inside_voxels(np.tile(wanted, (STEPS, 1, 1)), side),
        "scene_points": _inside_voxels(np.stack(scenes), side),
        "previous_action": rng.uniform(-1.0, 1.0, (STEPS, len(rest))),
        "joint_qd": rng.normal(size=(STEPS, len(rest))),
    }
    golden = {name: torch.tensor(value, dtype=torch.float32) for name, value in values.items()}
    return {**golden, **student_outputs(student, golden)}


def student_outputs(student: "SavedStudent", golden: Mapping[str, torch.Tensor]) -> Golden:
    """What a student makes of golden inputs, one step after the other."""
    from vd.vision.sight import voxels
    from vd.vision.voxels import Voxeliser

    network, cfg = student.network, student.spec.network
    device = str(network.mean.weight.device)
    voxelise = Voxeliser(cfg.voxel_m, device=device)
    clouds = torch.cat([golden["goal_points"], golden["scene_points"]], dim=1)
    # The cube has as many points as the goal, which is the same cube.
    ends = (golden["goal_points"].shape[1], golden["scene_points"].shape[1])
    hidden = network.initial_hidden(1)
    actions, distances = [], []
    with torch.no_grad():
        for step, points in enumerate(clouds):
            frame = {
                name: golden[source][step : step + 1].to(device)
                for name, source in SENSES.items()
                if source in golden
            }
            cloud = points[None].contiguous().to(device)
            sites = voxels(cloud, ends, voxelise, network=cfg, augment=False)
            output = network.act(sites[0], network.senses(frame), hidden, *sites[1:])
            hidden = output.hidden
            actions.append(output.mean[0])
            distances.append(output.distance[0])
    return {"action": torch.stack(actions).cpu(), "distance": torch.stack(distances).cpu()}


def worst_difference(found: Mapping[str, torch.Tensor], golden: Mapping[str, torch.Tensor]) -> float:
    """Largest difference of outputs from the golden ones; infinity for shapes that differ."""
    worst = 0.0
    for name, value in found.items():
        other = golden[name]
        if value.shape != other.shape:
            return float("inf")
        worst = max(worst, float((value - other).abs().max().nan_to_num(float("inf"))))
    return worst


def _inside_voxels(points: np.ndarray, side: float) -> np.ndarray:
    """Points moved away from the borders of their voxels, none into another."""
    cells = points / side
    inside = np.clip(cells - np.floor(cells), VOXEL_MARGIN, 1.0 - VOXEL_MARGIN)
    return (np.floor(cells) + inside) * side


def _hand_points(hand: HandModel, q: np.ndarray) -> np.ndarray:
    """The hand's surface samples [H, 3] in the base frame at joint positions [D], by NumPy alone."""
    poses = hand.forward_kinematics(q)[hand.point_link]
    sets = [
        Rotation.from_quat(pose[3:]).apply(points) + pose[:3]
        for pose, points in zip(poses, hand.link_points, strict=True)
    ]
    return np.concatenate(sets)
