"""Find out what a servo has that its model lacks, and write the model that has it."""

import subprocess
import sys
from pathlib import Path

import vd

if __name__ == "__main__":  # worker processes import this file
    # Stands for vd-deploy record on a machine: a servo in which friction is hidden.
    hidden = ["--effect", "coulomb_friction:tau_c_nm=0.15", "--out", "recording"]
    subprocess.run([sys.executable, "-m", "vd.gap.cli", "hide", "servo", *hidden], check=True)

    report = vd.analyse_gap("recording", "gap", effects=("coulomb_friction",))
    print(report.verdict, [effect.name for effect in report.effects])
    assert report.closing is not None
    before, after = report.closing.baseline_rmse_rad, report.closing.identified_rmse_rad
    print(f"error {before:.4f} rad, with the identified model {after:.4f} rad")
    print("use it with --hand-layer:", Path("gap/identified.usda"))
