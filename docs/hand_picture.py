"""Draw docs/hand.png: ``python docs/hand_picture.py``. The fingers close on an object, and stop."""

from pathlib import Path

import numpy as np
import warp as wp
from PIL import Image, ImageDraw

from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.files import atomic_path
from vd.render import Renderer

OBJECTS = ("procedural-6-seed0",)
SHOWN = (0, 2, 4)
# Half a second to fall onto the table, then the middle joints of all fingers bend inward (-q2 is inward).
SETTLE_STEPS, CLOSE_STEPS, INWARD = 8, 9, (0.0, -0.3, 0.12)
START, GOAL = (0.0, 0.0, 0.38, 0.92), (0.30, 0.55, 0.20, 0.75)
WIDTH, HEIGHT, GOAL_SIZE = 480, 440, 128
SAMPLES = 4
GOAL_EDGE = (89, 173, 107)


def main() -> None:
    """Simulate, draw the worlds side by side, write the PNG beside this file."""
    cfg = ReorientCfg(objects=OBJECTS, num_worlds=6, randomisation=RandomisationCfg(enabled=False))
    env = ReorientEnv(cfg, "cpu")
    start, goal = (np.tile(np.array(q) / np.linalg.norm(q), (cfg.num_worlds, 1)) for q in (START, GOAL))
    env.reset(object_quat=start, goal_quat=goal)
    inward = np.tile(INWARD, env.num_fingers)
    for step in range(SETTLE_STEPS + CLOSE_STEPS):
        action = inward if step >= SETTLE_STEPS else 0.0 * inward
        env.step(wp.array(np.tile(action, (cfg.num_worlds, 1)), dtype=wp.float32, device="cpu"))
    objects = [env.objects[env.world_object[world]] for world in SHOWN]
    renderer = Renderer(env.hand, objects, width=WIDTH, height=HEIGHT, goal_size=GOAL_SIZE, samples=SAMPLES)
    pictures = renderer.render(env.sim.joint_q.numpy()[list(SHOWN)], goal[list(SHOWN)])
    canvas = Image.new("RGB", (WIDTH * len(SHOWN), HEIGHT))
    draw = ImageDraw.Draw(canvas)
    for column, picture in enumerate(pictures):
        canvas.paste(Image.fromarray(np.ascontiguousarray(picture.scene)), (column * WIDTH, 0))
        left, top = (column + 1) * WIDTH - GOAL_SIZE - 10, HEIGHT - GOAL_SIZE - 10
        canvas.paste(Image.fromarray(np.ascontiguousarray(picture.goal)), (left, top))
        draw.rectangle((left, top, left + GOAL_SIZE, top + GOAL_SIZE), outline=GOAL_EDGE, width=3)
    with atomic_path(Path(__file__).with_name("hand.png")) as temporary:
        canvas.quantize(192, dither=Image.Dither.NONE).save(temporary, optimize=True)


if __name__ == "__main__":
    main()
