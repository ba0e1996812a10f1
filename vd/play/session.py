"""A running environment with an agent that can be exchanged: what the viewer shows and its buttons change."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from vd.evaluate.rollout import draw_goals
from vd.play.video import Snapshot, Watcher, act


class Session:
    """One world of the environment is watched at a time; all of them run.

    Args:
        env: An environment with at least one world for each object.
        agents: Agents by name; each is made when it is first chosen.
        agent: Name of the first agent.
        seed: Of the goals drawn on demand.
    """

    def __init__(self, env: Any, agents: dict[str, Callable[[], Any]], agent: str, *, seed: int = 0):
        self.env, self._makers, self._made = env, agents, dict[str, Any]()
        self._rng = np.random.default_rng(seed)
        self.object_names = [item.name for item in env.objects]
        self.agent_names = list(agents)
        self.choose_agent(agent)
        self.choose_object(self.object_names[env.world_object[0]])
        self.reset()

    @property
    def object_name(self) -> str:
        """Name of the object that is watched."""
        return self.env.objects[self.env.world_object[self.world]].name

    def choose_agent(self, name: str) -> None:
        """Let another agent act from the next step on.

        Raises:
            ValueError: There is no such agent, or it does not fit the hand.
        """
        if name not in self._makers:
            raise ValueError(f"no agent '{name}'; there are {', '.join(self._makers)}")
        if name not in self._made:
            self._made[name] = self._makers[name]()
        self.agent = name

    def choose_object(self, name: str) -> None:
        """Watch the first world with this object; counts start anew.

        Raises:
            ValueError: There is no such object.
        """
        if name not in self.object_names:
            raise ValueError(f"no object '{name}'; there are {', '.join(self.object_names)}")
        index = self.object_names.index(name)
        self.world = next(w for w, k in enumerate(self.env.world_object) if k == index)
        self._watcher = Watcher(self.env, [self.world])
        self.snapshot: Snapshot = self._watcher.read(stepped=False)[0]

    def step(self) -> Snapshot:
        """One control step of all environments."""
        act(self.env, self._made[self.agent])
        self.snapshot = self._watcher.read()[0]
        return self.snapshot

    def reset(self) -> Snapshot:
        """Start all environments anew, with new goals; counts go on."""
        self.env.reset()
        self.snapshot = self._watcher.read(stepped=False)[0]
        return self.snapshot

    def new_goal(self) -> Snapshot:
        """Give every world a new goal; nothing else changes, so agents see it after the next step."""
        env = self.env
        goals = draw_goals(env.object_pose()[:, 3:7].astype(float), self._rng, env.cfg.goal.max_angle_rad)
        env.goal_quat.assign(goals.astype(np.float32))
        self.snapshot = self._watcher.read(stepped=False)[0]
        return self.snapshot


def agent_choices(
    named: str, policy: Any | None, num_actions: int, *, seed: int, device: str, others: Sequence[str] = ()
) -> dict[str, Callable[[], Any]]:
    """Agents the viewer offers: the one that was named, other policy files beside it, zero and random.

    Args:
        named: Name or path of the agent to begin with.
        policy: It, if it is a trained one.
        num_actions: D.
        seed: Of the random agent.
        device: Torch device.
        others: More policy files.
    """
    from vd.evaluate.agents import BUILT_IN, built_in, open_teacher

    choices: dict[str, Callable[[], Any]] = {}
    if policy is not None:
        choices[named] = lambda: policy
    for other in others:
        choices.setdefault(other, partial(open_teacher, other, device))
    for name in BUILT_IN:
        choices[name] = partial(built_in, name, num_actions, seed=seed, device=device)
    return choices
