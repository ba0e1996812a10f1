"""A finger of three joints in closed form, for the hidden plant: equations of Lagrange and dry friction."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

FRICTION_SWEEPS = 3
"""Gauss-Seidel sweeps between two joints; their coupling is one part in ten."""
GRAVITY_M_S2 = 9.81


@dataclass(frozen=True, eq=False)
class FingerBody:
    """A finger that hangs from its mount: the first joint swings it about x, two bend it about y.

    Frames: that of the first joint, z along the straight finger, gravity along ``gravity`` z.

    Attributes:
        mass: Masses of the links [3] [kg].
        com: Distances of the centres of mass from the joints, along the links [3] [m].
        inertia: Principal moments about x, y, z of the links [3, 3] [kg m^2].
        spacing: Distance from the second joint to the third [m].
        offset: Distance from the first joint to the second [m].
        tip: Distance from the third joint to the fingertip [m], where a payload hangs.
        gravity: Acceleration along +z [m/s^2].
    """

    mass: np.ndarray
    com: np.ndarray
    inertia: np.ndarray
    spacing: float
    offset: float
    tip: float
    gravity: float = GRAVITY_M_S2


class Finger:
    """Equations of motion of fingers [B] in closed form; see :class:`FingerBody` for the frames.

    Args:
        bodies: The fingers.
        payload: Point masses at their tips [B] [kg].
    """

    def __init__(self, bodies: Sequence[FingerBody], payload: np.ndarray):
        mass = np.stack([b.mass for b in bodies])
        com = np.stack([b.com for b in bodies])
        inertia = np.stack([b.inertia for b in bodies])
        tip = np.array([b.tip for b in bodies])
        # A point mass at the tip moves the last link's centre of mass and adds to its inertia about it.
        total = mass[:, 2] + payload
        apart = mass[:, 2] * payload / total * (tip - com[:, 2]) ** 2
        com[:, 2] = (mass[:, 2] * com[:, 2] + payload * tip) / total
        mass[:, 2] = total
        self.l1 = np.array([b.offset for b in bodies])
        self.l2 = np.array([b.spacing for b in bodies])
        self.g = np.array([b.gravity for b in bodies])
        self.m1, self.m2, self.m3 = mass.T
        self.r1, self.r2, self.r3 = com.T
        self.x2, self.x3 = inertia[:, 1, 0], inertia[:, 2, 0] + apart
        self.z2, self.z3 = inertia[:, 1, 2], inertia[:, 2, 2]
        self.d2, self.d3 = self.z2 - self.x2, self.z3 - self.x3
        self.swing = self.m1 * self.r1**2 + inertia[:, 0, 0] + self.x2 + self.x3
        y2, y3 = inertia[:, 1, 1], inertia[:, 2, 1] + apart
        self.m33 = y3 + self.m3 * self.r3**2
        self.cross = self.m3 * self.l2 * self.r3
        self.m22 = y2 + self.m2 * self.r2**2 + self.m3 * self.l2**2 + self.m33
        self.first = self.m1 * self.r1

    def _geometry(self, q: np.ndarray) -> tuple[Any, ...]:
        """First moments of mass along and across the straight finger, and sines and cosines."""
        s, c = np.sin(q), np.cos(q)
        s23 = s[:, 1] * c[:, 2] + c[:, 1] * s[:, 2]
        c23 = c[:, 1] * c[:, 2] - s[:, 1] * s[:, 2]
        b2, b3 = self.l2 * s[:, 1], self.r3 * s23  # the third joint, and the last centre from it, along x
        h2 = self.l1 + self.r2 * c[:, 1]  # heights along z of the two centres of mass
        h3 = self.l1 + self.l2 * c[:, 1] + self.r3 * c23
        return s, c, s23, c23, b2, b3, h2, h3

    def weight(self, q: np.ndarray) -> np.ndarray:
        """Torques that hold the finger against gravity [B, 3] [N m]."""
        s, c, _, _, b2, b3, h2, h3 = self._geometry(q)
        return self._weight(s, c, b2, b3, h2, h3)

    def _weight(
        self, s: np.ndarray, c: np.ndarray, b2: np.ndarray, b3: np.ndarray, h2: np.ndarray, h3: np.ndarray
    ) -> np.ndarray:
        upright = self.g * c[:, 0]
        out = np.empty_like(s)
        out[:, 0] = self.g * s[:, 0] * (self.first + self.m2 * h2 + self.m3 * h3)
        out[:, 2] = upright * self.m3 * b3
        out[:, 1] = upright * (self.m2 * self.r2 * s[:, 1] + self.m3 * b2) + out[:, 2]
        return out

    def velocity(
        self,
        q: np.ndarray,
        v: np.ndarray,
        push: np.ndarray,
        resisting: np.ndarray,
        minus: np.ndarray,
        plus: np.ndarray,
        inertia: np.ndarray,
        dt: float,
    ) -> np.ndarray:
        """Speeds after a step [B, 3]: equations of Lagrange, dry friction by complementarity."""
        s, c, s23, c23, b2, b3, h2, h3 = self._geometry(q)
        v1, v2, v3 = v[:, 0], v[:, 1], v[:, 2]
        # Swing inertia and its derivatives by the two bends.
        m11 = (
            self.swing
            + self.m2 * h2 * h2
            + self.m3 * h3 * h3
            + self.d2 * s[:, 1] * s[:, 1]
            + self.d3 * s23 * s23
        )
        by3 = 2.0 * s23 * (self.d3 * c23 - self.m3 * h3 * self.r3)
        by2 = by3 + 2.0 * (s[:, 1] * (self.d2 * c[:, 1] - self.m2 * h2 * self.r2) - self.m3 * h3 * b2)
        m23 = self.m33 + self.cross * c[:, 2]
        m22 = self.m22 + 2.0 * self.cross * c[:, 2]
        bend = self.cross * s[:, 2]
        force = push - self._weight(s, c, b2, b3, h2, h3)
        swing2 = 0.5 * v1 * v1
        force[:, 0] -= v1 * (by2 * v2 + by3 * v3)
        force[:, 1] += swing2 * by2 + bend * v3 * (2.0 * v2 + v3)
        force[:, 2] += swing2 * by3 - bend * v2 * v2

        mass = inertia / dt + resisting
        mass[:, 0] += m11 / dt
        mass[:, 1] += m22 / dt
        mass[:, 2] += self.m33 / dt
        link = m23 / dt
        momentum = mass * v + force
        momentum[:, 1] += link * v3
        momentum[:, 2] += link * v2
        new = v.copy()
        new[:, 0] = slip(momentum[:, 0], minus[:, 0], plus[:, 0]) / mass[:, 0]
        for _ in range(FRICTION_SWEEPS):
            new[:, 1] = slip(momentum[:, 1] - link * new[:, 2], minus[:, 1], plus[:, 1]) / mass[:, 1]
            new[:, 2] = slip(momentum[:, 2] - link * new[:, 1], minus[:, 2], plus[:, 2]) / mass[:, 2]
        return new


def slip(momentum: np.ndarray, minus: np.ndarray, plus: np.ndarray) -> np.ndarray:
    """What dry friction leaves of a push: nothing within its bounds (stick), else the rest (slip)."""
    return momentum - np.minimum(np.maximum(momentum, -minus), plus)
