"""Command line of the viewer: ``vd-play POLICY``, in the browser or, with ``--video``, to a file.

``vd-play LOG`` replays a run on a hand.
"""

import math
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from vd import interrupt
from vd.config import require
from vd.device import resolve_device
from vd.evaluate.agents import DEFAULT_POLICY, LAYER_HELP, check_names, episode_limit_s, start_at_rest
from vd.evaluate.cfg import POLICY_HELP
from vd.files import check_file
from vd.hand_log import is_log
from vd.paper import PAPER
from vd.sim.cfg import Engine, in_mujoco
from vd.warp_quiet import quiet_warp

if TYPE_CHECKING:
    from vd.play.replay import ReplaySession
    from vd.play.session import Session

VIDEO_SECONDS = 10.0
# A CPU simulates this many environments about in real time.
FAST_WORLDS_CPU = 16


@dataclass
class PlayCfg:
    """Watch a policy: in the browser, or as a video made without a display or GPU.

    The folder of a log that vd-deploy wrote in place of the policy replays that run, all of it, whatever the
    other settings of the simulation. Without arguments it shows dclaw4-table.
    """

    policy: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(help=POLICY_HELP)] = None
    hand: str | None = None
    """dclaw3, dclaw4 or a hand's USD; by default the policy's, or dclaw4."""
    hand_layer: Annotated[str | None, tyro.conf.arg(help=LAYER_HELP)] = None
    objects: tuple[str, ...] = ("cube",)
    """Object sets by name, folders or files; the viewer offers each object."""
    video: Path | None = None
    """Write this file, .mp4, and exit."""
    seconds: float = VIDEO_SECONDS
    """Length of the video [s]."""
    cells: int = 1
    """Environments side by side in the video, of different objects as far as there are."""
    port: int = 8080
    """Port of the viewer."""
    host: str = "127.0.0.1"
    """Address of the viewer; 0.0.0.0 lets other machines look."""
    seed: int = 0
    """Seed of starts and goals."""
    max_goal_angle: float | None = None
    """Goals are within this angle [rad] of the object's orientation; pi is all of SO(3). By default as
    trained, and pi without a policy."""
    at_rest: tyro.conf.FlagCreatePairsOff[bool] = False
    """Start at rest on the table; the default is as trained, and a drop for zero and random."""
    no_at_rest: tyro.conf.FlagCreatePairsOff[bool] = False
    """Start from a drop, whatever the training."""
    stop_tolerance: float = PAPER.success.rotation_rad
    """Error [rad] at which a goal counts as reached, with fingers and object still."""
    episode_s: float | None = None
    """Time after which an environment starts anew [s]; 10 by default, 15 with --in-air."""
    in_air: tyro.conf.FlagCreatePairsOff[bool] = False
    """Take the table away after 2 s, as in the paper's test of reorientation in the air."""
    randomise: bool = False
    """Randomise dynamics and add noise and disturbances as in training."""
    device: str = "auto"
    """auto, cpu or cuda:N."""
    engine: Engine | None = None
    """Physics of newton, or MuJoCo's own: the default on a CPU, where newton first compiles for a minute."""

    @property
    def agent_name(self) -> str:
        """Which agent begins."""
        return self.policy or DEFAULT_POLICY

    @property
    def limit_s(self) -> float:
        """Time limit of an episode [s]."""
        return episode_limit_s(self.episode_s, in_air=self.in_air)

    def validate(self) -> None:
        """Raise ValueError naming the flag and the remedy."""
        start_at_rest(self.at_rest, self.no_at_rest)
        require(self, "--", "positive", "cells seconds episode_s")
        if self.max_goal_angle is not None and not 0.0 < self.max_goal_angle <= math.pi + 1e-6:
            raise ValueError(
                f"--max-goal-angle is {self.max_goal_angle}; it must be above 0 and at most pi rad"
            )
        if self.engine == "mujoco" and self.device.startswith("cuda"):
            raise ValueError(f"--engine mujoco steps on the CPU, not on {self.device}; leave --device out")
        if self.video is not None and self.video.suffix.lower() != ".mp4":
            raise ValueError(f"--video is {self.video}; use a name that ends in .mp4")


@interrupt.command("vd-play")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``vd-play``; returns the exit status."""
    cfg = tyro.cli(PlayCfg, args=arguments, prog="vd-play")
    cfg.validate()
    if cfg.video is not None:
        check_file(cfg.video)
    if is_log(cfg.agent_name):
        quiet_warp()
        return replay(cfg)
    check_names([cfg.agent_name], cfg.objects, cfg.hand)
    quiet_warp()
    if cfg.video is not None:
        frames = record_video(cfg, cfg.video)
        print(f"{cfg.video} ({frames} frames)")
    else:
        serve(cfg)
    return 0


def replay(cfg: PlayCfg) -> int:
    """Show the log of a run; returns the exit status.

    Raises:
        LogError: The log cannot be used.
    """
    from vd.hand_log import read_log
    from vd.play.replay import Replay, ReplaySession, film

    log = read_log(cfg.agent_name)
    if cfg.video is None:
        shown = Replay(log)
        _serve(lambda: ReplaySession(shown), cfg)
        return 0
    frames = film(log, cfg.video)
    print(f"{cfg.video} ({frames} frames)")
    return 0


def record_video(cfg: PlayCfg, path: Path) -> int:
    """Run the agent and write a video; returns the number of frames.

    Raises:
        ValueError: A setting, object set or policy cannot be used.
        FileNotFoundError: There is no such policy.
    """
    trained = _policy(cfg)
    from tqdm import tqdm

    from vd.evaluate.cfg import LOG_EVERY_S
    from vd.play.video import GRID_CELL, SINGLE_CELL, record, write_frames
    from vd.render import Renderer

    env, policy = _open(cfg, trained, num_envs=cfg.cells)
    envs = spread(env.world_object, cfg.cells)
    width, height = SINGLE_CELL if cfg.cells == 1 else GRID_CELL
    items = [env.objects[env.world_object[world]] for world in envs]
    renderer = Renderer(env.hand, items, width=width, height=height, device=env.device)
    rate = env.cfg.sim.control_hz
    steps = max(1, round(cfg.seconds * rate))
    frames: Iterable[Any] = record(env, policy, renderer, envs, steps)
    refresh = 0.5 if sys.stderr.isatty() else LOG_EVERY_S
    frames = tqdm(frames, total=steps + 1, unit="frame", desc="vd-play", mininterval=refresh)
    count = write_frames(path, frames, rate)
    env.check()
    env.close()
    return count


def serve(cfg: PlayCfg) -> None:
    """Serve the viewer until Ctrl-C; the page is there, and says so, while the scene is being built."""
    trained = _policy(cfg)
    _serve(lambda: open_session(cfg, trained), cfg)


def _serve(open_it: "Callable[[], Session | ReplaySession]", cfg: PlayCfg) -> None:
    from vd.play.viewer import PlayViewer, open_page

    page = open_page(host=cfg.host, port=cfg.port)
    print(f"open {page.viewer.url} in a browser; Ctrl-C ends it", flush=True)
    try:
        session = open_it()
        try:
            PlayViewer(session, page).run()
        finally:
            session.env.close()
    finally:
        page.viewer.close()


def open_session(cfg: PlayCfg, trained: Any) -> "Session":
    """The environment and policy behind the viewer."""
    from vd.play.session import Session

    return Session(*_open(cfg, trained, num_envs=1), seed=cfg.seed)


def spread(world_object: Sequence[int], cells: int) -> list[int]:
    """Environments to show: of different objects first, then more of the same."""
    seen: dict[int, int] = {}
    rank = []
    for world, index in enumerate(world_object):
        rank.append((seen.get(index, 0), world))
        seen[index] = seen.get(index, 0) + 1
    return sorted(world for _, world in islice(sorted(rank), cells))


def _policy(cfg: PlayCfg) -> Any:
    """What is trained; a file that cannot be used, or is of another hand, is told before anything slow."""
    from vd.evaluate.agents import check_fits, open_policy

    policy = open_policy(cfg.agent_name, resolve_device(cfg.device))
    check_fits(cfg.agent_name, policy, cfg.hand, cfg.hand_layer)
    return policy


def _open(cfg: PlayCfg, trained: Any, *, num_envs: int) -> tuple[Any, Any]:
    """Environment with at least one environment for each object, and what acts in it."""
    from vd.evaluate.agents import task_for

    print(
        f"vd-play: {cfg.agent_name}; building the scene (the first start compiles kernels: minutes)",
        flush=True,
    )
    device = resolve_device(cfg.device)
    from vd.assets_usd.objects.sets import load_set
    from vd.envs.cfg import TableCfg
    from vd.envs.reorient import ReorientEnv
    from vd.evaluate.compare import actor_of

    count = len(load_set(list(cfg.objects)))
    if device == "cpu" and count > FAST_WORLDS_CPU:
        print(f"vd-play: {count} objects are {count} environments, slow on a CPU; name fewer with --objects")
    task = task_for(
        trained,
        hand=cfg.hand,
        objects=cfg.objects,
        num_envs=max(num_envs, count),
        seed=cfg.seed,
        stop_tolerance_rad=cfg.stop_tolerance,
        max_goal_angle_rad=cfg.max_goal_angle,
        episode_s=cfg.limit_s,
        randomised=cfg.randomise,
        success_ends_episode=False,
        at_rest=start_at_rest(cfg.at_rest, cfg.no_at_rest),
        hand_layer=cfg.hand_layer,
    )
    if cfg.engine == "mujoco" or (cfg.engine is None and device == "cpu"):
        task = replace(task, sim=in_mujoco(task.sim, task.sim.physics_hz))
    if cfg.in_air:
        task = replace(task, table=TableCfg(away_share=1.0))
    env = ReorientEnv(task, device)
    return env, actor_of(cfg.agent_name, trained, env, seed=cfg.seed)[0]


if __name__ == "__main__":
    sys.exit(main())
