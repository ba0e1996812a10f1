"""Evaluate policies on an object: the same starts and goals for all of them."""

from pathlib import Path

import vd

result = vd.evaluate_policies(
    *("dclaw4", "zero"),
    hand="dclaw4",
    objects=("cube",),
    episodes=4,
    episode_s=3.0,
    device="cpu",
    out=Path("eval"),
)
for row in result.rows:
    print(
        f"{row.policy}, stopped by {row.stopped_by}: {row.successes.mean():.0%} of "
        f"{row.successes.size}"
    )
print(len(vd.read("eval/eval.json").rows), "rows in eval/eval.json")
