"""Shapes for the training of vision.

Bodies against their equations, unions, deformations, sizes.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from vd.train.student import shapes
from vd.train.student.shapes import Deformation, deformed, made_shapes, mesh_shapes, random_bodies

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def implicit(points, half, exponents):
    """Barr's inside-outside function in double precision, [P]."""
    x, y, z = np.abs(points / half).T
    along, around = exponents
    return (x ** (2 / around) + y ** (2 / around)) ** (around / along) + z ** (2 / along)


@pytest.mark.parametrize("place", [0, 1])
def test_points_of_superquadrics_solve_their_equation_and_normals_follow_it(place):
    bodies = random_bodies(12, place, CPU)
    bodies = replace(bodies, ring=torch.zeros_like(bodies.ring))
    points, normals, _ = bodies.sample(300)
    for row in range(12):
        own = (points[row].double() @ bodies.turn[row].double()).numpy()
        half, exponents = bodies.half[row].double().numpy(), bodies.exponents[row].double().numpy()
        value = implicit(own, half, exponents) ** (exponents[0] / 2)
        np.testing.assert_allclose(value, 1.0, atol=2e-4)
        step = 1e-6 * half.min()
        slope = np.stack(
            [
                implicit(own + step * axis, half, exponents)
                - implicit(own - step * axis, half, exponents)
                for axis in np.eye(3)
            ],
            axis=1,
        )
        expected = slope / np.linalg.norm(slope, axis=1, keepdims=True)
        found = (normals[row].double() @ bodies.turn[row].double()).numpy()
        agree = (found * expected).sum(axis=1)
        assert np.quantile(agree, 0.02) > 0.999  # at an edge two faces are one point


def test_points_and_normals_of_tori():
    bodies = random_bodies(4, 1, CPU)
    bodies = replace(bodies, ring=torch.ones_like(bodies.ring), centre=torch.randn(4, 3))
    points, normals, area = bodies.sample(2000)
    assert bodies.level(points).abs().max() < 1e-4
    inwards = bodies.level(points - 0.5 * bodies.radii[:, None, 1:] * normals)
    torch.testing.assert_close(inwards, torch.full_like(inwards, -0.5), atol=1e-3, rtol=0)
    whole = 4 * np.pi**2 * bodies.radii.prod(dim=1)
    torch.testing.assert_close(area.mean(dim=1), whole, rtol=0.05, atol=0)


def test_areas_of_a_box_and_a_sphere():
    bodies = random_bodies(2, 0, CPU)
    half = torch.tensor([[0.3, 0.2, 0.1], [0.25, 0.25, 0.25]])
    exponents = torch.tensor([[0.05, 0.05], [1.0, 1.0]])
    bodies = replace(bodies, half=half, exponents=exponents, ring=torch.zeros(2, dtype=torch.bool))
    _, _, area = bodies.sample(40000)
    box = 8 * (0.3 * 0.2 + 0.2 * 0.1 + 0.1 * 0.3)
    np.testing.assert_allclose(area.mean(dim=1), [box, 4 * np.pi * 0.25**2], rtol=0.05)


def test_no_point_of_a_union_lies_in_another_body(monkeypatch):
    bodies, samples, number = shapes.draw_parts(30, CPU)
    monkeypatch.setattr(shapes, "draw_parts", lambda count, device: (bodies, samples[:], number))
    monkeypatch.setattr(shapes, "HOLLOWS", 0.0)
    made = shapes.unions(30, 500, CPU)
    assert made.isfinite().all()
    levels = torch.stack([body.level(made[..., :3]) for body in bodies])
    levels[torch.arange(5)[:, None] >= number] = 1.0  # those that do not count
    nearest = levels.amin(dim=0)
    assert nearest.min() > -2e-3 and nearest.max() < 2e-3, "on the surface of one, inside of none"


def test_a_hollow_opens_the_first_body(monkeypatch):
    monkeypatch.setattr(shapes, "HOLLOWS", 1.0)
    monkeypatch.setattr(shapes, "BODIES", 1)
    bodies, samples, number = shapes.draw_parts(40, CPU)
    monkeypatch.setattr(shapes, "draw_parts", lambda count, device: (bodies, samples[:], number))
    made = shapes.unions(40, 500, CPU)
    level = bodies[0].level(made[..., :3])
    inside = (level < -1e-3).float().mean(dim=1)
    assert (inside[~bodies[0].ring] > 0.1).all() and level.max() < 2e-3
    # From the wall of a hollow the normal leads into the hollow: towards the middle of the body.
    row = int((~bodies[0].ring).nonzero()[0])
    wall = made[row][level[row] < -0.05]
    assert (
        bodies[0].level((wall[:, :3] + 1e-3 * wall[:, 3:])[None].expand(40, -1, -1))[row] < 0
    ).all()


def test_deformed_normals_are_those_of_the_deformed_surface():
    """Of spheres: normals stand on the tangents that automatic differentiation gives."""
    ball = torch.nn.functional.normalize(torch.randn(16, 200, 3), dim=-1)
    deformation = Deformation.draw(16, 1.0, CPU)
    found = deformed(torch.cat([0.4 * ball, ball], dim=-1), deformation)
    tangent = torch.linalg.cross(ball, torch.randn(16, 200, 3))
    _, carried = torch.func.jvp(deformation, (0.4 * ball,), (tangent,))
    along = torch.nn.functional.normalize(carried, dim=-1)
    assert ((found[..., 3:] * along).sum(-1).abs() < 0.02).float().mean() > 0.995
    outwards = ((found[..., :3] - found[..., :3].mean(dim=1, keepdim=True)) * found[..., 3:]).sum(
        -1
    ) > 0
    assert outwards.float().mean() > 0.95


def test_shapes_have_sizes_of_objects_and_differ():
    low, high = sides = 0.05, 0.12
    meshes = torch.cat([made_shapes(3, 600, sides, CPU) for _ in range(2)])
    for some in (made_shapes(40, 512, sides, CPU), mesh_shapes(meshes.half(), 40, 512, sides)):
        assert some.shape == (40, 512, 6) and some.isfinite().all()
        torch.testing.assert_close(
            some[..., 3:].norm(dim=-1), torch.ones(40, 512), atol=1e-3, rtol=0
        )
        side = (some[..., :3].amax(dim=1) - some[..., :3].amin(dim=1)).amax(dim=-1)
        assert side.min() >= low - 1e-5 and side.max() <= high + 1e-5 and side.std() > 0.01
        torch.testing.assert_close(some[..., :3].mean(dim=1), torch.zeros(40, 3), atol=1e-5, rtol=0)
