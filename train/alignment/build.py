"""From a configuration to a trainer: environments, network, and where it begins."""

from collections.abc import Callable
from dataclasses import replace

import torch

from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set
from vd.command.config import to_dict
from vd.envs.cfg import ObservationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.policy.actor import TrainedPolicy
from vd.policy.contract import VisionSpec
from vd.train.alignment.align import CLOUDS, AlignTrainer
from vd.train.alignment.config import SIMULATED, AlignmentTrainCfg
from vd.train.alignment.looks import SimulatedLooks
from vd.train.alignment.network import open_network
from vd.train.stages import build_stage, task_of_teacher
from vd.train.student.bank import ShapeBank, centred_points, mesh_points
from vd.train.student.shapes import made_shapes
from vd.train.student.views import Hands
from vd.train.vec_env import ReorientVecEnv
from vd.vision.acting_teacher import VisionPolicy
from vd.vision.alignment import AlignmentNetwork
from vd.vision.saved import AlignmentSpec

UNSEEN_SHAPES = 64
"""Made shapes that are never trained on."""


def build_alignment(
    cfg: AlignmentTrainCfg, *, say: Callable[[str], object] = print
) -> AlignTrainer:
    """Build network, shapes and environments as ``cfg`` says.

    As :func:`vd.train.stages.build_stage`.
    """
    return build_stage(cfg, "alignment", network_of=_network, trainer_of=_trainer, say=say)


def _network(cfg: AlignmentTrainCfg, teacher: TrainedPolicy, device: str) -> AlignmentNetwork:
    """The network, with the weights of the one that it begins from."""
    network = AlignmentNetwork(cfg.align.network).to(device)
    if cfg.init is not None:
        begun, _ = open_network(str(cfg.init), device)
        network.load_state_dict(begun.state_dict())
    return network


def _trainer(
    cfg: AlignmentTrainCfg, teacher: TrainedPolicy, network: AlignmentNetwork, device: str
) -> AlignTrainer:
    """The network's trainer, with shapes and environments."""
    task = task_of_teacher(teacher, cfg.task)
    task = replace(task, observation=ObservationCfg())  # who sees by a camera does not look at it
    hand = load_hand(task.hand, task.fingertip, task.hand_layer)
    hands = Hands(hand, cfg.align.hands, camera=cfg.camera, device=device)
    points = CLOUDS * cfg.align.points
    place = hands.eye.device
    held_out = {"made": made_shapes(UNSEEN_SHAPES, points, hands.sides, place)}
    if cfg.task.validation:
        held_out["validation"] = centred_points(load_set(cfg.task.validation), points, place)
    bank = ShapeBank(load_set(task.objects), cfg.align.shapes, points, hands.sides, place)
    spec = AlignmentSpec(
        network=network.cfg, points=cfg.align.points, hand=task.hand, camera=cfg.camera
    )
    looks = None
    if cfg.stage == SIMULATED:
        looks = _looks(cfg, task, teacher, network, device)
    return AlignTrainer(
        bank,
        held_out,
        hands,
        network,
        cfg.align,
        cfg.run,
        spec=spec,
        task=to_dict(task),
        looks=looks,
        device=device,
    )


def _looks(
    cfg: AlignmentTrainCfg,
    task: ReorientCfg,
    teacher: TrainedPolicy,
    network: AlignmentNetwork,
    device: str,
) -> SimulatedLooks:
    """Environments in which the teacher acts by the network."""
    simulation = ReorientEnv(task, device)
    env = ReorientVecEnv(simulation)
    # Or all episodes would time out at once.
    env.episode_length_buf = torch.randint_like(env.episode_length_buf, env.max_episode_length)
    spec = VisionSpec(camera=cfg.camera, alignment=network.cfg)
    policy = VisionPolicy(teacher, replace(teacher.contract, tracking=spec), network)
    surfaces = mesh_points(simulation.objects, CLOUDS * cfg.align.points, network.summary.device)
    return SimulatedLooks(env, policy, surfaces[..., :3].contiguous(), cfg.looks, task.seed)
