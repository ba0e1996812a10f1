"""Draw hands-curves.png: what both hands' teachers reach on held-out shapes as training goes on.

The numbers are those of runs.md and first-runs.md (full success test, 13 x 100 held-out episodes):
million control steps, GPU hours of an H200 so far, per cent within 0.4 rad, and its 95 % interval.

Run from the repository's root: python docs/results/hands_curves.py
"""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

THREE = (
    (98, 0.17, 11.4, 8.8, 14.3),
    (197, 0.33, 24.1, 19.1, 31.5),
    (295, 0.50, 30.5, 25.0, 37.0),
    (392, 0.66, 35.2, 28.7, 41.8),
    (541, 0.96, 36.7, 28.9, 44.2),
    (672, 1.21, 48.6, 39.1, 55.8),
    (732, 1.33, 58.8, 49.8, 66.2),
    (850, 1.56, 72.2, 60.8, 79.5),
    (919, 1.71, 77.0, 66.8, 82.2),
    (1014, 1.91, 84.8, 75.3, 89.8),
)
FOUR = (
    (98, 0.22, 8.7, 7.3, 10.1),
    (197, 0.44, 17.2, 14.2, 21.1),
    (293, 0.66, 22.9, 18.2, 28.9),
    (356, 0.79, 36.7, 31.5, 42.7),
    (468, 1.02, 62.7, 55.9, 68.8),
    (531, 1.17, 75.3, 68.1, 80.1),
    (618, 1.37, 78.6, 72.9, 83.5),
)
FROM_NOTHING = ((83, 0.15, 12.5, 9.5, 16.0),)
PAPER_STUDENT = 85.0
"""The paper's three-finger student on its held-out objects, Table 1."""
SERIES = (
    ("three fingers", THREE, "#0072B2"),
    ("four fingers", FOUR, "#D55E00"),
    ("three, procedural objects alone", FROM_NOTHING, "#009E73"),
)


def main() -> None:
    """Write hands-curves.png beside this file."""
    figure, axes = plt.subplots(1, 2, figsize=(11, 4), sharey=True, layout="constrained")
    for axis, column, label in ((axes[0], 0, "control steps [million]"), (axes[1], 1, "GPU hours (H200)")):
        for name, points, colour in SERIES:
            x, rate = [p[column] for p in points], [p[2] for p in points]
            spread = [[p[2] - p[3] for p in points], [p[4] - p[2] for p in points]]
            axis.errorbar(x, rate, yerr=spread, color=colour, marker="o", capsize=3, label=name)
        axis.axhline(PAPER_STUDENT, color="0.5", linestyle="--", label="the paper's student, three fingers")
        axis.set(xlabel=label, xlim=(0.0, None), ylim=(0.0, 100.0))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("held-out episodes within 0.4 rad [%]")
    axes[1].legend(loc="lower right", fontsize="small")
    figure.savefig(Path(__file__).with_name("hands-curves.png"), dpi=110)


if __name__ == "__main__":
    main()
