"""What a report says about the recording itself."""

from dataclasses import replace

import numpy as np
import pytest

from vd.bench.hide import Hiding, simulate_hidden
from vd.gap.cautions import cautions


@pytest.fixture(scope="module")
def recording():
    (hidden,) = simulate_hidden([Hiding("servo", joints=("a", "b"))])
    return hidden.recording


def test_a_recording_as_it_should_be_has_none(recording):
    assert cautions(recording) == ()


def test_joints_that_no_motion_or_few_move_are_named(recording):
    first = replace(recording, trajectories=tuple(t for t in recording.trajectories if t.joints == ("a",)))
    (idle,) = cautions(first)
    assert "No motion moves b" in idle
    few = first.subset(range(3))
    assert any("Fewer than 4 kinds of motion move a:" in line for line in cautions(few))


def test_samples_far_apart_are_told(recording):
    slow = tuple(replace(t, time=4.0 * t.time) for t in recording.trajectories)
    (line,) = cautions(replace(recording, trajectories=slow))
    assert "40 ms apart" in line and "50 Hz" in line


def test_a_count_that_is_not_the_encoders_is_told(recording):
    count = 4.0 * recording.encoder_resolution_rad
    coarse = tuple(replace(t, position=np.round(t.position / count) * count) for t in recording.trajectories)
    lines = cautions(replace(recording, trajectories=coarse))
    assert ["steps of 6.1" in line and "1.53" in line for line in lines] == [True, True]
