"""Runs that meet damaged files, refused settings and full disks.

Nothing is lost, and it is said.
"""

from pathlib import Path

import pytest
import torch
from full_disk import small_files
from train_dummy import make_runner, simulating_the_dummy

from vd.command.files import OutputError
from vd.policy.actor import read_state
from vd.train.checkpoint import checkpoint_path, find_checkpoint, list_checkpoints
from vd.train.metrics import read_progress


def iterations(folder: Path) -> list[int]:
    return [row["iteration"] for row in read_progress(folder / "progress.jsonl")]


DAMAGES = {
    "empty": "is damaged: it is empty",
    "cut short": "is damaged, or holds more than weights",
    "not finite": "is damaged: actor_state_dict has weights that are not finite",
}


def spoil(path: Path, how: str, network: str = "actor") -> None:
    """Damage a checkpoint."""
    if how == "not finite":
        state = read_state(path, remedy="")
        next(iter(state[f"{network}_state_dict"].values())).view(-1)[0] = float("nan")
        torch.save(state, path)
        return
    whole = path.read_bytes()
    path.write_bytes({"empty": b"", "cut short": whole[: len(whole) // 2]}[how])


@pytest.mark.parametrize(
    ("file", "how", "said"),
    [
        *((Path("checkpoints") / "best.pt", how, words) for how, words in DAMAGES.items()),
        (Path("policy.safetensors"), "empty", "is damaged"),
        (Path("policy.safetensors"), "cut short", "is damaged"),
    ],
    ids=str,
)
def test_damaged_policies_are_refused_in_words(tmp_path, file, how, said, capsys):
    from vd.evaluate.cli import main as evaluate
    from vd.play.cli import main as play
    from vd.train.cli import main as train

    make_runner(tmp_path / "run").learn(1)
    policy = tmp_path / "run" / file
    spoil(policy, how)
    new = ["--out", str(tmp_path / "new")]
    for command in (
        lambda: evaluate([str(policy), "--out", str(tmp_path / "eval")]),
        lambda: play([str(policy), "--video", str(tmp_path / "film.mp4")]),
        lambda: train(["teacher", "--init", str(policy), *new]),
        lambda: train(["teacher", "--preset", "gpu", "--init", str(policy), *new]),
        lambda: train(["student", "--teacher", str(policy), *new]),
        lambda: train(["export", str(policy), str(tmp_path / "out.safetensors")]),
    ):
        assert command() == 1
        error = capsys.readouterr().err
        assert f"{policy} {said}" in error and "Traceback" not in error
    assert train(["student", "--teacher", "dclaw4-cube", "--init", str(policy), *new]) == 1
    error = capsys.readouterr().err
    assert f"{policy}" in error and "Traceback" not in error
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def teacher(*flags: str) -> int:
    from vd.train.cli import main

    return main(["teacher", *flags])


def test_a_setting_that_is_refused_leaves_a_run_that_can_go_on(tmp_path, monkeypatch, capsys):
    simulating_the_dummy(monkeypatch)
    run = ["--out", str(tmp_path)]
    assert teacher("--smoke", *run, "--max-steps", "256") == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for how in (["--resume"], ["--resume", "auto"]):
        assert teacher(*run, *how, "--objects", "cuboid") == 1
        assert "other objects" in capsys.readouterr().err
        assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert teacher(*run, "--resume", "--max-steps", "512") == 0
    assert "after iteration 2" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("how", "resume"), zip(DAMAGES, [["--resume"], ["--resume", "auto"], ["--resume"]], strict=True)
)
def test_a_run_goes_on_from_its_newest_sound_checkpoint(tmp_path, monkeypatch, capsys, how, resume):
    simulating_the_dummy(monkeypatch)
    run = ["--out", str(tmp_path)]
    # 128 an iteration, a checkpoint each.
    assert teacher("--smoke", *run, "--max-steps", "384") == 0
    newest = checkpoint_path(tmp_path, 3)
    spoil(newest, how)
    assert teacher(*run, *resume, "--max-steps", "512") == 0
    said = capsys.readouterr()
    assert f"{newest} {DAMAGES[how]}" in said.err and "after iteration 2" in said.out
    assert iterations(tmp_path) == [1, 2, 3, 4]
    assert [path.name for path in list_checkpoints(tmp_path)][-2:] == [
        "model_0000003.pt",
        "model_0000004.pt",
    ]
    for path in (tmp_path / "checkpoints").iterdir():
        path.write_bytes(b"")
    assert teacher(*run, *resume) == 1
    error = capsys.readouterr().err
    assert "checkpoint is sound" in error and "another --out" in error


def test_checkpoints_of_a_run_that_went_on_from_an_older_one_are_kept(tmp_path, monkeypatch):
    make_runner(tmp_path, save_every=1).learn(5)
    monkeypatch.setattr("vd.train.checkpoint.KEEP_LAST", 1)
    resumed = make_runner(tmp_path, save_every=1)
    resumed.load(str(checkpoint_path(tmp_path, 3)))
    (tmp_path / "checkpoints" / "model_0000009.pt").touch()
    torn = tmp_path / "checkpoints" / ".model_0000010.x1.pt"  # of a writer that was killed
    torn.touch()
    assert find_checkpoint(tmp_path, "latest").name == "model_0000005.pt"
    resumed.learn(1)
    assert not torn.exists()
    kept = [path.name for path in list_checkpoints(tmp_path)]
    assert kept == ["model_0000004.pt", "model_0000005.pt", "model_0000009.pt"]


@pytest.mark.parametrize(
    ("limit", "logger", "named"),
    [
        (45_000, "none", r"progress\.jsonl"),
        (45_000, "tensorboard", "tensorboard"),
        (30_000, "none", r"model_0000010\.pt"),
    ],
)
def test_a_full_disk_ends_a_run_in_words_and_it_can_go_on(tmp_path, capfd, limit, logger, named):
    make_runner(tmp_path).learn(1)
    runner = make_runner(tmp_path, save_every=10, logger=logger)
    runner.load(str(find_checkpoint(tmp_path, "latest")))
    with (
        small_files(limit),
        pytest.raises(OutputError, match=rf"cannot write .*{named}: File too large"),
    ):
        runner.learn(100)
    assert "Traceback" not in capfd.readouterr().err
    assert (tmp_path / "progress.jsonl").read_text().endswith("}\n")
    assert not list((tmp_path / "checkpoints").glob(".*"))
    resumed = make_runner(tmp_path)
    resumed.load(str(find_checkpoint(tmp_path, "latest")))
    resumed.learn(1)
    assert iterations(tmp_path) == list(range(1, len(iterations(tmp_path)) + 1))
