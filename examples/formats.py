"""Read a recording that was written by hand, write it again, and a policy."""

import json
from pathlib import Path

import numpy as np

import vd

time = np.arange(0.0, 3.0, 0.01)
command = np.where(time > 0.5, 0.8, 0.0)
position = 0.8 * (1.0 - np.exp(-np.clip(time - 0.53, 0.0, None) / 0.1))
table = np.stack([time, command, position], axis=1)
header = {
    "format": "vd-recording/1",
    "model": "servo",
    "joints": ["joint"],
    "encoder_resolution_rad": 2.0 * np.pi / 4096,
    "trajectories": [{"file": "step.csv", "excitation": "step", "joints": ["joint"]}],
}
Path("mine").mkdir(exist_ok=True)
np.savetxt(
    "mine/step.csv", table, delimiter=",", header="t,command.joint,position.joint", comments=""
)
Path("mine/recording.json").write_text(json.dumps(header))

recording = vd.read("mine")  # checked: a mistake is named by file, row and column
print(recording.joints, recording.trajectories[0].position.shape)
vd.write(recording, "again")

vd.write(vd.load_policy("dclaw4", device="cpu"), "mine.safetensors")
print(vd.read("mine.safetensors").hand)
