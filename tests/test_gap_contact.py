"""Contact from an object's recorded motions: named or not, written, read by the task.

Bad input refused.
"""

import contextlib
import csv
import json
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vd.assets_usd.objects.model import ObjectError, read_object, write_object
from vd.assets_usd.objects.sets import load_set, set_files
from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.gap.cli import main
from vd.sim.scene import SHAPE_TABLE

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "contact.py"


@pytest.fixture(scope="module")
def analysis(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder: the example's slippery, heavy cube whose centre is off, and its analysis ``out``."""
    folder = tmp_path_factory.mktemp("contact")
    with contextlib.chdir(folder):
        runpy.run_path(str(EXAMPLE))
        file = str(set_files(["cube"])[0])
        assert main(["contact", "rec-cube", "--object", file, "--out", "out"]) == 0
    return folder


def test_what_is_hidden_is_named_and_what_was_not_recorded_is_unknown(analysis: Path):
    report = json.loads((analysis / "out" / "report.json").read_text())
    assert report["verdict"] == "effects"
    assert {effect["name"] for effect in report["effects"]} == {
        "table_friction",
        "restitution",
        "mass",
        "centre_of_mass",
    }
    found = report["parameters"]
    assert found["table_friction"]["value"][0] == pytest.approx(0.4, abs=0.03)
    assert found["restitution"]["value"][0] == pytest.approx(0.5, rel=0.1)
    assert found["mass"]["value"][0] == pytest.approx(0.2, rel=0.05)
    np.testing.assert_allclose(found["centre_of_mass"]["value"], [0.01, 0.0, 0.0], atol=2e-3)
    assert found["tip_compliance"]["verdict"] == "unknown"
    assert found["tip_compliance"]["value"] == [None]


def test_commands_for_joints_send_a_recording_of_an_object_to_its_own(analysis: Path, capsys):
    for command in ("run", "plan"):
        assert main([command, str(analysis / "rec-cube"), "--out", str(analysis / "joints")]) == 2
        assert "vd-gap contact" in capsys.readouterr().err


def test_the_layer_is_the_object_with_what_was_identified(analysis: Path):
    path = analysis / "out" / "identified.usda"
    item, plain = read_object(path), load_set("cube")[0]
    assert item.mass_kg == pytest.approx(item.contact["mass"][0][0])
    np.testing.assert_allclose(
        item.inertia / item.mass_kg, plain.inertia / plain.mass_kg, rtol=1e-5
    )
    assert set(item.contact) == {"table_friction", "restitution", "mass", "centre_of_mass"}
    again = read_object(write_object(analysis / "again.usd", item))
    assert again.contact == item.contact
    torn = path.with_name("torn.usda")
    torn.write_text(path.read_text().replace("cube.usd@", "gone.usd@"))
    with pytest.raises(ObjectError, match=r"gone.usd is missing"):
        read_object(torn)
    torn.write_text(path.read_text().replace("vd:contact:mass", "vd:contact:weight"))
    with pytest.raises(ObjectError, match=r"'vd:contact:weight"):
        read_object(torn)


@pytest.mark.parametrize("randomised", [False, True])
def test_the_task_has_the_identified_contact_and_varies_it_within_its_interval(
    analysis: Path, randomised: bool
):
    path = analysis / "out" / "identified.usda"
    found = replace(RandomisationCfg(), enabled=randomised)
    env = ReorientEnv(
        ReorientCfg(objects=(str(path), "cuboid"), num_envs=8, randomisation=found), "cpu"
    )
    env.randomiser.write_model()
    model, scene = env.sim.model, env.scene
    contact = read_object(path).contact
    tables = model.shape_material_mu.numpy()[scene.shape_kind == SHAPE_TABLE]
    masses = model.body_mass.numpy().reshape(8, -1)[:, scene.object_body]
    for name, values in (("table_friction", tables), ("mass", masses)):
        (value,), (low,), (high,) = contact[name]
        assert np.all((values[:4] >= low - 1e-6) & (values[:4] <= high + 1e-6))
        assert (np.ptp(values[:4]) > 0.0) == randomised
        assert randomised or values[0] == pytest.approx(value)
    centre = model.body_com.numpy().reshape(8, -1, 3)[:, scene.object_body]
    assert centre[0, 0] == pytest.approx(0.01, rel=0.3)
    assert not centre[4:].any()


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        (
            "drop_0.csv",
            lambda rows: [[*r[:3], str(1000 * float(r[3])), *r[4:]] for r in rows],
            "in metres",
        ),
        (
            "drop_0.csv",
            lambda rows: [[*r[:7], "3"] for r in rows],
            "column 'qx': quaternions have length 1",
        ),
        (
            "push_0.csv",
            lambda rows: [r[:8] for r in rows],
            "no one column 'force_x', which a push needs",
        ),
        (
            "slide_0.csv",
            lambda rows: [*rows[:9], [*rows[9][:4], "", *rows[9][5:]], *rows[10:]],
            "row 11",
        ),
    ],
)
def test_a_recording_that_cannot_be_used_is_refused(
    analysis: Path, tmp_path: Path, capsys, file, change, message
):
    for path in (analysis / "rec-cube").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    header, *rows = csv.reader((tmp_path / file).open())
    changed = change(rows)
    text = "\n".join(",".join(row) for row in [header[: len(changed[0])], *changed])
    (tmp_path / file).write_text(text)
    assert main(["contact", str(tmp_path), "--object", "cube.usd"]) == 2
    assert message in capsys.readouterr().err
