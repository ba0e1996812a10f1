"""Episodes of a student that nothing stops, and from them the rule by which it stops."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import warp as wp

from vd.config import from_dict, to_dict
from vd.envs.cfg import ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.paper import PAPER
from vd.sensors.cfg import DepthCameraCfg
from vd.student.network import Student
from vd.student.saved import load_student, read_student, saved_spec
from vd.student.stopping import Calibration, calibrate
from vd.train.checkpoint import save_checkpoint
from vd.train.student.config import PRETRAINING, RENDERED
from vd.vision import StudentView

NEVER_RAD = 1e-9
"""Orientation tolerance that no state meets: episodes then go on, whatever the student does."""


def record(
    env: ReorientEnv, view: StudentView, student: Student
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Run one episode in every world with the student's mean action.

    Returns:
        Predicted distances [rad], norms of the smoothed action, true distances [rad] and whether the
        episode still runs, shape [T, N] each; the step before the first action does not count as running.
    """
    env.reset()
    device = student.mean.weight.device
    hidden = student.initial_hidden(env.num_worlds)
    alive = torch.ones(env.num_worlds, dtype=torch.bool, device=device)
    fell = wp.to_torch(env.fell)
    rows: list[torch.Tensor] = []
    with torch.no_grad():
        for step in range(env.max_episode_steps):
            frame = view.frame()
            sites = view.sites(frame, augment=False)
            output = student.act(sites[0], student.senses(frame), hidden, *sites[1:])
            hidden = output.hidden
            rows.append(
                torch.stack(
                    (
                        output.distance[:, -1],
                        frame["action"].norm(dim=-1),
                        frame["distance"],
                        (alive & (step > 0)).float(),
                    )
                )
            )
            wp.to_torch(env.action).copy_(output.mean)
            env.step(env.action)
            alive = alive & (fell == 0)
    env.check()
    predicted, norm, true, running = torch.stack(rows, dim=1).cpu().numpy()
    return predicted, norm, true, running > 0.0


def calibrate_student(
    path: Path,
    *,
    objects: tuple[str, ...] = (),
    episodes: int,
    tolerance_rad: float = PAPER.success.rotation_rad,
    randomise: bool = False,
    seed: int = 0,
    device: str,
) -> Calibration:
    """Calibrate the stopping rule of a student and store it in its file.

    Args:
        path: ``student.pt``.
        objects: Object sets to calibrate on; the training's by default.
        episodes: Number of episodes, one a world.
        tolerance_rad: Largest true distance that counts as right [rad].
        randomise: Domain randomisation.
        seed: Of starts, goals and sensor errors.
        device: Warp and torch device.

    Raises:
        ValueError: The student is one of stage 0, which cannot act.
    """
    wp.config.log_level = wp.LOG_WARNING
    saved = load_student(path, device)
    spec = saved.spec
    if spec.stage == PRETRAINING:
        raise ValueError(f"{path} is of stage 0, which does not act; calibrate a student of stage 1 or 2")
    trained = from_dict(ReorientCfg, saved.task, where="task of the student")
    task = replace(
        trained,
        objects=objects or trained.objects,
        num_worlds=episodes,
        seed=seed,
        success=replace(trained.success, rotation_rad=NEVER_RAD),
        randomisation=replace(trained.randomisation, enabled=randomise),
    )
    env = ReorientEnv(task, device)
    view = StudentView(
        env,
        spec.network,
        rendered=spec.stage == RENDERED,
        depth=from_dict(DepthCameraCfg, saved.depth, where="depth camera of the student"),
        camera=spec.camera,
        seed=seed,
    )
    result = calibrate(*record(env, view, saved.network), tolerance_rad=tolerance_rad)
    env.close()
    state = read_student(path)
    what = f"{', '.join(task.objects)}: {episodes} episodes, tolerance {tolerance_rad:g} rad, seed {seed}"
    spec = replace(saved_spec(state, path), stopping=result.rule, calibrated_on=what)
    save_checkpoint(path, {**state, "spec": to_dict(spec)})
    return result
