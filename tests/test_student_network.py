"""The student's network: sizes of the paper, memory, heads, and what they may depend on."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
import torch
import warp as wp

from vd.config import from_dict, to_dict
from vd.paper import PAPER
from vd.vision.cfg import LEAN, PAPER_NETWORK, PRESETS, EncoderCfg, StudentCfg
from vd.vision.network import Student, voxel_features
from vd.vision.voxels import Voxeliser

ACTIONS = 12
SMALL = StudentCfg(
    encoder=EncoderCfg(channels=(4, 8), blocks=1, embedding=16, inputs=("constant",)),
    proprioception=("action",),
    action_hidden=8,
    memory=12,
    head_hidden=16,
    distance_hidden=8,
)


@pytest.fixture(autouse=True)
def one_thread():
    """Small products: threads would only wait for each other on busy cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def clouds(count: int, points: int = 200, seed: int = 0) -> np.ndarray:
    """Points [count, points, 3] on spheres of different sizes."""
    generator = np.random.default_rng(seed)
    directions = generator.normal(size=(count, points, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return (directions * generator.uniform(0.03, 0.08, (count, 1, 1))).astype(np.float32)


def sites(points: np.ndarray, device: str):
    return Voxeliser(device=device)(wp.array(points, dtype=wp.vec3, device=device), ends=(50, 150))


def student(cfg: StudentCfg, device: str) -> Student:
    torch.manual_seed(0)
    return Student(cfg, ACTIONS).to(wp.device_to_torch(device)).eval()


def count(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_paper_preset_has_the_released_sizes():
    net = Student(PAPER_NETWORK, ACTIONS)
    encoder = net.encoder
    assert count(encoder.stages[3]) == pytest.approx(7.97e6, rel=1e-3)
    assert count(encoder) - count(encoder.projector) == pytest.approx(10.70e6, rel=1e-3)
    assert count(encoder.projector) == pytest.approx(65.8e3, rel=1e-3)
    assert count(net.memory) == pytest.approx(395e3, rel=1e-3)
    assert count(net.head) == pytest.approx(65.8e3, rel=1e-3)
    assert count(net.action_layers) + count(net.merge_action) == pytest.approx(75e3, rel=1e-2)
    assert count(net.distance) == pytest.approx(33e3, rel=1e-2)
    assert count(net.mean) + count(net.log_std) == pytest.approx(6e3, rel=5e-2)
    assert count(net) == pytest.approx(11.34e6, rel=1e-3)
    norms = [module for module in net.modules() if isinstance(module, torch.nn.BatchNorm1d)]
    assert all((norm.weight == 1.0).all() for norm in norms)


def test_paper_preset_halves_the_grid_five_times(device):
    net = student(PAPER_NETWORK, device)
    seen = []
    for stage in net.encoder.stages:
        stage.register_forward_hook(lambda _, __, output: seen.append(output[1].level))
    net.encode(sites(clouds(1), device))
    assert seen == [2, 3, 4, 5]  # 32 voxels, 160 mm


def test_every_parameter_learns(device):
    net = student(SMALL, device).train()
    scene = sites(clouds(6), device)
    embedding = net.encode(scene).unflatten(0, (2, 3))
    previous = torch.randn(2, 3, ACTIONS, device=scene.device)
    output = net(embedding, previous, net.initial_hidden(3))
    (output.mean.sum() + output.log_std.sum() + output.distance.square().sum()).backward()
    dead = [name for name, p in net.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert not dead
    assert output.mean.shape == output.log_std.shape == (2, 3, ACTIONS)
    assert output.distance.shape == (2, 3, 2)


def test_batch_and_order_of_points_do_not_matter(device):
    net, points = student(SMALL, device), clouds(3)
    together = net.encode(sites(points, device))
    alone = torch.cat([net.encode(sites(points[i : i + 1], device)) for i in range(3)])
    torch.testing.assert_close(together, alone, atol=1e-5, rtol=1e-5)
    shuffled = np.random.default_rng(0).permutation(points, axis=1)
    assert torch.equal(together, net.encode(sites(shuffled, device)))


def test_with_the_papers_input_moving_a_cloud_by_whole_cells_changes_nothing(device):
    """Nothing but the grid gives a place a meaning there: only neighbours tell the goal from the scene."""
    net, points = student(SMALL, device), clouds(1)
    cell = 0.005 * 8  # two stages and one pooling: eight voxels
    moved = net.encode(sites(points + np.float32([cell, -cell, 2 * cell]), device))
    torch.testing.assert_close(net.encode(sites(points, device)), moved, atol=1e-4, rtol=1e-4)


def test_places_and_marks_are_read_where_asked_for(device):
    """The centre of each voxel in units of 10 cm, and whether goal or hand have a point in it."""
    cfg = dataclasses.replace(SMALL, encoder=EncoderCfg(channels=(4, 8), blocks=1, embedding=16))
    net, points = student(cfg, device), clouds(2)
    scene = sites(points, device)
    found = voxel_features(scene, cfg.encoder, cfg.voxel_m).cpu().numpy()
    assert found.shape == (len(scene), 6) and (found[:, 0] == PAPER.cloud.feature).all()
    coordinates = scene.coordinates.cpu().numpy()
    np.testing.assert_allclose(found[:, 1:4], (coordinates[:, 1:] + 0.5) * 0.05, atol=1e-6)
    expected = np.zeros((len(scene), 2))
    voxel = np.floor(points / np.float32(0.005)).astype(int)
    for column, part in enumerate((slice(0, 50), slice(50, 150))):
        held = {(cloud, *cell) for cloud in range(2) for cell in voxel[cloud, part].tolist()}
        expected[:, column] = [tuple(row) in held for row in coordinates.tolist()]
    np.testing.assert_array_equal(found[:, 4:], expected)
    moved = net.encode(sites(points + np.float32([0.04, -0.04, 0.08]), device))
    assert float((moved - net.encode(scene)).detach().abs().max()) > 1e-3
    unmarked = Voxeliser(device=device)(wp.array(points, dtype=wp.vec3, device=device))
    with pytest.raises(ValueError, match="marks"):
        net.encode(unmarked)


def test_proprioception_is_what_the_configuration_names(device):
    net = student(dataclasses.replace(SMALL, proprioception=("action", "position", "velocity")), device)
    frame = {name: torch.full((3, ACTIONS), value) for name, value in (("action", 1.0), ("position", 2.0))}
    frame["velocity"] = torch.full((3, ACTIONS), 15.0)
    assert net.proprioception(frame).unique(dim=1).tolist() == [[1.0, 2.0, 3.0]] * 3
    assert student(SMALL, device).proprioception(frame).tolist() == frame["action"].tolist()


def sequence(net: Student, steps: int, envs: int):
    generator = torch.Generator().manual_seed(1)
    device = net.mean.weight.device
    embedding = torch.randn(steps, envs, SMALL.encoder.embedding, generator=generator).to(device)
    return embedding, torch.randn(steps, envs, ACTIONS, generator=generator).to(device)


def test_sequence_equals_single_steps_with_the_memory_cleared_at_ends(device):
    net = student(SMALL, device)
    embedding, previous = sequence(net, 7, 3)
    done = torch.zeros(7, 3, device=embedding.device)
    done[2, 0] = done[2, 1] = done[3, 0] = done[6, 2] = 1.0
    hidden = torch.randn_like(net.initial_hidden(3))
    whole = net(embedding, previous, hidden, done)
    for t in range(7):
        step = net(embedding[t : t + 1], previous[t : t + 1], hidden)
        for one, all_steps in ((step.mean, whole.mean), (step.distance, whole.distance)):
            torch.testing.assert_close(one[0], all_steps[t], atol=1e-5, rtol=1e-5)
        hidden = step.hidden * (1.0 - done[t, :, None])
    torch.testing.assert_close(hidden, whole.hidden, atol=1e-5, rtol=1e-5)
    assert (whole.hidden[2] == 0).all()
    assert not torch.allclose(whole.mean, net(embedding, previous, net.initial_hidden(3)).mean)


def test_distance_before_the_memory_knows_this_cloud_only(device):
    net = student(SMALL, device)
    embedding, previous = sequence(net, 2, 1)
    changed = embedding.clone()
    changed[0] += 1.0
    one, other = (net(e, previous, net.initial_hidden(1)).distance[1, 0] for e in (embedding, changed))
    before, after = list(net.distance).index("before"), list(net.distance).index("after")
    assert one[before] == other[before]
    assert one[after] != other[after]


def test_standard_deviation_keeps_to_its_range(device):
    net = student(SMALL, device)
    with torch.no_grad():
        net.log_std.weight.mul_(1e4)
    embedding, previous = sequence(net, 4, 4)
    std = net(embedding, previous, net.initial_hidden(4)).log_std.exp()
    assert std.min() >= 0.02 * 0.999 and std.max() <= 1.001
    free = student(dataclasses.replace(SMALL, std_range=None), device)
    with torch.no_grad():
        free.log_std.bias.fill_(5.0)
    assert free(embedding, previous, free.initial_hidden(4)).log_std.max() > 4.0


@pytest.mark.parametrize("lower", ["everything", "encoder"])
def test_half_precision_stays_near_single(device, lower):
    """Of the products by autocast, or of the encoder's weights: what comes out is single again."""
    net = student(SMALL, device)
    scene = sites(clouds(2), device)
    previous = torch.zeros(2, ACTIONS, device=scene.device)
    with torch.inference_mode():
        single = net.act(scene, previous, net.initial_hidden(2))
        if lower == "encoder":
            net.encoder.bfloat16()
        with torch.autocast(scene.device.type, dtype=torch.bfloat16, enabled=lower == "everything"):
            half = net.act(scene, previous, net.initial_hidden(2))
    assert single.mean.shape == (2, ACTIONS) and single.hidden.shape == (2, SMALL.memory)
    assert {getattr(half, f.name).dtype for f in dataclasses.fields(half)} == {torch.float32}
    torch.testing.assert_close(half.mean, single.mean, atol=0.05, rtol=0.05)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_survive_a_dictionary(name):
    assert from_dict(StudentCfg, to_dict(PRESETS[name])) == PRESETS[name]
    Student(PRESETS[name], ACTIONS)


def test_a_network_with_what_is_gone_is_refused_and_one_without_it_is_read():
    old = to_dict(SMALL) | {"goal": "merged", "turn": {"vectors": 0, "rounds": 3}, "state": {"values": 0}}
    assert from_dict(StudentCfg, old) == SMALL
    for change in ({"goal": "separate"}, {"turn": {"vectors": 32}}, {"state": {"values": 95}}):
        with pytest.raises(ValueError, match="take the version that wrote it"):
            from_dict(StudentCfg, old | change)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"distance": ()}, "distance"),
        ({"voxel_m": 0.0}, "voxel_m"),
        ({"memory": 0}, "width"),
        ({"std_range": (1.0, 0.5)}, "std_range"),
        ({"encoder": EncoderCfg(channels=())}, "channels"),
        ({"proprioception": ("velocity",)}, "proprioception"),
    ],
)
def test_refuses_sizes_that_make_no_network(change, field):
    with pytest.raises(ValueError, match=field):
        Student(dataclasses.replace(LEAN, **change), ACTIONS)


def test_a_robot_needs_no_simulator():
    code = "import sys, vd.vision.network, vd.vision.voxels; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"newton", "mujoco", "pxr", "rsl_rl"} & set(run.stdout.split())
