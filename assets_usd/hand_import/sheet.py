"""A picture of an imported hand.

Links and colliders, axes, tips, and the joints with their limits.
"""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from vd.assets_usd.hand_data import HandModel, compose, placed
from vd.assets_usd.hand_import.author import shape_mesh
from vd.assets_usd.hand_import.source import Shape
from vd.assets_usd.objects.geometry import convex_hull
from vd.assets_usd.objects.sheet import look_at, part_colour, save_figure

VIEWS = {"from the front": (12.0, -60.0), "from above": (89.0, -90.0), "from the side": (0.0, 0.0)}
"""Name, elevation and azimuth [degrees] of the pictures, world frame."""
AXIS_M = 0.012
ARROW = "#222222"
"""Half a length of an axis, drawn through its joint."""
TIP = "#c02020"


def _collider(shape: Any) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a collider in its link."""
    if shape.kind == "hull":
        hull = convex_hull(shape.vertices)
        return placed(shape.frame, hull.vertices), hull.faces
    return shape_mesh(Shape(shape.kind, shape.size, shape.frame, collides=True))


def _draw(axes: Any, hand: HandModel, links: np.ndarray, joints: np.ndarray) -> None:
    """Colliders in one colour a link, axes of the joints, fingertips, drop point."""
    corners = []
    for shape in hand.shapes:
        vertices, faces = _collider(shape)
        corners.append(placed(links[shape.link], vertices)[faces].reshape(-1, 3))
        hue = part_colour(shape.link, 0.5 if shape.link else 0.0, 0.85)
        axes.add_collection3d(
            Poly3DCollection(
                corners[-1].reshape(-1, 3, 3),
                facecolors=[hue],
                edgecolors=[hue],
                linewidths=0.2,
                alpha=0.45,
            )
        )
    for joint, frame in enumerate(joints):
        ends = placed(frame, np.outer([-AXIS_M, AXIS_M], hand.joint_axis[joint]))
        axes.plot(*ends.T, color=ARROW, linewidth=1.2)
        axes.text(*ends[1], hand.joint_names[joint].split("_j")[-1], fontsize=5, color=ARROW)
    tips = compose(links[hand.tip_link], hand.tip_frame)[:, :3]
    axes.scatter(*tips.T, color=TIP, s=12, depthshade=False)
    axes.scatter(*np.array(hand.workspace.drop_m)[:, None], color="#20a040", s=25, marker="x")
    points = np.concatenate([*corners, [hand.workspace.drop_m]])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    look_at(axes, middle, np.abs(points - middle).max(), 1.35)


def joint_table(hand: HandModel, sources: list[str]) -> str:
    """A line for each joint.

    Name, the source's, limits, start, drive, motor or the joint that it follows.
    """
    width = max(map(len, ["source", *sources]))
    lines = [f"joint  {'source':{width}}   limits [rad]    start  N m    kp     kd    moves by"]
    for i, name in enumerate(hand.joint_names):
        motor = hand.motors[i]
        leader = hand.mimic[i]
        if leader >= 0:
            moves = f"{hand.mimic_factor[i]:g} x {hand.joint_names[leader]}"
        else:
            moves = f"{motor.model} {motor.id}" if motor else "a motor"
        lines.append(
            f"{name:6} {sources[i]:{width}} {hand.lower[i]:7.3f} {hand.upper[i]:7.3f} "
            f"{hand.start[i]:8.3f} {hand.effort[i]:5.2f} {hand.kp[i]:6.2f} {hand.kd[i]:6.3f}  "
            f"{moves}"
        )
    return "\n".join(lines)


def hand_sheet(hand: HandModel, sources: list[str], path: Path) -> Path:
    """Draw a hand at its start, mounted in the world.

    Args:
        hand: The hand.
        sources: What its joints are called in the source [D].
        path: File to write; its suffix says which format.
    """
    links = compose(hand.mount, hand.forward_kinematics(hand.start))
    joints = compose(links[hand.joint_parent], hand.joint_parent_frame)
    figure = Figure((13.0, 4.6 + 0.14 * hand.num_joints), dpi=110)
    text = 0.14 * (hand.num_joints + 2) / figure.get_figheight()
    for column, (name, (elevation, azimuth)) in enumerate(VIEWS.items()):
        axes: Any = figure.add_axes((column / 3.0, text, 1.0 / 3.0, 0.92 - text), projection="3d")
        _draw(axes, hand, links, joints)
        axes.view_init(elevation, azimuth)
        axes.set_title(name, fontsize=8)
    place = hand.workspace
    title = (
        f"{hand.name}: {hand.num_fingers} fingers, {hand.num_joints} joints, {len(hand.shapes)} "
        f"colliders, {hand.link_mass.sum():.3f} kg, palm {'up' if hand.palm_up else 'down'}; "
        f"objects of {1e3 * place.size_m[0]:.0f} to {1e3 * place.size_m[1]:.0f} mm; red: "
        "fingertips, green: drop point"
    )
    figure.text(0.01, 0.97, title, fontsize=9, va="top")
    figure.text(0.03, text, joint_table(hand, sources), fontsize=6.5, va="top", family="monospace")
    return save_figure(figure, path)
