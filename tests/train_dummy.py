"""A tiny environment with the interface of ReorientEnv, whose every state is known and restorable."""

from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import torch
import warp as wp

from vd.envs.cfg import CurriculumCfg
from vd.envs.curriculum import LEVELS, Levels
from vd.train.config import PolicyCfg, PpoCfg, RunCfg
from vd.train.runner import TeacherRunner
from vd.train.vec_env import ReorientVecEnv

# Networks this small lose more to handing work over than they gain from a second core.
torch.set_num_threads(1)


@dataclass(frozen=True)
class DummyCfg:
    hand: str = "dummy"
    seed: int = 0
    curriculum: CurriculumCfg = field(default_factory=CurriculumCfg)


class DummyEnv:
    """Reward is minus the squared distance of the action to a target that the observation shows.

    A target within ``reach`` of the action counts as success and is replaced; environments "fall"
    with a small probability and time out after ``max_episode_steps``.
    """

    num_actions = 2
    num_observations = 5
    num_privileged = 0
    reward_term_names = ("distance", "bonus")
    reach = 0.2
    fall_probability = 0.02

    def __init__(
        self, num_envs: int = 4, max_episode_steps: int = 10, seed: int = 0, device: str = "cpu"
    ):
        self.cfg = DummyCfg(seed=seed)
        self.num_envs, self.max_episode_steps, self.device = num_envs, max_episode_steps, device
        n = num_envs
        self.action = wp.zeros((n, self.num_actions), dtype=float, device=device)
        self.observation = wp.zeros((n, self.num_observations), dtype=float, device=device)
        self.privileged = wp.zeros((n, self.num_privileged), dtype=float, device=device)
        self.reward = wp.zeros(n, dtype=float, device=device)
        self.reward_terms = wp.zeros((n, 2), dtype=float, device=device)
        self.rotation_error = wp.zeros(n, dtype=float, device=device)
        self.success = wp.zeros(n, dtype=wp.int32, device=device)
        self.fell = wp.zeros(n, dtype=wp.int32, device=device)
        self.timed_out = wp.zeros(n, dtype=wp.int32, device=device)
        self.done = wp.zeros(n, dtype=wp.int32, device=device)
        self.step_count = wp.zeros(n, dtype=wp.int32, device=device)
        self.goal_counts = wp.zeros(3, dtype=float, device=device)
        self.levels = Levels(goals=0.0)
        self.steps = 0
        self._generator = np.random.default_rng(seed)
        self._target = self._draw(n)
        self._observe()

    def _draw(self, count: int) -> np.ndarray:
        return self._generator.uniform(-0.8, 0.8, (count, self.num_actions)).astype(np.float32)

    def _observe(self) -> None:
        marker = np.full((self.num_envs, 1), float(self.steps), dtype=np.float32) * 1e-3
        self.observation.assign(np.hstack([self._target, np.abs(self._target), marker]))

    def step(self, action: wp.array) -> None:
        """Simulate one step."""
        a = action.numpy()
        distance = np.square(a - self._target).sum(axis=1)
        success = np.sqrt(distance) < self.reach
        count = self.step_count.numpy() + 1
        fell = self._generator.uniform(size=self.num_envs) < self.fall_probability
        timed_out = count >= self.max_episode_steps
        bonus = success.astype(np.float32)
        self.reward.assign(-distance + bonus)
        self.reward_terms.assign(np.stack([-distance, bonus], axis=1))
        self.rotation_error.assign(np.sqrt(distance))
        self.success.assign(success.astype(np.int32))
        self.fell.assign(fell.astype(np.int32))
        self.timed_out.assign(timed_out.astype(np.int32))
        self.done.assign((success | fell | timed_out).astype(np.int32))
        self.step_count.assign(np.where(fell | timed_out, 0, count).astype(np.int32))
        renew = success | fell | timed_out
        self._target[renew] = self._draw(int(renew.sum()))
        self.steps += 1
        self._observe()

    def check(self) -> None:
        """All is well."""

    def update_curriculum(self) -> dict[str, float]:
        """Let the goals recede a little."""
        self.levels = replace(self.levels, goals=min(1.0, self.levels.goals + 0.01))
        return {}

    @property
    def progress(self) -> float:
        """Of goals and stillness."""
        return 0.5 * (self.levels.goals + self.levels.stillness)

    def levels_of(self, state: dict[str, Any]) -> Levels:
        """Those of a state."""
        return Levels(**{name: state["levels"].get(name, 1.0) for name in LEVELS})

    def failed_steps(self) -> int:
        """Nothing fails here."""
        return 0

    def set_levels(self, levels: Levels) -> None:
        """Nothing depends on them."""
        self.levels = levels

    def reset(self) -> None:
        """New episodes everywhere."""
        self.step_count.zero_()
        self._target = self._draw(self.num_envs)
        self._observe()

    def state_dict(self) -> dict[str, Any]:
        """Everything."""
        return {
            "arrays": {"target": self._target.copy(), "step_count": self.step_count.numpy().copy()},
            "generator": self._generator.bit_generator.state["state"]["state"]
            .to_bytes(16, "little")
            .hex(),
            "increment": self._generator.bit_generator.state["state"]["inc"]
            .to_bytes(16, "little")
            .hex(),
            "steps": self.steps,
            "levels": asdict(self.levels),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore everything."""
        self._target = state["arrays"]["target"].copy()
        self.step_count.assign(state["arrays"]["step_count"])
        inner = self._generator.bit_generator.state
        inner["state"] = {
            "state": int.from_bytes(bytes.fromhex(state["generator"]), "little"),
            "inc": int.from_bytes(bytes.fromhex(state["increment"]), "little"),
        }
        self._generator.bit_generator.state = inner
        self.steps, self.levels = state["steps"], self.levels_of(state)
        self._observe()

    def close(self) -> None:
        """Nothing to release."""


def simulating_the_dummy(monkeypatch) -> None:
    """Let vd-train teacher simulate the dummy."""

    class Env(DummyEnv):
        def __init__(self, cfg, device):
            super().__init__(num_envs=cfg.num_envs, seed=cfg.seed)
            self.objects = list(cfg.objects)

        def state_dict(self):
            return super().state_dict() | {"objects": self.objects}

        def load_state_dict(self, state):
            if state["objects"] != self.objects:
                raise ValueError("the environments of the saved environment hold other objects")
            super().load_state_dict(state)

    monkeypatch.setattr("vd.envs.reorient.ReorientEnv", Env)


SMALL_PPO = PpoCfg(
    rollout_steps=8,
    minibatch_size=64,
    epochs=4,
    actor_learning_rate=2e-3,
    critic_learning_rate=3e-3,
    clip=0.2,
    value_coefficient=1.0,
)
SMALL_POLICY = PolicyCfg(
    hidden=(16, 16), distribution="state-dependent", initial_std=0.5, std_range=(0.02, 1.0)
)


def make_runner(
    run_dir: Any,
    *,
    env: DummyEnv | None = None,
    ppo: PpoCfg = SMALL_PPO,
    policy: PolicyCfg = SMALL_POLICY,
    seed: int = 0,
    device: str = "cpu",
    **run: Any,
) -> TeacherRunner:
    """A runner on the dummy, deterministic from ``seed``."""
    torch.manual_seed(seed)
    env = env or DummyEnv(num_envs=16, seed=seed, device=device)
    settings = RunCfg(out=run_dir, device=device, **{"save_every": 3, "logger": "none", **run})
    task = {"hand": "dummy"}
    return TeacherRunner(ReorientVecEnv(env), ppo, policy, settings, task=task, device=device)
