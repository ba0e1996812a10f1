"""Motions of an object without a robot: a cube in MuJoCo that is not as its file says."""

from pathlib import Path

import vd
from vd.gap.bench.hidden_contact import ContactPlant, hide_contact

hidden = {"table_friction": 0.4, "restitution": 0.5, "mass": 0.2, "centre_of_mass": (0.01, 0, 0)}
plant = ContactPlant(vd.load_objects("cube")[0], hidden)
# Stands for a tracker and a finger with a force sensor, which is not pressed on the cube here.
truth = hide_contact(plant, Path("rec-cube"), {"drop": 16, "slide": 5, "push": 5})
print("hidden in rec-cube:", ", ".join(truth["hidden"]))
