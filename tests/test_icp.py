"""Iterated closest points to planes, against SciPy's rotations and NumPy's planes."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from vd.vision.icp import normals, refine


def boxes(count, seed=0):
    """Points and normals of a box of 4 x 6 x 9 cm [m], drawn evenly in area [B, 500, 3] each."""
    rng, half = np.random.default_rng(seed), np.array([0.02, 0.03, 0.045])
    area = half.prod() / half
    axis = rng.choice(3, (count, 500), p=area / area.sum())
    normal = np.eye(3)[axis] * rng.choice([-1.0, 1.0], (count, 500, 1))
    points = half * np.where(normal == 0.0, rng.uniform(-1.0, 1.0, normal.shape), normal)
    return torch.tensor(points, dtype=torch.float32), normal


def test_normals_are_those_of_the_faces():
    points, normal = boxes(2)
    along = np.abs((normals(points).numpy() * normal).sum(axis=-1))
    assert np.median(along) > 0.98 and (along > 0.9).mean() > 0.7  # at edges they are between


def test_what_lies_nearly_right_comes_to_lie_right_from_one_side_with_outliers():
    goal, _ = boxes(9)
    seen, _ = boxes(9, seed=1)
    true = Rotation.random(9, random_state=1)
    turn = torch.tensor(true.as_matrix(), dtype=torch.float32)
    place = torch.tensor([[0.01, -0.02, 0.03]]).expand(9, -1)
    seen = torch.stack([cloud[cloud.sum(dim=1) > -0.01][:200] for cloud in seen])
    seen = seen @ turn.transpose(-1, -2) + place[:, None]
    seen[:, :15] += 0.03  # what is the hand's
    near = Rotation.from_rotvec([[0.2, -0.1, 0.15]]) * true
    start = torch.tensor(near.as_matrix(), dtype=torch.float32)
    found, offset, misfit = refine(goal, normals(goal), seen, start, place + 0.005, 10)
    off = (Rotation.from_matrix(found.numpy()) * true.inv()).magnitude()
    assert np.quantile(off, 0.75) < 0.03 and (offset - place).norm(dim=1).max() < 0.003
    before = refine(goal, normals(goal), seen, start, place + 0.005, 0)[2]
    assert misfit.mean() < 0.95 * before.mean()
