"""``vd-train tracker``: let a teacher act by a camera, and choose when it stops.

Its layers stay.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from vd.command.device import resolve_device
from vd.command.files import check_file
from vd.command.line import flags_of, parse, say_same_as
from vd.evaluate.cfg import EpisodeFlags, EvalCfg
from vd.paper import PAPER
from vd.policy import SUFFIX, check_suffix
from vd.policy.agents import DEFAULT_POLICY, check_names, default_policy

if TYPE_CHECKING:
    from vd.evaluate.camera_actor import AnyCameraPolicy
    from vd.evaluate.trace import Trace
    from vd.policy.contract import Contract


@dataclass(kw_only=True)
class TrackerCfg(EpisodeFlags):
    """Write a vision policy: a teacher that acts by a depth camera.

    A network finds the object by its goal's points. Nothing is learned; its stopping rules, for
    --stop-tolerance and for 0.1 rad, are chosen on episodes with objects of validation, those of
    vd-eval with the same flags.
    """

    teacher: Annotated[str, tyro.conf.Positional] = DEFAULT_POLICY
    """The teacher: a policy.safetensors, a run's folder, or the name of an installed one. Of a
    student the stopping rules alone are chosen."""
    objects: tuple[str, ...] = ()
    """Object sets to choose the stopping rules on, not those of the training; by default
    procedural-heldout, and a few of its kinds on a CPU."""
    alignment: str | None = None
    """Network that finds objects by their goals' points: the alignment.pt of vd-train alignment, or
    a vision policy, for that of it: its name or file. By default the hand's installed vision
    policy."""
    out: Path = Path("vision.safetensors")
    """File to write."""
    camera: tuple[float, float, float, float, float, float, float] | None = None
    """Pose of the optical frame (x right, y down, z forward) in the hand's base frame: position [m]
    and quaternion xyzw; that of the network's training or the hand's own camera by default."""
    episodes: int | None = None  # type: ignore[assignment]  # who is told none chooses
    """Episodes; rounded up to as many of each object. 256 by default, 64 on a CPU."""
    smoke: bool = False
    """Check the installation: two episodes with a cube, on the CPU. Nothing is kept."""
    seed: int = 1000


def tracker_command(arguments: Sequence[str]) -> int:
    """``vd-train tracker``; the exit status.

    One rule is for the tolerance, one for that of the paper's precise variant, from the same
    episodes.

    Raises:
        ValueError: The teacher is none, or observes what no camera shows, or no rule stops any
            episode within the tolerance.
    """
    cfg: TrackerCfg = parse(TrackerCfg, arguments, prog="vd-train tracker")
    cfg.validate()
    check_suffix(cfg.out, SUFFIX)
    check_names([cfg.teacher], cfg.objects)
    if not cfg.smoke:
        return _track(with_defaults(cfg))
    with TemporaryDirectory(prefix="vd-smoke-") as folder:
        tiny = replace(cfg, objects=("cube",), episodes=2, device="cpu", stop_tolerance=math.pi)
        return _track(replace(tiny, out=Path(folder) / cfg.out.name))


def with_defaults(cfg: TrackerCfg) -> TrackerCfg:
    """``cfg`` with objects and episodes for this machine where none are named, which are said."""
    few = resolve_device(cfg.device) == "cpu"
    objects = cfg.objects or (("procedural-heldout-8-seed0",) if few else ("procedural-heldout",))
    full = replace(cfg, objects=objects, episodes=cfg.episodes or (64 if few else 256))
    if full != cfg:
        flags = flags_of(full, "teacher", always=("out",))
        say_same_as("vd-train", "tracker", cfg.teacher, *flags)
    return full


def _track(cfg: TrackerCfg) -> int:
    """Run the episodes, choose the rules and write the policy."""
    check_file(cfg.out)
    print("running the episodes ...", flush=True)
    from vd.command.warp_quiet import quiet_warp
    from vd.policy.bundle import write_policy
    from vd.policy.stopping import calibrate

    quiet_warp()
    device = resolve_device(cfg.device)
    policy = _seeing(cfg, device)
    trace = _episodes(cfg, policy, device)
    assert trace.predicted is not None
    predicted, norm, true = (
        values.reshape(trace.steps.size, -1)
        for values in (trace.predicted, trace.action_norm, trace.error)
    )
    chosen = partial(calibrate, predicted, norm, true, trace.steps.ravel())
    calibration = chosen(tolerance_rad=cfg.stop_tolerance)
    try:
        precise = chosen(tolerance_rad=PAPER.success.precise_rad)
    except ValueError:  # of a policy that never came so near there is nothing to learn
        precise = None
    spec = replace(
        policy.spec,
        stopping=calibration.rule,
        tolerance_rad=cfg.stop_tolerance,
        precise=None if precise is None else precise.rule,
        calibrated_on=_conditions(cfg, calibration.episodes),
    )
    write_policy(policy, cfg.out, _contract(policy, spec))
    for result in (calibration, precise):
        if result is None:
            print(
                f"{cfg.out}: no rule stops any within {PAPER.success.precise_rad:g} rad: none for "
                f"it"
            )
            continue
        rule = result.rule
        print(
            f"{cfg.out}: stop below {rule.distance_rad:.3f} rad and an action norm of "
            f"{rule.action_norm:.3f}. Of {result.episodes} episodes {result.success:.1%} stop "
            f"within {result.tolerance_rad:g} rad, {result.wrong:.1%} outside; "
            f"{result.reachable:.1%} came that near"
        )
    return 0


def _seeing(cfg: TrackerCfg, device: str) -> "AnyCameraPolicy":
    """The student that is named, or the teacher, let act by a camera.

    Raises:
        ValueError: It is neither, or observes what no camera shows, or no network is there.
    """
    from vd.evaluate.spin import spins
    from vd.policy.agents import open_policy, open_teacher, policy_name
    from vd.policy.contract import VisionSpec
    from vd.train.alignment.network import open_network
    from vd.vision.acting import StudentPolicy
    from vd.vision.acting_teacher import VisionPolicy

    student = open_policy(cfg.teacher, device)
    if isinstance(student, StudentPolicy):
        if cfg.alignment is not None or cfg.camera is not None:
            raise ValueError(f"{cfg.teacher} sees by itself; leave out --alignment and --camera")
        return student
    teacher = open_teacher(cfg.teacher, device)
    if teacher is None:
        raise ValueError(f"{cfg.teacher} has no layers; give a trained teacher")
    if spins(teacher):
        raise ValueError(
            f"{cfg.teacher} turns objects without a goal by its joints alone, which needs no "
            "camera: give a teacher that has goals"
        )
    if terms := teacher.task["observation"].get("terms"):
        raise ValueError(
            f"{cfg.teacher} observes {', '.join(terms)}, which no camera shows; give another"
        )
    alignment = cfg.alignment
    if alignment is None:
        try:
            alignment = default_policy(teacher.hand, "vision")
        except ValueError as error:
            raise ValueError(
                f"--alignment names what finds the object, a vision policy or what vd-train "
                f"alignment made: {error}"
            ) from error
        print(f"--alignment {alignment}: the network of the hand's installed vision policy")
    network, camera = open_network(alignment, device)
    spec = VisionSpec(
        teacher=policy_name(cfg.teacher), camera=cfg.camera or camera, alignment=network.cfg
    )
    return VisionPolicy(teacher, replace(teacher.contract, tracking=spec), network)


def _contract(policy: "AnyCameraPolicy", spec: Any) -> "Contract":
    """What the file says of a policy that sees so, with the hand of its teacher."""
    from vd.assets_usd.hands import load_hand
    from vd.envs.cfg import ReorientCfg
    from vd.policy.contract import derive_interface

    if policy.kind == "student":
        return replace(policy.contract, student=spec)
    task = ReorientCfg.of(policy)
    interface = derive_interface(task, load_hand(task.hand, task.fingertip), spec)
    return replace(policy.contract, tracking=spec, interface=interface)


def _episodes(cfg: TrackerCfg, policy: "AnyCameraPolicy", device: str) -> "Trace":
    """Episodes that nothing stops."""
    from vd.assets_usd.objects.sets import load_set
    from vd.envs.reorient import ReorientEnv
    from vd.evaluate.compare import actor_of, envs_for, run_episodes, task_of
    from vd.evaluate.symmetry import with_symmetries

    count = len(load_set(list(cfg.objects)))
    assert cfg.episodes is not None
    each = math.ceil(cfg.episodes / count)
    envs = cfg.num_envs or envs_for(count, each, device, camera=True)
    flags = {field.name: getattr(cfg, field.name) for field in fields(EpisodeFlags)}
    flags["episodes"] = each
    evaluation = EvalCfg(policies=(cfg.teacher,), no_at_rest=True, **flags)
    env = ReorientEnv(task_of(evaluation, policy, cfg.objects, envs), device)
    env.objects = with_symmetries(env.objects, device)
    acting = actor_of(
        cfg.teacher, policy, env, goals=cfg.goals, sensor_errors=cfg.sensor_errors, seed=cfg.seed
    )
    trace = run_episodes(evaluation, env, *acting)
    env.close()
    return trace


def _conditions(cfg: TrackerCfg, episodes: int) -> str:
    """On what rules were found."""
    names = ", ".join(Path(item).name for item in cfg.objects)
    parts = [f"{names}: {episodes} episodes", f"goals by {cfg.goals}"]
    parts += ["in the air"] if cfg.in_air else []
    parts += [] if cfg.sensor_errors else ["without sensor errors"]
    return ", ".join([*parts, f"tolerance {cfg.stop_tolerance:g} rad", f"seed {cfg.seed}"])
