"""The battery counts what it says it counts, resumes, and runs the workflow on hidden effects."""

import json

import pytest

from vd.bench.cli import GapCommand
from vd.gap.bench import battery as gap
from vd.gap.bench.score import BATTERIES, Case, figures, score, table

TRUTH = {
    "noise_floor_rad": 5e-4,
    "effects": {
        "coulomb_friction": {"joints": ["joint"], "parameters": {"tau_c_nm": {"joint": 0.1}}},
        "command_delay": {"joints": ["joint"], "parameters": {"delay_s": {"joint": 0.02}}},
    },
}


def report(*named, sets=(), verdict=None, baseline=5e-3, left=5.5e-4, **values):
    estimates = {
        "coulomb_friction": {"tau_c_nm": {"value": 0.11, "ci95": [0.09, 0.12], "unit": "N m"}},
        "command_delay": {"delay_s": {"value": 0.03, "ci95": [0.025, 0.035], "unit": "s"}},
    }
    return {
        "verdict": verdict or ("effects" if named else "ambiguous" if sets else "no_gap"),
        "effects": [
            {"name": name, "joints": ["joint"], "parameters": estimates.get(name, {})}
            for name in named
        ],
        "ambiguous": [list(group) for group in sets],
        "baseline": {"rmse_rad": baseline},
        "held_out": {"baseline_rmse_rad": 6e-3, "identified_rmse_rad": left},
        "seconds": 9.0,
        **values,
    }


def case(*effects, kind="single", model="servo", **values):
    return Case(kind, model, effects, values.pop("size", 2), values.pop("seed", 0), **values)


def value(results, what):
    (figure,) = [f for f in figures(results) if f.what == what]
    return figure


def test_the_effect_that_stands_for_another_is_right_if_the_report_says_so():
    one = case("read_delay")
    truth = {**TRUTH, "effects": {"read_delay": {"joints": ["joint"], "parameters": {}}}}
    said = score(one, report("command_delay", sets=[("command_delay", "read_delay")]), truth)
    silent = score(one, report("command_delay"), truth)
    more = score(
        one, report("command_delay", "backlash", sets=[("command_delay", "read_delay")]), truth
    )
    results = [said, silent, more]
    assert [value([r], "first name right").value for r in results] == [1.0, 0.0, 0.0]
    assert [bool(r["false"]) for r in results] == [False, True, True]


def test_an_effect_that_does_not_show_is_refused():
    with pytest.raises(ValueError, match="no payload_inertia"):
        gap.battery("servo", effects=("payload_inertia",))


def test_batteries_share_neither_seeds_nor_plants():
    hidings = {
        which: [one.hiding() for one in gap.battery("servo", effects=("backlash",), which=which)]
        for which in BATTERIES
    }
    seeds, plants = (
        [{getattr(h, name) for h in made} for made in hidings.values()]
        for name in ("seed", "physics")
    )
    assert len(set.union(*seeds)) == sum(map(len, seeds))
    assert len(set.union(*plants)) == sum(len(each.plants) for each in BATTERIES.values())
    assert case("backlash").name != case("backlash", battery="closed").name


def test_names_are_scored_against_the_truth():
    one = case("coulomb_friction")
    right = score(one, report("coulomb_friction"), TRUTH)
    wrong = score(one, report("backlash"), TRUTH)
    among = score(one, report(sets=[("dead_zone", "coulomb_friction")]), TRUTH)
    also = score(one, report("coulomb_friction", "backlash"), TRUTH)
    results = [right, wrong, among, also]
    assert value(results, "first name right").value == 0.5
    assert [r["false"] for r in results] == [[], ["backlash"], [], ["backlash"]]
    assert value(results, "held-out gap: times smaller").value == pytest.approx(6.0 / 0.55)
    assert value(results, "held-out gap: noise floors left").reached
    # A gap below three noise floors does not count.
    small = score(one, report("backlash", baseline=1e-3), TRUTH)
    assert len(value([*results, small], "first name right").values) == 4


def test_nothing_hidden_allows_no_name_but_a_changed_mass():
    quiet = score(case(kind="none", change="exact"), report(), TRUTH)
    heavy = score(case(kind="none", change="mass"), report("gravity_load"), TRUTH)
    false = score(case(kind="none", change="base"), report("gravity_load"), TRUTH)
    results = [quiet, heavy, false, false]
    assert value(results, "nothing hidden: no false name").value == 0.5


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


def test_a_failed_case_counts_against_every_goal():
    failed = [{"case": c.__dict__, "error": "boom"} for c in (
        case("backlash"), case(kind="none"), case("backlash", "dead_zone", kind="pair"),
        case("cogging", kind="outside"))]  # fmt: skip
    for figure in figures(failed):
        assert not figure.reached
    assert "| first name right | >= 0.95 | 0.000 | 1 | no |" in table(figures(failed))


def test_a_battery_goes_on_where_it_ended_and_names_what_is_hidden(tmp_path, monkeypatch, capsys):
    ran = []

    def here(work, cases, finished, **_):
        for one in cases:
            ran.append(one)
            finished(one, work(one), "")

    monkeypatch.setattr("vd.gap.bench.cases.run_tasks", here)
    effects = ("coulomb_friction", "encoder_bias")
    some = {"out": tmp_path, "model": "servo", "effects": effects, "sizes": (3,), "seeds": 1}
    monkeypatch.setattr(gap, "NOTHING_A_SEED", 1)
    GapCommand(**some, kinds=("none",)).run()
    GapCommand(**some, kinds=("single",), shard="1/2").run()
    first = "| first name right | >= 0.95 | - | 0 |"  # others are at work
    assert len(ran) == 2 and first in (tmp_path / "summary.md").read_text()
    GapCommand(**some, kinds=("single",)).run()
    results = {one.effects: json.loads((tmp_path / f"{one.name}.json").read_text()) for one in ran}
    assert len(ran) == 3 and not any(r["false"] for r in results.values())
    offset = results[("encoder_bias",)]
    assert any("encoder_bias" in names for names in (offset["found"], *offset["sets"]))
    assert results[("coulomb_friction",)]["found"] == ["coulomb_friction"]
    assert results[()]["verdict"] == "no_gap"
    assert results[("coulomb_friction",)]["shrunk"] > 5.0
    assert all(row["error"] < 0.1 for one in results.values() for row in one["parameters"]), (
        "in N m"
    )
    summary = (tmp_path / "summary.md").read_text()
    assert summary in capsys.readouterr().out
    assert first not in summary and "| first name right |" in summary
    (tmp_path / f"{ran[1].name}.json").write_text('{"case"')  # cut short
    monkeypatch.setattr(gap, "run_case", lambda one, **_: results[one.effects])
    GapCommand(**some, kinds=("single",)).run()
    assert ran[3:] == [ran[1]]
