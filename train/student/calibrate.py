"""The rules by which a student stops, from episodes that nothing stops."""

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from vd.aim import AimCfg
from vd.assets_usd.objects.model import load_set
from vd.config import from_dict, to_dict
from vd.envs.cfg import ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate.agents import episode_limit_s, open_critic
from vd.evaluate.cli import LOG_EVERY_S
from vd.evaluate.result import air_table_steps
from vd.evaluate.student import StudentActor
from vd.evaluate.trace import NEVER_RAD, Trace, record
from vd.paper import PAPER
from vd.student.saved import load_student, read_student, saved_spec
from vd.student.stopping import Calibration, calibrate
from vd.student.symmetry import with_symmetries
from vd.train.checkpoint import save_checkpoint
from vd.warp_quiet import quiet_warp
from vd.workers import one_thread_without_gpu


def calibrate_trace(trace: Trace, *, tolerance_rad: float = PAPER.success.rotation_rad) -> Calibration:
    """The stopping rule that suits a student's recorded episodes.

    Args:
        trace: Episodes of a student, T steps.
        tolerance_rad: Largest true distance that counts as right [rad].

    Raises:
        ValueError: The trace is no student's, or no rule stops any episode within the tolerance.
    """
    if trace.predicted is None:
        raise ValueError("only a student predicts distances; there is no rule to choose for another policy")
    after = np.arange(trace.error.shape[-1])
    running = (after > 0) & (after < trace.steps[..., None])
    values = trace.predicted, trace.action_norm, trace.error, running
    return calibrate(*(value.reshape(-1, len(after)).T for value in values), tolerance_rad=tolerance_rad)


def calibrate_student(
    path: Path,
    *,
    objects: tuple[str, ...] = (),
    episodes: int,
    tolerance_rad: float = PAPER.success.rotation_rad,
    episode_s: float | None = None,
    randomise: bool = False,
    in_air: bool = False,
    aim: bool | None = None,
    second_view: bool = False,
    seed: int = 0,
    device: str,
) -> tuple[Calibration, Calibration | None]:
    """Calibrate the stopping rules of a student and store them in its file.

    One is for the tolerance, one for that of the paper's precise variant, from the same episodes.

    Args:
        path: ``student.pt``.
        objects: Object sets to calibrate on; the training's by default.
        episodes: Number of episodes, one a world, rounded up to as many of each object.
        tolerance_rad: Largest true distance that counts as right [rad].
        episode_s: Length of an episode [s]; None: that of the paper's tests.
        randomise: Domain randomisation.
        in_air: Episodes of the paper's in-air test, in which the table is taken away.
        aim: Whether it aims past near goals, from now on; None: as it does.
        second_view: It looks at goals again (:mod:`vd.evaluate.second_view`): the rule of one that is to.
        seed: Of starts, goals and sensor errors.
        device: Warp and torch device.

    Returns:
        What either rule gave; None for the precise one where no rule stops any episode so near its goal.

    Raises:
        ValueError: The student is one of stage 0, which cannot act, or is to aim and does not look for its
            object, or has no second view and is to look twice, or no rule stops any episode within the
            tolerance.
    """
    quiet_warp()
    one_thread_without_gpu(device)
    saved = load_student(path, device)
    network = saved.spec.network
    if aim is not None:
        network = replace(network, aim=AimCfg(enabled=aim))
        saved = replace(saved, spec=replace(saved.spec, network=network))
    trained = from_dict(ReorientCfg, saved.task, where="task of the student")
    sets = objects or trained.objects
    count = len(load_set(list(sets)))
    each = math.ceil(episodes / count)
    task = replace(
        trained,
        objects=sets,
        num_worlds=each * count,
        seed=seed,
        episode_s=episode_limit_s(episode_s, in_air=in_air),
        success=replace(trained.success, rotation_rad=NEVER_RAD),
        randomisation=replace(trained.randomisation, enabled=randomise),
    )
    env = ReorientEnv(task, device)
    env.objects = with_symmetries(env.objects, device)
    table_steps = air_table_steps(task.sim.control_hz) if in_air else None
    critic = open_critic(saved, device) if second_view else None
    actor = StudentActor(env, saved, critic=critic, seed=seed)
    refresh = 0.5 if sys.stderr.isatty() else LOG_EVERY_S
    with tqdm(total=env.max_episode_steps, unit="step", desc=path.name, mininterval=refresh) as bar:
        trace = record(env, actor, each, table_steps=table_steps, on_step=bar.update)
    env.check()
    env.close()
    result = calibrate_trace(trace, tolerance_rad=tolerance_rad)
    try:
        precise = calibrate_trace(trace, tolerance_rad=PAPER.success.precise_rad)
    except ValueError:  # of a student that never came so near there is nothing to learn
        precise = None
    state = read_student(path, as_stored=True)
    what = f"{', '.join(sets)}: {result.episodes} episodes{' in the air' if in_air else ''}, "
    what += "aimed past near goals, " if network.aim.enabled else ""
    what += "looked at twice, " if actor.looks_twice else ""
    what += f"tolerance {tolerance_rad:g} rad, seed {seed}"
    spec = replace(
        saved_spec(state, path),
        network=network,
        stopping=result.rule,
        tolerance_rad=tolerance_rad,
        precise=None if precise is None else precise.rule,
        calibrated_on=what,
    )
    save_checkpoint(path, {**state, "spec": to_dict(spec)})
    return result, precise
