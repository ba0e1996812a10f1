"""Imitation: losses fall, gradients go where they should, runs stop and go on as if nothing had happened."""

import math
import os
import re
import signal
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from student_dummy import TINY, DummyTeacher, make_dagger, weights

from vd.train.checkpoint import list_checkpoints
from vd.train.cli import main
from vd.train.loop import Interrupted, TrainingDivergedError
from vd.train.metrics import read_progress
from vd.train.student.losses import imitation_figures, imitation_loss, poses
from vd.train.student.rollout import taken
from vd.train.student.runner import scheduled
from vd.vision.cfg import NoiseCfg
from vd.vision.saved import load_student


def test_the_losses_fall_on_one_rollout():
    dagger = make_dagger(epochs=1, rollout_steps=4)
    rollout = dagger.collect()
    first = dagger.update([rollout])
    for _ in range(60):
        last = dagger.update([rollout])
    assert last["loss/imitation"] < first["loss/imitation"] - 1.0
    assert last["loss/distance"] < 0.3 * first["loss/distance"]


@pytest.mark.parametrize("kind", ["likelihood", "squared"])
def test_gradients_equal_those_of_an_unrolled_loop(kind):
    """The oracle encodes step by step and writes the gates of the memory out; ends of episodes clear it."""
    dagger = make_dagger(envs=3, rollout_steps=5, imitation=kind)
    rollout = dagger.collect()
    rollout.done = torch.tensor([[0, 1, 0], [0, 0, 0], [1, 1, 0], [0, 0, 0], [0, 0, 1]], dtype=torch.bool)
    rollout.hidden = torch.randn(3, TINY.memory)
    student = dagger.student.eval()  # one batch or five: the same statistics
    losses = dagger.losses(rollout)
    imitation, distance = losses["imitation"], losses["distance"]
    (imitation + 0.5 * distance).backward()
    found = {name: p.grad.clone() for name, p in student.named_parameters() if p.grad is not None}

    student.zero_grad()
    gru, hidden, total = student.memory, rollout.hidden, torch.zeros(())
    for step in range(5):
        frame = {name: value[step] for name, value in rollout.frames.items()}
        embedding = student.encode(dagger.view.sites(frame, augment=True))
        inputs = student.merge_action(torch.cat([embedding, student.action_layers(frame["action"])], dim=-1))
        gates_in = (inputs @ gru.weight_ih_l0.T + gru.bias_ih_l0).chunk(3, dim=-1)
        gates_hidden = (hidden @ gru.weight_hh_l0.T + gru.bias_hh_l0).chunk(3, dim=-1)
        reset, update = (torch.sigmoid(gates_in[i] + gates_hidden[i]) for i in range(2))
        new = torch.tanh(gates_in[2] + reset * gates_hidden[2])
        hidden = (1.0 - update) * new + update * hidden
        features = student.head(hidden)
        mean = student.mean(features)
        low, high = (math.log(bound) for bound in TINY.std_range)
        std = torch.exp(low + (high - low) * torch.sigmoid(student.log_std(features)))
        if kind == "likelihood":
            own = -torch.distributions.Normal(mean, std).log_prob(rollout.label[step]).sum(-1).mean()
        else:
            own = (mean - rollout.label[step]).square().sum(-1).mean()
        heads = [student.distance["before"](embedding), student.distance["after"](hidden)]
        errors = torch.cat(heads, dim=-1) - frame["distance"][:, None]
        total = total + (own + 0.5 * errors.square().mean()) / 5
        hidden = torch.where(rollout.done[step][:, None], 0.0, hidden)
    total.backward()
    torch.testing.assert_close(imitation + 0.5 * distance, total)
    wanted = {name: p.grad for name, p in student.named_parameters() if p.grad is not None}
    assert found.keys() == wanted.keys()
    for name, gradient in wanted.items():
        scale = float(gradient.abs().max()) + 1e-6
        assert float((found[name] - gradient).abs().max()) < 2e-4 * scale, name


def test_no_gradient_crosses_the_end_of_an_episode():
    """What a world did before its end does not move what is learned after it; in another world it does."""
    dagger = make_dagger(envs=2, rollout_steps=4, imitation="squared")
    rollout = dagger.collect()
    rollout.done = torch.zeros((4, 2), dtype=torch.bool)
    rollout.done[0, 0] = True
    action = rollout.frames["action"].clone().requires_grad_()
    rollout.frames["action"] = action
    student = dagger.student.eval()
    with torch.no_grad():
        frames = {name: value.flatten(0, 1) for name, value in rollout.frames.items()}
        embedding = student.encode(dagger.view.sites(frames, augment=True)).view(4, 2, -1)
        output = student(embedding, action, rollout.hidden, rollout.done)
        rollout.label[0] = output.mean[0]  # no error in the first step: its own loss has no gradient
    (gradient,) = torch.autograd.grad(dagger.losses(rollout)["imitation"], action)
    assert float(gradient[0, 0].abs().max()) < 1e-9 < 1e-6 < float(gradient[0, 1].abs().max())
    assert float(gradient[1, 0].abs().max()) > 1e-6


def test_what_the_environment_clips_alike_is_no_error():
    output = SimpleNamespace(mean=torch.tensor([[[1.5, -1.5]]]))
    for label, left in (([1.0, -1.0], 0.0), ([0.5, -1.0], 1.0), ([-1.0, 1.0], 12.5), ([1.0, -2.0], 0.25)):
        loss = imitation_loss(output, torch.tensor([[label]]), "squared", bounded=True)
        assert float(loss) == pytest.approx(left)
    label = torch.rand(50, 8, 3)
    figures = imitation_figures(label.mean(dim=(0, 1)).expand_as(label), label)
    assert float(figures["student/unexplained"]) == pytest.approx(1.0), "of a constant all is left"


def test_kept_rollouts_are_learned_from_too():
    dagger = make_dagger(envs=3, minibatch_envs=2, keep_rollouts=3, epochs=1)
    rollouts = [dagger.collect() for _ in range(2)]
    together = taken(rollouts, torch.tensor([4, 0, 1, 5, 2, 3]))
    parts = [dagger.student.eval() and dagger.losses(one) for one in rollouts]
    whole = dagger.losses(together)
    for name, loss in whole.items():
        torch.testing.assert_close(loss, 0.5 * (parts[0][name] + parts[1][name]))
    drawn = torch.cat([batch for _ in range(40) for batch in dagger.minibatches(2)])
    assert len(drawn) == 120 and set(drawn.tolist()) == set(range(6))
    assert [len(dagger._kept) for _ in range(4) if dagger._iterate()] == [1, 2, 3, 3]


def test_a_rollout_pairs_each_frame_with_its_label_and_end():
    dagger = make_dagger(rollout_steps=12)
    rollout = dagger.collect()
    assert torch.equal(rollout.label, rollout.frames["target"])
    assert not rollout.hidden.any() and rollout.done.any()
    ended = rollout.done[:-1]
    changed = (rollout.label[1:] != rollout.label[:-1]).any(dim=-1)
    assert torch.equal(changed, ended)  # the dummy draws a target where, and only where, something ended


def test_goals_that_the_end_of_a_rollout_cuts_off_are_counted():
    dagger = make_dagger(rollout_steps=5)
    rollout = dagger.collect()
    means = dagger._means.read()
    ended = sum(means[f"task/{how}"] for how in ("reached", "dropped", "timed_out")) * 5 * 8
    assert ended == pytest.approx(int(rollout.done.sum()) + int((~rollout.done[-1]).sum()))
    assert ended > 8


def test_the_memory_is_cleared_in_rollouts_and_kept_between_them():
    dagger = make_dagger(reset=False, rollout_steps=2)
    first = dagger.collect()
    assert not first.hidden.any()
    second = dagger.collect()
    ended = first.done[-1]
    assert second.hidden[~ended].any(dim=-1).all() and not second.hidden[ended].any()
    assert not make_dagger(rollout_steps=2).collect().hidden.any()


def test_the_teacher_acts_in_its_share_which_falls_to_none():
    dagger = make_dagger(teacher_share=1.0, teacher_share_iterations=4)
    shares = []
    for dagger.iteration in range(6):
        shares.append(dagger.teacher_share())
    assert shares == [1.0, 0.75, 0.5, 0.25, 0.0, 0.0]
    assert make_dagger(teacher_share=0.5).teacher_share() == 0.5
    dagger.iteration = 0
    rollout = dagger.collect()
    # the action before a step is the label of the step before: the teacher's own
    assert torch.equal(rollout.frames["action"][1:], rollout.label[:-1])
    dagger.iteration = 4
    assert not torch.equal(*(lambda r: (r.frames["action"][1:], r.label[:-1]))(dagger.collect()))


def test_the_learning_rate_rises_and_falls():
    rates = [scheduled(1.0, step, warmup=10, decay_after=100) for step in (1, 5, 10, 100, 400)]
    assert rates == pytest.approx([0.1, 0.5, 1.0, 1.0, 0.5])
    assert scheduled(0.3, 10**6) == 0.3
    dagger = make_dagger(learning_rate=1.0, warmup_steps=10, decay_after_steps=100)
    dagger._steps_done = 4
    dagger.update([dagger.collect()])
    assert dagger.optimizer.param_groups[0]["lr"] == pytest.approx(
        0.8
    )  # four steps of 2 environments each later


def test_poses_are_read_from_frames_and_learned(monkeypatch):
    """A head of the training alone: the student has no more weights than without."""
    bodies = torch.zeros(4, 3, 2, 7)
    bodies[..., 1, :] = torch.tensor([0.05, -0.1, 0.0, 0.0, 0.0, math.sin(0.5), math.cos(0.5)])
    goal = torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(4, 3, 4)
    found = poses({"body_q": bodies, "goal_quat": goal})
    assert found.shape == (4, 3, 9)
    np.testing.assert_allclose(
        found[0, 0],
        [1.0, -2.0, 0.0, math.cos(1.0), math.sin(1.0), 0, -math.sin(1.0), math.cos(1.0), 0],
        atol=1e-6,
    )

    def target(frames):
        return frames["target"].repeat(1, 1, 5)[..., :9]

    monkeypatch.setattr("vd.train.student.dagger.poses", target)
    dagger = make_dagger(pose_weight=1.0, epochs=1, rollout_steps=4)
    assert weights(dagger.student).size == weights(make_dagger().student).size
    rollout = dagger.collect()
    first = dagger.update([rollout])
    for _ in range(40):
        last = dagger.update([rollout])
    assert last["loss/pose"] < 0.3 * first["loss/pose"]
    again = make_dagger(pose_weight=1.0, seed=3)
    again._load_learner(dagger._learner())
    for one, two in zip(*(d.heads["pose"].parameters() for d in (again, dagger)), strict=True):
        assert torch.equal(one, two)


def test_labels_are_clipped_where_asked_for():
    class Loud(DummyTeacher):
        def act(self, observation):
            return 10.0 * observation[:, :2]

    dagger = make_dagger(clip_labels=True)
    dagger.teacher = Loud()
    assert float(dagger.collect().label.abs().max()) == 1.0


def test_a_run_that_goes_on_is_the_run_that_never_stopped(tmp_path):
    for reset in (True, False):
        options = {"noise": NoiseCfg(), "reset": reset, "keep_rollouts": 1 if reset else 2}
        options |= {"warmup_steps": 6}
        whole = make_dagger(tmp_path / f"whole{reset}", **options)
        whole.learn(4)
        make_dagger(tmp_path / f"parts{reset}", **options).learn(2)
        torch.manual_seed(99)  # whatever happened in between
        again = make_dagger(tmp_path / f"parts{reset}", **options, seed=5)
        again.load(list_checkpoints(tmp_path / f"parts{reset}")[-1])
        assert again.new_episodes == "" and again.iteration == 2
        again.learn(2)
        np.testing.assert_array_equal(weights(again.student), weights(whole.student))
        rows = [read_progress(tmp_path / f"{name}{reset}" / "progress.jsonl") for name in ("whole", "parts")]
        assert [row["iteration"] for row in rows[1]] == [1, 2, 3, 4]
        for first, second in zip(*rows, strict=True):
            assert first["loss/imitation"] == second["loss/imitation"]


def test_other_worlds_start_anew(tmp_path):
    make_dagger(tmp_path).learn(2)
    again = make_dagger(tmp_path, envs=6)
    again.load(list_checkpoints(tmp_path)[-1])
    assert "8 environments" in again.new_episodes
    again.learn(1)
    assert again.iteration == 3


def test_a_student_is_exported_from_a_checkpoint(tmp_path, capsys):
    runner = make_dagger(tmp_path)
    runner.learn(1)
    (checkpoint,), out = list_checkpoints(tmp_path), tmp_path / "out.pt"
    assert main(["export", str(checkpoint), str(out)]) == 0
    np.testing.assert_array_equal(weights(load_student(out).network), weights(runner.student))
    assert main(["export", "--resumable", str(checkpoint), str(out)]) == 1
    assert "--init" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("senses", ["action", "object"], "that is a tracking policy now. .*: vd-train tracker"),
        ("turn", {"vectors": 3}, "network.turn.vectors is 3, and this version .*; it was written by another"),
    ],
)
def test_a_student_of_an_earlier_version_is_refused_in_words(tmp_path, field, value, said, capsys):
    make_dagger(tmp_path).learn(1)
    state = torch.load(tmp_path / "student.pt", weights_only=True)
    state["spec"]["network"][field] = value
    torch.save(state, tmp_path / "old.pt")
    assert main(["export", str(tmp_path / "old.pt"), str(tmp_path / "out.pt")]) == 1
    assert re.search(rf"old\.pt.*{said}", capsys.readouterr().err)
    assert not (tmp_path / "out.pt").exists()


def test_ctrl_c_saves_within_a_rollout(tmp_path):
    dagger = make_dagger(tmp_path, rollout_steps=50, save_every=100)
    step, calls = dagger.env.step, []

    def interrupt(action):
        calls.append(1)
        if len(calls) == 60:  # in the second rollout
            os.kill(os.getpid(), signal.SIGINT)
        return step(action)

    dagger.env.step = interrupt
    with pytest.raises(Interrupted):
        dagger.learn(5)
    assert len(calls) == 60  # at once, not at the end of the rollout
    again = make_dagger(tmp_path, rollout_steps=50)
    again.load(list_checkpoints(tmp_path)[-1])
    assert again.iteration == 1


def test_values_that_are_not_finite_stop_the_run_with_a_remedy(tmp_path):
    runner = make_dagger(tmp_path)
    runner.learn(2)
    with torch.no_grad():
        runner.student.mean.weight[0, 0] = torch.nan
    before = list_checkpoints(tmp_path)
    with pytest.raises(TrainingDivergedError, match=r"iteration 3: .*--dagger\.learning-rate.*--resume"):
        runner.learn(2)
    assert list_checkpoints(tmp_path) == before


def test_half_precision_of_the_encoder_hardly_changes_the_losses():
    single, half = (make_dagger(envs=4, precision=precision) for precision in ("fp32", "bf16"))
    rollout = single.collect()
    for dagger in (single, half):
        dagger.student.eval()
    for one, two in zip(single.losses(rollout).values(), half.losses(rollout).values(), strict=True):
        assert one.dtype == two.dtype == torch.float32
        assert two.item() == pytest.approx(one.item(), rel=0.05) and two.item() != one.item()
    half.update([half.collect()])
    assert half.student.mean.weight.dtype == torch.float32
