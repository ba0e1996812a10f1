"""Frames and video files: the picture, the goal beside it, and a strip of numbers."""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from PIL import Image, ImageDraw, ImageFont

from vd.command.files import atomic_path
from vd.geometry.quaternions import rotation_distance
from vd.paper import PAPER
from vd.play.render import Picture, Renderer

if TYPE_CHECKING:
    from vd.envs.reorient import ReorientEnv

SINGLE_CELL = (640, 400)
"""Width and height of a cell's picture alone [pixel]."""
GRID_CELL = (480, 300)
"""The same in a grid."""
STRIP_HEIGHT = 60
MARGIN = 10
# A reached goal or a drop colours the frame's edge for this many control steps, half a second.
FLASH_STEPS = 6
INK = (28, 35, 48)
SOFT = (110, 119, 134)
STRIP = (250, 251, 252)
GREEN = (0, 140, 100)
RED = (205, 70, 20)
GOAL_EDGE = (89, 173, 107)
# H.264 quality of libx264 (0 lossless, 51 worst): no visible blocks at this size, about 0.5 MB for
# 10 s.
VIDEO_CRF = 22


@dataclass(frozen=True)
class Snapshot:
    """What is shown of one environment after one control step."""

    name: str
    """Object name."""
    time_s: float
    """Since the recording began."""
    joint_q: np.ndarray
    """Hand joints [rad], object position [m] and quaternion xyzw, shape [D + 7]."""
    goal_quat: np.ndarray
    """Goal orientation xyzw, shape [4]."""
    error_rad: float
    """Orientation error of the step."""
    success: bool
    """A goal was reached in this step."""
    fell: bool
    """The object was dropped in this step."""
    goals: int
    """Goals reached since the recording began."""
    drops: int
    """Drops since the recording began."""
    table: bool = True
    """The table was there."""
    believed_rad: float | None = None
    """The error that a policy which sees by camera expected, to the nearest goal that looks
    alike.
    """
    alike_rad: float | None = None
    """The true error to that."""
    latency_s: float | None = None
    """Time that the policy took to decide; on a hand from the image, or the joints, to the
    command.
    """


class Watcher:
    """Reads chosen environments of an environment after every step, and counts goals and drops."""

    def __init__(self, env: "ReorientEnv", envs: Sequence[int]):
        self.env = env
        self.envs = list(envs)
        self.steps = 0
        self.goals = np.zeros(len(self.envs), dtype=int)
        self.drops = np.zeros(len(self.envs), dtype=int)

    def read(self, *, stepped: bool = True) -> list[Snapshot]:
        """The present state of the watched environments; not ``stepped`` after a reset."""
        env = self.env
        envs = self.envs
        success = (env.success.numpy()[envs] != 0) & stepped
        fell = (env.fell.numpy()[envs] != 0) & stepped
        self.goals += success
        self.drops += fell
        self.steps += stepped
        q = env.sim.joint_q.numpy()[envs]
        goal = env.goal_quat.numpy()[envs]
        error = env.rotation_error.numpy()[envs]
        table = env.has_table()[envs]
        if not stepped:  # what the environment holds is of the step before the reset
            error = rotation_distance(q[:, -4:].astype(float), goal.astype(float))
        return [
            Snapshot(
                name=env.objects[env.world_object[world]].name,
                time_s=self.steps / env.cfg.sim.control_hz,
                joint_q=q[i].copy(),
                goal_quat=goal[i].copy(),
                error_rad=float(error[i]),
                success=bool(success[i]),
                fell=bool(fell[i]),
                goals=int(self.goals[i]),
                drops=int(self.drops[i]),
                table=bool(table[i]),
            )
            for i, world in enumerate(envs)
        ]


def watched(
    env: "ReorientEnv", policy: Any, envs: Sequence[int], steps: int
) -> Iterator[list[Snapshot]]:
    """Reset, run a policy, and give the start and every control step of some environments."""
    watcher = Watcher(env, envs)
    env.reset()
    yield watcher.read(stepped=False)
    for _ in range(steps):
        act(env, policy)
        yield watcher.read()


def drawn(
    renderer: Renderer, steps: Iterable[list[Snapshot]], *, meanwhile: bool = True
) -> Iterator[np.ndarray]:
    """Draw each of ``steps``; with ``meanwhile`` while the next one is made, on another thread.

    So the kernels of both are compiled at the same time. The renderer has a cell for each snapshot
    of a step.

    Yields:
        Frames, RGB bytes [height, width, 3].
    """
    composer = Composer(renderer.pictured.cells)

    def draw(snapshots: list[Snapshot]) -> np.ndarray:
        pictures = renderer.render(
            np.stack([snapshot.joint_q for snapshot in snapshots]),
            np.stack([snapshot.goal_quat for snapshot in snapshots]),
            np.array([snapshot.table for snapshot in snapshots]),
        )
        return composer.frame(pictures, snapshots)

    with ThreadPoolExecutor(max_workers=1) as pool:
        frames: deque[Future[np.ndarray]] = deque()
        for snapshots in steps:
            frames.append(pool.submit(draw, snapshots))
            if len(frames) > meanwhile:
                yield frames.popleft().result()
        yield from (frame.result() for frame in frames)


def act(env: "ReorientEnv", policy: Any) -> None:
    """Make one control step with the policy's mean action."""
    from vd.evaluate.trace import advance  # needs torch, which the film of a log does not

    advance(env, policy.act(wp.to_torch(env.observation)))


class Composer:
    """Puts pictures and numbers together, cell by cell, into frames."""

    def __init__(self, cells: int):
        self._flash = [(0, INK)] * cells

    def frame(self, pictures: Sequence[Picture], snapshots: Sequence[Snapshot]) -> np.ndarray:
        """One frame of all cells, in a grid as square as it gets; RGB bytes [height, width, 3]."""
        cells = list(map(self._cell, range(len(pictures)), pictures, snapshots))
        return _grid(cells, int(np.ceil(np.sqrt(len(cells)))))

    def _cell(self, index: int, picture: Picture, shot: Snapshot) -> np.ndarray:
        height, width = picture.scene.shape[:2]
        canvas = Image.new("RGB", (width, height + STRIP_HEIGHT), STRIP)
        canvas.paste(Image.fromarray(picture.scene), (0, 0))
        draw = ImageDraw.Draw(canvas)
        self._goal(canvas, draw, picture.goal)
        self._edge(index, draw, shot, width, height)
        _numbers(draw, height + MARGIN, width // 2, shot)
        return np.asarray(canvas)

    def _goal(self, canvas: Image.Image, draw: ImageDraw.ImageDraw, goal: np.ndarray) -> None:
        size = goal.shape[0]
        left = canvas.width - size - MARGIN
        canvas.paste(Image.fromarray(goal), (left, MARGIN))
        draw.rectangle(
            (left, MARGIN, left + size - 1, MARGIN + size - 1), outline=GOAL_EDGE, width=2
        )
        draw.text((left + 7, MARGIN + 4), "goal", fill=GREEN, font=_font(13))

    def _edge(
        self, index: int, draw: ImageDraw.ImageDraw, shot: Snapshot, width: int, height: int
    ) -> None:
        if shot.success or shot.fell:
            self._flash[index] = (FLASH_STEPS, GREEN if shot.success else RED)
        left, color = self._flash[index]
        if left > 0:
            draw.rectangle((0, 0, width - 1, height - 1), outline=color, width=5)
            text = "goal reached" if color == GREEN else "dropped"
            draw.text((MARGIN + 4, MARGIN), text, fill=color, font=_font(22))
            self._flash[index] = (left - 1, color)


def _numbers(draw: ImageDraw.ImageDraw, y: int, half: int, shot: Snapshot) -> None:
    name = shot.name if len(shot.name) <= 22 else shot.name[:21] + "…"
    within = shot.error_rad <= PAPER.success.rotation_rad
    draw.text((MARGIN, y - 2), name, fill=INK, font=_font(14))
    error = f"error {shot.error_rad:.2f} rad"
    draw.text((MARGIN, y + 17), error, fill=GREEN if within else INK, font=_font(18))
    counts = f"{shot.time_s:.1f} s   goals {shot.goals}   drops {shot.drops}"
    draw.text((half, y + 22), counts, fill=SOFT, font=_font(12))


@lru_cache(maxsize=8)
def _font(size: int) -> Any:
    return ImageFont.load_default(size)


def _grid(cells: Sequence[np.ndarray], columns: int) -> np.ndarray:
    """Tile equal pictures in rows; the last row is filled with white."""
    white = [np.full_like(cells[0], 255)] * (-len(cells) % columns)
    tiles = [*cells, *white]
    firsts = range(0, len(tiles), columns)
    return np.vstack([np.hstack(tiles[first : first + columns]) for first in firsts])


def write_frames(path: Path, frames: Iterable[np.ndarray], fps: float) -> int:
    """Write frames, RGB bytes [height, width, 3], to a video as they come, atomically.

    H.264 plays everywhere. Returns the number of frames.
    """
    import imageio_ffmpeg

    count = 0
    rest = iter(frames)
    first = next(rest)
    with atomic_path(path) as temporary:
        writer = imageio_ffmpeg.write_frames(
            str(temporary),
            (first.shape[1], first.shape[0]),
            fps=fps,
            codec="libx264",
            pix_fmt_out="yuv420p",
            quality=None,
            macro_block_size=2,
            ffmpeg_log_level="error",
            output_params=["-crf", str(VIDEO_CRF), "-movflags", "+faststart"],
        )
        writer.send(None)
        for frame in chain([first], rest):
            writer.send(np.ascontiguousarray(frame))
            count += 1
        writer.close()
        # The writer does not say if it failed.
        written, _ = imageio_ffmpeg.count_frames_and_secs(str(temporary))
        if written != count:
            raise RuntimeError(f"{path}: {written} of {count} frames were written")
    return count
