"""A student small enough to train in a second: clouds of two bars whose lengths are the teacher's action."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from train_dummy import DummyEnv

from vd.config import to_dict
from vd.sensors.cfg import DepthCameraCfg
from vd.train.config import RunCfg
from vd.train.student.config import DaggerCfg
from vd.train.student.dagger import Dagger
from vd.train.vec_env import ReorientVecEnv
from vd.vision.cfg import EncoderCfg, NoiseCfg, StudentCfg
from vd.vision.network import Student
from vd.vision.saved import SavedStudent, StudentSpec
from vd.vision.voxels import Voxeliser

BAR_POINTS = 24
VOXEL_M = 0.01

TINY = StudentCfg(
    encoder=EncoderCfg(channels=(8, 16), blocks=1, pooled_stages=0, embedding=16, inputs=("constant",)),
    voxel_m=VOXEL_M,
    proprioception=("action",),
    action_hidden=4,
    memory=16,
    head_hidden=16,
    distance_hidden=8,
)


def untrained_student(task: Any, stage: int = 2, *, points: int = 300, **spec: Any) -> SavedStudent:
    """A student of random weights for three fingers."""
    torch.manual_seed(stage)
    told = StudentSpec(network=TINY, num_actions=9, stage=stage, teacher="dclaw3-table", **spec)
    network = Student(TINY, 9).eval().requires_grad_(False)
    return SavedStudent(told, network, to_dict(task), to_dict(DepthCameraCfg(points=points)), 1, 100)


QUICK = DaggerCfg(rollout_steps=6, minibatch_envs=4, epochs=2, learning_rate=3e-3)
STILL = NoiseCfg(jitter_probability=0.0, dropout_probability=0.0)


class DummyTeacher:
    """Knows the target, which the observation begins with."""

    num_actions = 2

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """The target."""
        return observation[:, :2]


class DummyView:
    """Bars along x and y as long as the target says; the distance is the target's length."""

    def __init__(self, env: DummyEnv, *, noise: NoiseCfg | None = STILL, batch: int = 256):
        self.env = env
        self.asked: list[bool] = []
        self._voxelise = Voxeliser(VOXEL_M, noise=noise, clouds=batch, device=env.device)

    def frame(self) -> dict[str, torch.Tensor]:
        """The present target and action."""
        target = wp.to_torch(self.env.observation)[:, :2].clone()
        action = wp.to_torch(self.env.action).clone()
        return {"target": target, "action": action, "distance": target.norm(dim=-1)}

    def observation(self, observed: torch.Tensor) -> torch.Tensor:
        """As it is."""
        return observed.clone()

    def sites(self, frame, envs=None, *, augment):
        """Voxels of the bars."""
        self.asked.append(augment)
        length = 0.12 * (1.0 + frame["target"])  # [R, 2]
        along = torch.linspace(0.0, 1.0, BAR_POINTS) * length[:, :, None]
        points = torch.zeros((length.shape[0], 2, BAR_POINTS, 3))
        for axis in range(2):
            points[:, axis, :, axis] = along[:, axis]
            points[:, axis, :, 2] = 0.1 * axis
        return self._voxelise(points.flatten(1, 2).contiguous(), augment=augment)

    def state_dict(self) -> dict[str, Any]:
        """Random state, and the action that the dummy environment does not keep."""
        return {"noise": self._voxelise.rng.numpy().copy(), "action": self.env.action.numpy().copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore it."""
        self.env.action.assign(state["action"])
        self._voxelise.rng.assign(state["noise"])


def make_dagger(
    run_dir: Path = Path("unused"),
    *,
    envs: int = 8,
    seed: int = 0,
    noise: NoiseCfg | None = STILL,
    save_every: int = 2,
    **settings: Any,
) -> Dagger:
    """An imitation of the dummy teacher, deterministic from ``seed``."""
    torch.manual_seed(seed)
    env = DummyEnv(num_envs=envs, seed=seed)
    return Dagger(
        ReorientVecEnv(env),
        DummyView(env, noise=noise),
        Student(TINY, 2),
        DummyTeacher(),
        replace(QUICK, **settings),
        RunCfg(out=run_dir, device="cpu", save_every=save_every, tensorboard=False),
        spec=StudentSpec(network=TINY, num_actions=2, stage=1, teacher="dummy"),
        task={"hand": "dummy"},
        depth=to_dict(STILL),
        device="cpu",
    )


def weights(student: Student) -> np.ndarray:
    """All weights and buffers in one vector."""
    return np.concatenate([value.double().numpy().ravel() for value in student.state_dict().values()])
