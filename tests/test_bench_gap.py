"""The battery counts what it says it counts, resumes, and runs the workflow on hidden effects."""

import json

import numpy as np
import pytest

from vd.bench import gap
from vd.bench.cli import GapCommand
from vd.bench.gap_beside import beside
from vd.bench.gap_score import (
    KINDS,
    NEIGHBOURS,
    Case,
    by_effect,
    figures,
    markdown,
    missed_pairs,
    score,
)
from vd.bench.hidden_plant import OUTSIDE
from vd.kernels.servo.effects import EFFECTS

TRUTH = {
    "noise_floor_rad": 5e-4,
    "base": {"kp": {"joint": 2.0}},
    "effects": {
        "coulomb_friction": {"joints": ["joint"], "parameters": {"tau_c_nm": {"joint": 0.1}}},
        "command_delay": {"joints": ["joint"], "parameters": {"delay_s": {"joint": 0.02}}},
    },
}


def report(*named, sets=(), verdict=None, baseline=5e-3, left=5.5e-4, kp=2.0, **values):
    estimates = {
        "coulomb_friction": {"tau_c_nm": {"value": 0.11, "ci95": [0.09, 0.12], "unit": "N m"}},
        "command_delay": {"delay_s": {"value": 0.03, "ci95": [0.025, 0.035], "unit": "s"}},
    }
    return {
        "verdict": verdict or ("effects" if named else "ambiguous" if sets else "no_gap"),
        "effects": [
            {"name": name, "joints": ["joint"], "parameters": estimates.get(name, {})} for name in named
        ],
        "ambiguous": [list(group) for group in sets],
        "baseline": {"rmse_rad": baseline},
        "identified": {"parameters": {"joint": {"kp": kp}}},
        "held_out": {"baseline_rmse_rad": 6e-3, "identified_rmse_rad": left},
        "seconds": 9.0,
        **values,
    }


def case(*effects, kind="single", model="servo", **values):
    return Case(kind, model, effects, values.pop("size", 2), values.pop("seed", 0), **values)


def value(results, what):
    (figure,) = [f for f in figures(results) if f.what == what]
    return figure


def test_the_whole_battery_is_what_the_goals_ask_for():
    cases = gap.battery("dclaw3")
    count = {kind: sum(c.kind == kind for c in cases) for kind in KINDS}
    n = len({c.effects for c in cases if c.kind == "single"})
    assert n == len(EFFECTS)
    assert count == {"single": n * 20, "none": 200, "pair": n * (n - 1) // 2, "outside": len(OUTSIDE) * 20}
    assert len({c.name for c in cases}) == len(cases)
    assert {c.change for c in cases if c.kind == "none"} == {"exact", "base", "mass"}
    assert set(NEIGHBOURS) == set(OUTSIDE)
    shards = [cases[i::3] for i in range(3)]
    assert sorted(c.name for s in shards for c in s) == sorted(c.name for c in cases)


def test_any_first_part_of_the_battery_is_a_fair_sample():
    cases = gap.battery("dclaw3")
    part = cases[: len(cases) // 5]
    for kind in KINDS:
        share = sum(c.kind == kind for c in part) / sum(c.kind == kind for c in cases)
        assert share == pytest.approx(0.2, abs=0.02), kind
    single = [c for c in part if c.kind == "single"]
    assert {c.size for c in single} == {0, 1, 2, 3} and {c.seed for c in single} == set(range(5))
    assert cases == gap.battery("dclaw3"), "the order is always the same: a run can be resumed"
    fresh = gap.battery("servo", first_seed=500, seeds=2, nothing=3, pairs=4)
    assert min(c.seed for c in fresh) == 500
    assert sum(c.kind == "pair" for c in fresh) == 4 and sum(c.kind == "none" for c in fresh) == 3


def test_the_effect_that_stands_for_another_is_right_if_the_report_says_so():
    one = case("read_delay")
    truth = {**TRUTH, "effects": {"read_delay": {"joints": ["joint"], "parameters": {}}}}
    said = score(one, report("command_delay", sets=[("command_delay", "read_delay")]), truth)
    silent = score(one, report("command_delay"), truth)
    more = score(one, report("command_delay", "backlash", sets=[("command_delay", "read_delay")]), truth)
    results = [said, silent, more]
    assert [value([r], "first name right").value for r in results] == [1.0, 0.0, 0.0]
    assert [value([r], "single: a wrong name").value for r in results] == [0.0, 1.0, 1.0]
    assert value([said], "size of the set").value == 1.0
    assert value(results, "right, or in the named set").value == pytest.approx(2 / 3)


def test_effects_that_are_one_together_are_right_as_that_one_if_the_report_says_so():
    hidden = case("dead_zone", "encoder_bias", kind="pair")
    group = ("asymmetric_friction", "dead_zone", "encoder_bias")
    told = score(hidden, report("asymmetric_friction", sets=[group]), TRUTH)
    assert told["by_convention"] == ["dead_zone", "encoder_bias"] and not told["false"]
    assert value([told], "two hidden: both named").value == 1.0
    silent = score(hidden, report("asymmetric_friction"), TRUTH)
    assert silent["false"] == ["asymmetric_friction"] and not silent["by_convention"]
    single = score(case("dead_zone"), report("asymmetric_friction", sets=[group]), TRUTH)
    assert single["false"] == ["asymmetric_friction"], "one of them alone is something else"
    other = score(hidden, report("torque_limit", sets=[("torque_limit", *group[1:])]), TRUTH)
    assert other["false"] == ["torque_limit"]
    # Coulomb friction beside Stribeck friction is Stribeck friction with other numbers.
    sums = score(
        case("coulomb_friction", "stribeck_friction", kind="pair"), report("stribeck_friction"), TRUTH
    )
    assert (
        sums["by_convention"] == ["coulomb_friction"] and value([sums], "two hidden: both named").value == 1.0
    )


def test_bad_requests_are_refused():
    for options, words in (
        ({"kinds": ("triple",)}, "triple"),
        ({"effects": ("gremlins",)}, "gremlins"),
        ({"sizes": (7,)}, "size 7"),
    ):
        with pytest.raises(ValueError, match=words):
            gap.battery("servo", **options)
    with pytest.raises(ValueError, match="--model is motor"):
        gap.battery("motor")
    assert gap.parse_shard("2/3") == (1, 3)
    for text in ("0/3", "4/3", "1", "a/b"):
        with pytest.raises(ValueError, match="shard"):
            gap.parse_shard(text)


def test_names_are_scored_against_the_truth():
    one = case("coulomb_friction")
    right = score(one, report("coulomb_friction"), TRUTH)
    wrong = score(one, report("backlash"), TRUTH)
    among = score(one, report(sets=[("dead_zone", "coulomb_friction")]), TRUTH)
    also = score(one, report("coulomb_friction", "backlash"), TRUTH)
    results = [right, wrong, among, also]
    assert value(results, "first name right").value == 0.5
    assert value(results, "right, or in the named set").value == 0.75
    assert value(results, "single: a wrong name").value == 0.5
    assert value(results, "size of the set").value == 1.5
    assert value(results, "held-out gap: times smaller").value == pytest.approx(6.0 / 0.55)
    assert value(results, "held-out gap: noise floors left").reached
    # A gap below three noise floors does not count.
    small = score(one, report("backlash", baseline=1e-3), TRUTH)
    assert value([*results, small], "first name right").cases == 4


def test_parameters_are_scored_in_the_unit_of_torque_of_the_report():
    rows = score(case("coulomb_friction"), report("coulomb_friction", "command_delay"), TRUTH)["parameters"]
    errors = {row["parameter"]: (row["error"], row["covered"]) for row in rows}
    assert errors["coulomb_friction.tau_c_nm"] == (pytest.approx(0.1), True)
    assert errors["command_delay.delay_s"] == (pytest.approx(0.5), False)
    # A bare servo's torques are known up to a factor: half the stiffness, half the friction.
    (row,) = score(case("coulomb_friction"), report("coulomb_friction", kp=1.0), TRUTH)["parameters"]
    assert row["error"] == pytest.approx(0.11 / 0.05 - 1.0)
    (row,) = score(case("coulomb_friction", model="dclaw3"), report("coulomb_friction", kp=1.0), TRUTH)[
        "parameters"
    ]
    assert row["error"] == pytest.approx(0.1)


def test_nothing_hidden_allows_no_name_but_a_changed_mass():
    quiet = score(case(kind="none", change="exact"), report(), TRUTH)
    heavy = score(case(kind="none", change="mass"), report("gravity_load"), TRUTH)
    false = score(case(kind="none", change="base"), report("gravity_load"), TRUTH)
    results = [quiet, heavy, false, false]
    assert value(results, "nothing hidden: a false name").value == 0.5
    assert value(results, "nothing hidden: any name at all (mass included)").value == 0.75


def test_pairs_and_outsiders_are_scored():
    two = case("coulomb_friction", "command_delay", kind="pair")
    pair = [
        score(two, report(*named), TRUTH)
        for named in (
            ("command_delay", "coulomb_friction"),
            ("command_delay",),
            ("command_delay", "backlash"),
        )
    ]
    assert value(pair, "two hidden: both named").value == pytest.approx(1 / 3)
    assert value(pair, "two hidden: one or both, none wrong").value == pytest.approx(2 / 3)
    strange = [
        score(case(name, kind="outside"), answer, TRUTH)
        for name, answer in (
            ("cogging", report(verdict="unknown")),
            ("cogging", report("backlash")),
            ("temperature_friction", report("coulomb_friction")),
            ("cable_spring", report(sets=[("gravity_load", "backlash")])),
            ("cable_spring", report(sets=[("dead_zone", "backlash")])),
        )
    ]
    assert value(strange, "outside: unknown or neighbours").value == pytest.approx(3 / 5)
    assert value(strange, "outside: a confident wrong name").value == pytest.approx(1 / 5)


def test_pairs_count_apart_in_which_each_effect_shows_beside_the_other():
    two = case("acceleration_limit", "torque_limit", kind="pair")
    hidden, found = (
        {**score(two, report(*named), TRUTH), "beside": {"acceleration_limit": 260.0, "torque_limit": gap}}
        for named, gap in ((("acceleration_limit",), 1.0), (two.effects, 3.5))
    )
    assert value([hidden, found], "two hidden: both named").value == 0.5
    assert value([hidden, found], "both show: both named").value == 1.0
    (row,) = missed_pairs([hidden, found])
    assert row["effects"][1] == ("torque_limit", 1.0) and row["answer"] == "acceleration_limit"
    assert "`torque_limit` (1.0)" in markdown([hidden, found])


def test_what_shows_beside_another_effect():
    """A limit that a slow profile never asks for shows nothing; dry friction shows as much as alone."""

    def gaps(*effects):
        return beside(case(*effects, kind="pair").hiding())

    slow = gaps("acceleration_limit", "torque_limit")
    assert slow["torque_limit"] < 1.1 and slow["acceleration_limit"] > 100.0
    alone = gaps("acceleration_limit", "coulomb_friction")["coulomb_friction"]
    assert alone == pytest.approx(6.0, rel=0.25)


def test_a_failed_case_counts_against_every_goal():
    failed = [{"case": c.__dict__, "error": "boom"} for c in (
        case("backlash"), case(kind="none"), case("backlash", "dead_zone", kind="pair"),
        case("cogging", kind="outside"))]  # fmt: skip
    for figure in figures(failed):
        assert figure.reached is not True
    assert by_effect(failed)[0]["failed"] == 1
    assert markdown(failed).count("\n") > 15


def test_a_battery_resumes_and_shards(tmp_path, monkeypatch):
    cases = gap.battery("servo", kinds=("single",), sizes=(3,), seeds=1)[:3]
    ran = []

    def run(case, folder, device, keep):
        ran.append(case.name)
        result = score(case, report("coulomb_friction"), TRUTH)
        (folder / f"{case.name}.json").write_text(json.dumps(result))
        return result

    monkeypatch.setattr(gap, "run_case", run)
    with pytest.raises(ValueError, match="holds no results"):
        GapCommand(out=tmp_path, model="servo", collect=True).run()
    gap.run_battery(cases, tmp_path, shard=(0, 2), report=lambda line: None)
    assert len(ran) == 2
    (tmp_path / f"{cases[0].name}.json").write_text('{"case"')  # cut short
    assert len(gap.run_battery(cases, tmp_path, report=lambda line: None)) == 3
    assert sorted(ran) == sorted([*(c.name for c in cases), cases[0].name])
    assert len(gap.collect(tmp_path)) == 3


def test_a_reduced_battery_names_what_is_hidden(tmp_path, capsys):
    out = tmp_path / "battery"
    effects = ("coulomb_friction", "encoder_bias")
    GapCommand(
        out=out, model="servo", kinds=("single", "none"), effects=effects, sizes=(3,), seeds=1, nothing=1
    ).run()
    results = {tuple(r["case"]["effects"]): r for r in gap.collect(out)}
    assert len(results) == 3 and not any("error" in r for r in results.values())
    assert not any(r["false"] for r in results.values())
    assert not results[("coulomb_friction",)]["missed"] and not results[("encoder_bias",)]["missed"]
    assert results[()]["verdict"] == "no_gap"
    assert results[("coulomb_friction",)]["shrunk"] > 5.0
    assert not (out / "work" / results[()]["case"]["model"]).exists()
    figures_of = json.loads((out / "summary.json").read_text())["figures"]
    assert np.isfinite([f["value"] for f in figures_of if f["value"] is not None]).all()
    assert "coulomb_friction" in (out / "summary.md").read_text() and "| figure |" in capsys.readouterr().out
