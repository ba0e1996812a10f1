"""A student at work in an environment."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import partial
from typing import Any

import torch
import warp as wp

from vd.config import from_dict
from vd.evaluate.agents import trained_task
from vd.evaluate.goals import Goals
from vd.evaluate.scanned import KnownByPoints
from vd.evaluate.second_view import GoalClock, StudentSecondView
from vd.sensors.cfg import DepthCameraCfg
from vd.student.saved import SavedStudent
from vd.vision import StudentView

PRETRAINED, RENDERED = 0, 2
"""Stages of the training: those of encoders that cannot act, and of depth cameras."""
CLOUDS = 256
"""Clouds through the network at once: their features take one or two gigabytes."""


class StudentActor:
    """The deterministic policy of a student: what it sees, its memory, and the mean of its actions.

    Attributes:
        num_actions: D.
        rendered: Whether it sees by a depth camera.
        predicted: Its distance to the goal before the latest action [rad], shape [N].
        active: Where it acts, shape [N], bool; elsewhere its actions are 0 and cost nothing.
    """

    def __init__(
        self,
        env: Any,
        student: SavedStudent,
        *,
        rendered: bool | None = None,
        goals: Goals = "mesh",
        sensor_errors: bool = False,
        aim: bool | None = None,
        critic: Callable[[torch.Tensor], torch.Tensor] | None = None,
        seed: int = 0,
    ):
        """Open its eyes in every world.

        Args:
            env: The environment.
            student: The student.
            rendered: See by a depth camera, or complete clouds; as its stage was trained by default.
            goals: What it knows shapes and goals by (:mod:`vd.evaluate.scanned`).
            sensor_errors: Give its camera the errors of a real one, in place of those of its training.
            aim: Whether it aims past near goals; None: if its file says so, or the environment.
            critic: What its teacher's critic expects (:func:`vd.evaluate.agents.open_critic`), to look twice
                at goals (:mod:`vd.evaluate.second_view`).
            seed: Of the errors of camera and scans.

        Raises:
            ValueError: It is one of stage 0, which cannot act, or of another hand, or is to aim and does not
                look for its object.
        """
        spec = student.spec
        if spec.stage == PRETRAINED:
            raise ValueError("a student of stage 0 is an encoder, which cannot act; give one of stage 1 or 2")
        if spec.num_actions != env.num_actions:
            raise ValueError(
                f"the student moves {spec.num_actions} joints, the hand {env.hand.name} has "
                f"{env.num_actions}; use the hand it was trained for"
            )
        self.env, self.num_actions, self._student = env, spec.num_actions, student.network
        self.rendered = spec.stage == RENDERED if rendered is None else rendered
        network = spec.network
        if env.cfg.aim.enabled:
            network = replace(network, aim=env.cfg.aim)
        if aim is not None:
            network = replace(network, aim=replace(network.aim, enabled=aim))
        network.validate()
        depth = from_dict(DepthCameraCfg, student.depth, where="depth camera of the student")
        if sensor_errors:
            depth = depth.with_errors()
        seen: Any = StudentView if goals == "mesh" else partial(KnownByPoints, exact=goals == "points")
        self._view = seen(env, network, rendered=self.rendered, depth=depth, camera=spec.camera, seed=seed)
        self._second = None
        if critic is not None:
            self._student = deepcopy(self._student)  # its views are changed
            self._second = StudentSecondView(
                GoalClock.of(env), self._student.state, trained_task(student), critic
            )
        self._hidden = self._student.initial_hidden(env.num_worlds)
        self._steps = wp.to_torch(env.step_count)
        self.predicted = self._hidden.new_zeros(env.num_worlds)
        self.active = torch.ones(env.num_worlds, dtype=torch.bool, device=self._hidden.device)

    @property
    def looks_twice(self) -> bool:
        """Whether it has a second view of goals that it does not reach."""
        return self._second is not None

    def act(self, _observation: torch.Tensor) -> torch.Tensor:
        """Mean actions [N, D] for what is seen now; the teacher's observation is not looked at.

        The memory of worlds that have just been reset starts empty.
        """
        frame = self._view.frame()
        self._hidden.masked_fill_((self._steps == 0)[:, None], 0.0)
        senses = self._student.senses(frame)
        mean = frame["action"].new_zeros(frame["action"].shape)
        with torch.no_grad():
            if self._second is not None:
                self._second.begin_step()
            for rows in self.active.nonzero().flatten().split(CLOUDS):
                if self._second is not None:
                    self._second.rows = rows
                seen = {key: value[rows] for key, value in frame.items()}
                sites = self._view.sites(seen, rows, augment=False)
                output = self._student.act(sites[0], senses[rows], self._hidden[rows], *sites[1:])
                self._hidden[rows] = output.hidden
                self.predicted[rows] = output.distance[:, -1]
                mean[rows] = output.mean
        return mean
