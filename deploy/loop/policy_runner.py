"""Policies in the control loop: from what is sensed to an action and the distance to the goal."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from vd.assets_usd.hand_data import CameraModel, HandModel
from vd.assets_usd.objects.model import ObjectModel
from vd.envs.cfg import ReorientCfg
from vd.evaluate.statistics import symmetric_error
from vd.geometry.arrays import as_warp
from vd.paper import PAPER
from vd.policy import ONNX_SUFFIX, has_suffix
from vd.policy.agents import check_fits, open_policy, task_for
from vd.policy.onnx import OnnxTeacher, read_onnx
from vd.policy.senses import Senses
from vd.policy.stopping import StoppingRule
from vd.sensors.depth_cloud import CameraCloud

if TYPE_CHECKING:
    from vd.vision.acting import StudentPolicy
    from vd.vision.acting_teacher import VisionPolicy

SPIN_S = 30.0
"""For how long an object is turned where nothing is asked for [s], as by HORA."""
ZERO = "zero"
"""Name of the zero-action baseline."""


@dataclass(frozen=True)
class Sensed:
    """What is known before an action; D joints, world frame."""

    joint_q: np.ndarray
    """Joint positions as measured [rad] [D]."""
    joint_qd: np.ndarray
    """Joint velocities as measured [rad/s] [D]."""
    smoothed: np.ndarray
    """Moving average of the actions so far [D]."""
    goal_quat: np.ndarray
    """Wanted orientation of the object, xyzw [4]."""
    depth: np.ndarray | None = None
    """Depth image [m], 0 for none [H, W]."""
    truth: np.ndarray | None = None
    """True position [m], quaternion xyzw, velocity [m/s] and spin [rad/s] of the object [13], which
    a twin tells."""
    object_state: np.ndarray | None = None
    """The same as a teacher is told it: by --pose, or the truth; None: not known yet."""


@dataclass(frozen=True)
class PolicyDecision:
    """What a policy says of a moment.

    Raises:
        ValueError: Its action is not finite, which no clip or filter may hide.
    """

    action: np.ndarray
    """Mean action [D]."""
    distance: float
    """Distance to the goal by which it is stopped [rad], as it is predicted; NaN: not known."""
    found: np.ndarray | None = None
    """Pose of the object as it was found [7]; None: it was not looked for."""
    voxels: int | None = None
    """How much of the object the camera saw; None: it was not looked for."""

    def __post_init__(self) -> None:
        """Refuse what is no action."""
        if not np.isfinite(self.action).all():
            raise ValueError(f"the policy's action is not finite: {self.action}; mend the policy")


class PolicyRunner:
    """A policy in the loop; this one is the zero-action baseline, to try everything else.

    Args:
        task: Environment of its training.
        rule: When it has arrived.

    Attributes:
        kind: vision, student, teacher, joints or zero.
        camera: Where its depth camera has to be; None: it has none.
        calibrated: Whether its rule to stop comes from episodes.
        spin_axis: Axis about which it turns an object without a goal, in the world; None: it has
            goals.
        goal_s: Usual time for a goal, or to turn [s].
    """

    kind = ZERO
    spin_axis: tuple[float, float, float] | None = None
    goal_s = PAPER.scene.episode_s
    camera: CameraModel | None = None
    calibrated = True

    def __init__(self, task: ReorientCfg, rule: StoppingRule):
        self.task = task
        self.rule = rule

    def look_by(self, camera: CameraModel) -> None:
        """See by a camera with this lens at this place, in place of the one of the training."""

    def begin(self) -> None:
        """A run begins: nothing is known from before."""
        self.new_goal()

    def new_goal(self) -> None:
        """A new goal: memory starts empty, as in training."""

    def decide(self, sensed: Sensed) -> PolicyDecision:
        """What to do now."""
        return PolicyDecision(np.zeros_like(sensed.smoothed), float("nan"))


class TeacherPolicyRunner(PolicyRunner):
    """A teacher, which is told the object's state: by a twin, or by who tells poses.

    An environment makes its observation. Until a state is known the hand holds still.

    Args:
        policy: The teacher.
        hand_name: Name of the hand or its USD.
        object: Name of the object's set, or its file.
        tolerance_rad: How near to the goal it is to stop [rad].
    """

    kind = "teacher"

    def __init__(self, policy: Any, hand_name: str, object: str, tolerance_rad: float):
        from vd.envs.reorient import ReorientEnv

        task = task_for(
            policy,
            stop_tolerance_rad=tolerance_rad,
            randomised=False,
            hand=hand_name,
            at_rest=False,
            num_envs=1,
            objects=(object,),
        )
        super().__init__(task, StoppingRule(tolerance_rad))
        self._env = ReorientEnv(task, "cpu")
        self._policy = policy
        self._begins = True
        drop = self._env.hand.workspace.drop_m
        self._before = np.array([*drop, 0.0, 0.0, 0.0, 1.0, *np.zeros(6)])

    def new_goal(self) -> None:
        """The symmetry frame is chosen anew."""
        self._begins = True

    def decide(self, sensed: Sensed) -> PolicyDecision:
        """What it does in this state."""
        env = self._env
        state = self._before if sensed.object_state is None else sensed.object_state
        self._put(sensed, state)
        if self._begins:
            env.give_goals(np.zeros(1, int), sensed.goal_quat[None])
            self._begins = sensed.object_state is None
        action = self._act()
        if sensed.object_state is None:
            return PolicyDecision(np.zeros_like(sensed.smoothed), float("nan"))
        error = symmetric_error(state[None, 3:7], sensed.goal_quat[None], env.objects[0].symmetry)
        return PolicyDecision(action, float(error[0]))

    def _put(self, sensed: Sensed, state: np.ndarray) -> None:
        """Bring the environment into what is sensed, with the object in ``state`` [13]."""
        env = self._env
        sim = env.sim
        for array, joints, rest in (
            (sim.joint_q, sensed.joint_q, state[:7]),
            (sim.joint_qd, sensed.joint_qd, state[7:]),
            (env.measured_q, sensed.joint_q, state[:7]),
            (env.measured_qd, sensed.joint_qd, state[7:]),
            (env.smoothed, sensed.smoothed, ()),
        ):
            array.assign(np.array([[*joints, *rest]], dtype=np.float32)[:, : array.shape[1]])
        sim.forward_kinematics()

    def _act(self) -> np.ndarray:
        """Mean action [D] for what the environment observes."""
        env = self._env
        env.observe()
        without_torch = isinstance(self._policy, OnnxTeacher)
        told = env.observation.numpy() if without_torch else wp.to_torch(env.observation)
        action = as_warp(self._policy.act(told))
        if env.symmetry_frames is not None:
            action = env.symmetry_frames.world_action(action)
        mean: np.ndarray = action.numpy()[0].copy()
        return mean


class JointPolicyRunner(TeacherPolicyRunner):
    """A policy that senses its joints alone, and turns what lies in the hand; arguments as of a teacher.

    Nobody tells it of the object, so it never stops by itself.
    """

    kind = "joints"
    goal_s = SPIN_S

    def __init__(self, policy: Any, hand_name: str, object: str, tolerance_rad: float):
        super().__init__(policy, hand_name, object, tolerance_rad)
        self.spin_axis = self.task.reward.spin.axis

    def decide(self, sensed: Sensed) -> PolicyDecision:
        """What it does after what the joints told so far."""
        self._put(sensed, self._before)
        if self._begins:
            self._env.observer.begin(wp.ones(1, dtype=wp.int32, device="cpu"))
        self._begins = False
        return PolicyDecision(self._act(), float("nan"))


class CameraRunner(PolicyRunner):
    """A policy that sees by a camera: vision or student.

    Arguments are those of :func:`load_runner`.

    Attributes:
        eye: Makes clouds of its camera's images.

    Raises:
        ValueError: It is for another hand.
    """

    def __init__(
        self,
        policy: "VisionPolicy | StudentPolicy",
        hand: HandModel,
        item: ObjectModel,
        *,
        tolerance_rad: float = PAPER.success.rotation_rad,
        seed: int = 0,
    ):
        super().__init__(ReorientCfg.of(policy), policy.spec.rule_for(tolerance_rad))
        self.kind = policy.kind
        self.calibrated = policy.spec.calibrated_for(tolerance_rad)
        self._depth = policy.spec.depth
        self._mount = hand.mount
        self._seed = seed
        self._fresh = True
        self.look_by(hand.camera.at(policy.spec.camera))
        import torch

        from vd.vision.acting import ActingStudent, StudentPolicy
        from vd.vision.acting_teacher import ActingTeacher

        goals = torch.tensor(item.surface_points, dtype=torch.float32)[None]
        if isinstance(policy, StudentPolicy):
            self._tracker: Any = ActingStudent(policy.network, hand, goals)
        else:
            self._tracker = ActingTeacher(policy, hand, goals)

    def look_by(self, camera: CameraModel) -> None:
        """See by another camera."""
        self.camera = camera
        self.eye = CameraCloud(
            camera,
            mount=self._mount,
            points=self._depth.points,
            crop_m=self._depth.crop_m,
            seed=self._seed,
        )

    def begin(self) -> None:
        """The object is looked for anew, which takes several times as long as a step."""
        self._fresh = True

    def decide(self, sensed: Sensed) -> PolicyDecision:
        """Mean action, and the expected distance."""
        if sensed.depth is None:
            raise ValueError("the policy sees by a depth camera, but there is no image")
        import torch

        def row(values: np.ndarray) -> torch.Tensor:
            return torch.tensor(values, dtype=torch.float32)[None]

        senses = Senses(
            joint_q=row(sensed.joint_q),
            joint_qd=row(sensed.joint_qd),
            action=row(sensed.smoothed),
            goal_quat=row(sensed.goal_quat),
            points=wp.to_torch(self.eye.seen(sensed.depth)),
            fresh=torch.tensor([self._fresh]),
        )
        decided = self._tracker.step(senses)
        self._fresh = False
        place = [np.asarray(decided.position[0]), np.asarray(decided.orientation[0])]
        return PolicyDecision(
            action=np.array(decided.action[0]),
            distance=float(decided.angle[0]),
            found=np.concatenate(place),
            voxels=int(decided.voxels[0]),
        )


def load_runner(
    name: str,
    hand_name: str,
    hand: HandModel,
    item: ObjectModel,
    *,
    tolerance_rad: float = PAPER.success.rotation_rad,
    seed: int = 0,
    object: str | None = None,
) -> PolicyRunner:
    """Load a policy for the loop.

    Args:
        name: File of a policy, installed policy, or ``zero``.
        hand_name: Name of the hand or its USD.
        hand: The hand.
        item: The object.
        tolerance_rad: How near to the goal it is to stop [rad].
        seed: Of the choice of camera points.
        object: What a twin holds, or what poses are of, for a teacher; None: nobody tells it.

    Raises:
        ValueError: It is for another hand, or a teacher that sees the object's state and that
            nobody tells it.
    """
    if name == ZERO:
        return PolicyRunner(ReorientCfg(hand=hand_name), StoppingRule())
    onnx = has_suffix(name, ONNX_SUFFIX)
    policy: Any = read_onnx(Path(name)) if onnx else open_policy(name, "cpu")
    if policy is None:
        raise ValueError(f"{name} is not for a hand; give a policy, or {ZERO}")
    check_fits(name, policy, hand_name)
    if ReorientCfg.of(policy).observation.history:
        return JointPolicyRunner(policy, hand_name, object or "cube", tolerance_rad)
    if policy.kind != "teacher":
        return CameraRunner(policy, hand, item, tolerance_rad=tolerance_rad, seed=seed)
    if object is not None:
        return TeacherPolicyRunner(policy, hand_name, object, tolerance_rad)
    raise ValueError(
        f"{name} is a teacher: it needs the object's pose, which no robot senses. Tell it by "
        "--pose, or have vd-train tracker make a vision policy of it"
    )
