"""Command line of the viewer: ``vd-play POLICY``, in the browser or, with ``--video``, to a file.

``vd-play LOG`` replays a run on a hand.
"""

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from vd.command import interrupt
from vd.command.config import require
from vd.command.device import resolve_device
from vd.command.files import check_file
from vd.command.line import flags_of, parse, say_same_as
from vd.command.warp_quiet import quiet_warp
from vd.evaluate.cfg import LOG_EVERY_S, POLICY_HELP, HandFlags, TaskFlags, episode_limit_s
from vd.logs.hand_log import is_log
from vd.paper import PAPER
from vd.policy.agents import DEFAULT_HAND, check_names, default_policy
from vd.sim.cfg import in_mujoco

if TYPE_CHECKING:
    from vd.play.replay import Replay
    from vd.play.session import Session

VIDEO_SECONDS = 10.0
# A CPU simulates this many environments about in real time.
FAST_WORLDS_CPU = 16


@dataclass(kw_only=True)
class PlayCfg(HandFlags, TaskFlags):
    """Watch a policy: in the browser, or as a video made without a display or GPU.

    Starts and goals are as trained; without a policy objects drop, and goals are all of SO(3).

    The folder of a log of vd-deploy, in place of the policy, replays that run, all of it,
    whatever the other settings of the simulation. Without a policy it shows the hand's teacher.
    """

    policy: Annotated[str, tyro.conf.Positional, tyro.conf.arg(help=POLICY_HELP)] = ""
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

    def validate(self) -> None:
        """Raise ValueError naming the flag and the remedy."""
        require(self, "--", "positive", "cells seconds")
        if not 0 < self.port < 65536:
            raise ValueError(f"--port is {self.port}; it has to be from 1 to 65535")
        if self.video is not None and self.video.suffix.lower() != ".mp4":
            raise ValueError(f"--video is {self.video}; use a name that ends in .mp4")


@interrupt.command("vd-play")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``vd-play``; returns the exit status."""
    cfg: PlayCfg = parse(PlayCfg, arguments, prog="vd-play")
    cfg.validate()
    if not cfg.policy:
        cfg = replace(cfg, policy=default_policy(cfg.hand or DEFAULT_HAND, "teacher"))
        words = (cfg.policy, "--objects", *cfg.objects, "--port", cfg.port)
        say_same_as("vd-play", *words, *flags_of(cfg, "policy", "objects", "port"))
    if cfg.video is not None:
        interrupt.need("imageio_ffmpeg")
        check_file(cfg.video)
    recorded = is_log(cfg.policy)
    if not recorded:
        check_names([cfg.policy], cfg.objects, cfg.hand)
    quiet_warp()
    if recorded:
        from vd.logs.hand_log import read_log
        from vd.play.replay import Replay, film

        log = read_log(cfg.policy)
        if cfg.video is None:
            serve(Replay(log), cfg)
            return 0
        frames = film(log, cfg.video)
    else:
        if cfg.video is None:
            serve(_session(cfg), cfg)
            return 0
        frames = record_video(cfg, cfg.video)
    print(f"{cfg.video} ({frames} frames)")
    return 0


def record_video(cfg: PlayCfg, path: Path) -> int:
    """Run the agent and write a video; returns the number of frames.

    Raises:
        ValueError: A setting, object set or policy cannot be used.
        FileNotFoundError: There is no such policy.
    """
    env, policy = _open(cfg, num_envs=cfg.cells)
    from tqdm import tqdm

    from vd.play.render import Renderer
    from vd.play.video import GRID_CELL, SINGLE_CELL, drawn, watched, write_frames

    envs = spread(env.world_object, cfg.cells)
    width, height = SINGLE_CELL if cfg.cells == 1 else GRID_CELL
    items = [env.objects[env.world_object[world]] for world in envs]
    renderer = Renderer(env.hand, items, width=width, height=height, device=env.device)
    rate = env.cfg.sim.control_hz
    steps = max(1, round(cfg.seconds * rate))
    # On a GPU what others launch would become part of the step's graph.
    shots = watched(env, policy, envs, steps)
    frames: Iterable[Any] = drawn(renderer, shots, meanwhile=env.device == "cpu")
    refresh = 0.5 if sys.stderr.isatty() else LOG_EVERY_S
    frames = tqdm(frames, total=steps + 1, unit="frame", desc="vd-play", mininterval=refresh)
    count = write_frames(path, frames, rate)
    env.check()
    env.close()
    return count


def serve(session: "Session | Replay", cfg: PlayCfg) -> None:
    """Serve the viewer until Ctrl-C."""
    from vd.play.viewer import PlayViewer

    viewer = PlayViewer(session, host=cfg.host, port=cfg.port)
    print(f"open {viewer.url} in a browser; Ctrl-C ends it", flush=True)
    try:
        viewer.run()
    finally:
        viewer.close()


def spread(world_object: Sequence[int], cells: int) -> list[int]:
    """Environments to show: of different objects first, then more of the same."""
    from vd.evaluate.rollout import place_of

    first = place_of(np.asarray(world_object)).argsort(kind="stable")[:cells]
    return sorted(first.tolist())


def _session(cfg: PlayCfg) -> "Session":
    opened = _open(cfg, num_envs=1)  # what cannot be opened is refused before anything slow
    from vd.play.session import Session

    return Session(*opened, seed=cfg.seed)


def _open(cfg: PlayCfg, *, num_envs: int) -> tuple[Any, Any]:
    """Environment with at least one environment for each object, and what acts in it."""
    from vd.policy.agents import check_fits, open_policy, task_for

    device = resolve_device(cfg.device)
    trained = open_policy(cfg.policy, device)
    check_fits(cfg.policy, trained, cfg.hand, cfg.hand_layer)  # before anything slow
    print(
        f"vd-play: {cfg.policy}; building the scene (the first start compiles kernels: minutes)",
        flush=True,
    )
    from vd.assets_usd.objects.sets import load_set
    from vd.envs.cfg import TableCfg
    from vd.envs.reorient import ReorientEnv
    from vd.evaluate.compare import actor_of

    count = len(load_set(list(cfg.objects)))
    if device == "cpu" and count > FAST_WORLDS_CPU:
        print(
            f"vd-play: {count} objects are {count} environments, slow on a CPU; name fewer with "
            f"--objects"
        )
    task = task_for(
        trained,
        hand=cfg.hand,
        objects=cfg.objects,
        num_envs=max(num_envs, count),
        seed=cfg.seed,
        stop_tolerance_rad=PAPER.success.rotation_rad,
        episode_s=episode_limit_s(None, in_air=cfg.in_air),
        randomised=False,
        success_ends_episode=False,
        hand_layer=cfg.hand_layer,
    )
    if device == "cpu":  # where newton first compiles for a minute
        task = replace(task, sim=in_mujoco(task.sim, task.sim.physics_hz))
    if cfg.in_air:
        task = replace(task, table=TableCfg(away_share=1.0))
    env = ReorientEnv(task, device)
    return env, actor_of(cfg.policy, trained, env, seed=cfg.seed)[0]


if __name__ == "__main__":
    sys.exit(main())
