"""Find out what a servo has that its model lacks, and write the model that has it."""

import subprocess
import sys
from pathlib import Path

import vd

# Stands for vd-deploy record on a machine: a servo in which friction is hidden.
hidden = ["--effect", "coulomb_friction:tau_c_nm=0.15", "--out", "recording"]
subprocess.run([sys.executable, "-m", "vd.gap.cli", "hide", "servo", *hidden], check=True)

report = vd.analyse_gap("recording", "gap", effects=("coulomb_friction", "command_delay"))
print(report.verdict, [effect.name for effect in report.effects])
assert report.closing is not None
print(f"error {report.closing.baseline_rmse_rad:.4f} rad, then {report.closing.identified_rmse_rad:.4f} rad")
print("use it:", Path("gap/identified.usda"))
