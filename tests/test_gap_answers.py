"""What a search has found is found again after an interruption, and nothing else is."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_gap_fit import recorded

import vd.kernels.servo.actuators as servo
from vd.gap.answers import FOLDER, Answers, digest_of
from vd.gap.coordinates import Coordinate
from vd.gap.joint_fit import JointFit
from vd.gap.workflow import explain

EFFECTS = ("coulomb_friction", "backlash", "command_delay")


def fit(value: float = 1.0) -> JointFit:
    """A fit of one parameter."""
    one = np.full(3, value)
    coordinates = (Coordinate("kp", 0, True, 1.0, -3.0, 3.0),)
    return JointFit(
        (), coordinates, one[:1], np.ones((1, 4)), one, one, one, np.ones((3, 1, 1)), np.ones((3, 1))
    )


def test_equal_questions_have_one_digest_and_others_another() -> None:
    question = ("fit", {"base": np.arange(3.0), "starts": [{"kp": 1.0, "kd": 2.0}], "fit": fit()})
    same = ("fit", {"fit": fit(), "starts": [{"kd": 2.0, "kp": np.float64(1.0)}], "base": np.arange(3.0)})
    assert digest_of(question) == digest_of(same)
    assert digest_of(question) == digest_of(pickle.loads(pickle.dumps(question)))
    others = [
        ("fits", question[1]),
        ("fit", {**question[1], "base": np.arange(3.0)[::-1]}),
        ("fit", {**question[1], "base": np.arange(3)}),
        ("fit", {**question[1], "starts": [{"kp": 1.0}, {"kd": 2.0}]}),
        ("fit", {**question[1], "fit": fit(1.1)}),
        ("fit", {**question[1], "fit": replace(fit(), effects=("backlash",))}),
    ]
    assert len({digest_of(other) for other in (question, *others)}) == len(others) + 1
    with pytest.raises(TypeError, match="object"):
        digest_of(object())


def test_answers_outlive_the_run_and_are_about_one_recording(tmp_path: Path) -> None:
    first = Answers(tmp_path / "a", "one")
    assert "q" not in first
    first.add("q", [fit(), 0.5, (np.arange(3),)])
    again = Answers(tmp_path / "a", "one")
    assert "q" in again
    assert again["q"] is again["q"]
    np.testing.assert_array_equal(again["q"][0].sse, fit().sse)
    assert again["q"][0].coordinates == fit().coordinates
    assert "q" not in Answers(tmp_path / "a", "another")
    again.forget()
    assert "q" not in Answers(tmp_path / "a", "one")


def test_a_file_that_is_cut_short_or_not_an_answer_is_none(tmp_path: Path) -> None:
    Answers(tmp_path).add("q", fit())
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    for content in (whole[: len(whole) // 2], b"", pickle.dumps(print)):
        file.write_bytes(content)
        assert "q" not in Answers(tmp_path)
    file.write_bytes(whole)
    assert "q" in Answers(tmp_path)


def test_an_interrupted_search_goes_on_where_it_was(tmp_path: Path) -> None:
    recording = recorded({servo.COULOMB_TORQUE: 0.06})
    options = {"effects": EFFECTS, "workers": 1}
    whole = explain(recording, None, tmp_path / "whole", **options)

    def interrupt(line: str) -> None:
        if "+ coulomb_friction" in line:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        explain(recording, None, tmp_path / "again", progress=interrupt, **options)
    assert any((tmp_path / "again" / FOLDER).iterdir())
    resumed = explain(recording, None, tmp_path / "again", **options)
    assert resumed.rollouts < 0.8 * whole.rollouts
    assert not (tmp_path / "again" / FOLDER).exists()
    same = {"seconds": 0.0, "rollouts": 0, "rollouts_per_s": 0.0}
    assert replace(resumed, **same).to_dict() == replace(whole, **same).to_dict()
