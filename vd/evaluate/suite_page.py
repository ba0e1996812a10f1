"""The suite as one HTML page, and its table for a terminal."""

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from vd.evaluate import plots
from vd.evaluate.comparison import Row
from vd.evaluate.comparison_page import (
    aligned,
    ecdf_figure,
    labels,
    number,
    outcome_figure,
    scatter_figure,
    shown_name,
)
from vd.evaluate.statistics import Interval
from vd.evaluate.suite import CLAIMS, NO_STUDENT, OUT_OF_TIME, Claim, Condition, own_row, within
from vd.evaluate.suite_plots import distance_figure, friction_figure, object_outcomes_figure
from vd.evaluate.suite_result import SuiteResult
from vd.evaluate.trace import HOLD_S
from vd.page import write_html
from vd.paper import PAPER

NOTHING = "–"  # noqa: RUF001
LEAST_POINTS = 30
"""Episodes that did not lose their object, below which errors by distance are not drawn."""


def write_suite(result: SuiteResult, path: Path) -> None:
    """Write the page."""
    named = {condition.name: condition.title for condition in result.conditions}
    everything = result.merged(*named)
    write_html(
        path,
        "suite.html",
        lead=_lead(result),
        result=result,
        paper=PAPER,
        hold_s=f"{HOLD_S:g}",
        no_student=NO_STUDENT,
        figures=_figures(result),
        sources=[
            (claim.text, named[claim.condition], paper_text(claim), claim.source)
            for claim in CLAIMS
            if claim.paper is not None and claim.condition in named
        ],
        late=out_of_time(result) if result.late else "",
        failed=[(name, shown_name(policy), why) for (name, policy), why in result.failed.items()],
        **_errors(result),
        frictions=_frictions(result),
        **_air(result),
        **_students(result),
        conditions=[(f"{c.name}: {c.title}", c.paper, c.flags) for c in result.conditions],
        software={} if everything is None else everything.software,
    )


def _figures(result: SuiteResult) -> list[tuple[tuple[str, ...], list[tuple[str, ...]]]]:
    """A table for each condition, header and rows: those of the paper, then what is ours."""
    return [
        (
            (condition.title, "paper", *_columns(result)),
            [
                (claim.text, *_cells(result, claim, condition))
                for claim in CLAIMS
                if claim.condition == condition.name
            ],
        )
        for condition in sorted(result.conditions, key=lambda condition: bool(condition.mark))
    ]


def out_of_time(result: SuiteResult) -> str:
    """What the reduced suite had no time for."""
    return f"{len(result.late)} evaluations are {OUT_OF_TIME}."


def terminal_table(result: SuiteResult) -> str:
    """Every figure of the paper beside that of every policy, for a terminal."""
    named = {condition.name: condition for condition in result.conditions}
    table: list[tuple[str, ...]] = [("condition", "figure", "paper", *_columns(result))]
    for claim in CLAIMS:
        if claim.condition in named:
            cells = _cells(result, claim, named[claim.condition])
            # Intervals are in the files: a line has to fit.
            table.append((claim.condition, claim.text, *(cell.split(" (")[0] for cell in cells)))
    return aligned(table, words=2)


def paper_text(claim: Claim) -> str:
    """What the paper says: ``96 % (94 to 97)``, ``0.12 to 0.13``, ``below 7``, or a dash."""
    if claim.paper is None:
        return NOTHING
    value: tuple[float, ...] = getattr(PAPER.results, claim.paper)
    if claim.unit == "share":
        return _share(*value)
    if claim.unit == "rad":
        return f"{value[0]:.2f} to {value[1]:.2f}"
    return f"below {value[0]:g}"


def _columns(result: SuiteResult) -> tuple[str, ...]:
    """Headings of the policies' columns, and first one for students where there is none."""
    return (*(() if result.students else ("students",)), *labels(result.policies).values())


def _cells(result: SuiteResult, claim: Claim, condition: Condition) -> tuple[str, ...]:
    """The paper's figure and that of each column of :func:`_columns`."""
    ours = (_cell(result, claim, condition, name) for name in result.policies)
    return (paper_text(claim), *(() if result.students else (NO_STUDENT,)), *ours)


def _cell(result: SuiteResult, claim: Claim, condition: Condition, policy: str) -> str:
    if (condition.name, policy) in result.failed:
        return "failed"
    if (condition.name, policy) not in result.found:
        teacher = policy not in result.students
        if teacher and condition.goals != "mesh":
            return "needs no cloud"
        return NOTHING if teacher and not condition.sensor_errors else "not run"
    value = claim.of(result.found[condition.name, policy])
    if value is None:
        lacks = claim.stopped_by == "prediction" and policy not in result.students
        return "predicts nothing" if lacks else NOTHING
    if isinstance(value, Interval):
        share = claim.unit == "share"
        return _share(value.value, value.low, value.high) if share else number(value)
    return _share(value)


def _share(value: float, *interval: float) -> str:
    """``85 % (82 to 88)``, with a decimal where whole per cents would hide how small it is."""
    digits = 0 if interval and value >= 0.1 else 1
    texts = [f"{100.0 * part:.{digits}f}" for part in (value, *interval)]
    return f"{texts[0]} %" + (f" ({texts[1]} to {texts[2]})" if interval else "")


def _own(result: SuiteResult, condition: str, policy: str) -> Row | None:
    """The row of a policy's own rule."""
    comparison = result.found.get((condition, policy))
    return None if comparison is None else own_row(comparison)


def _errors(result: SuiteResult) -> dict[str, Any]:
    """Figures of the errors on the table."""
    table = result.merged("training", "held-out", "symmetric")
    short = labels(result.policies)
    rows = [
        (policy, condition, row)
        for condition in ("held-out", "training", "symmetric")
        for policy in result.policies
        if (row := _own(result, condition, policy)) is not None
    ]
    return {
        "table_ecdf": None if table is None else ecdf_figure(table),
        "violins": [
            (plots.violin_figure(row.result), short[policy], condition, plots.drawn_note(row.result))
            for policy, condition, row in rows
        ],
    }


def _frictions(result: SuiteResult) -> Figure | None:
    measure = within(plots.HEADLINE_TOLERANCE_RAD)
    nominal = [c for c in result.conditions if c.name == "held-out"]
    tables = [*nominal, *(c for c in result.conditions if c.table_friction is not None)]
    short, rates = labels(result.policies), {}
    for policy in result.policies:
        points = []
        for condition in tables:
            row = _own(result, condition.name, policy)
            if row is not None:
                friction = condition.table_friction
                rate = measure(result.found[condition.name, policy], row)
                assert isinstance(rate, Interval)
                points.append((PAPER.materials.table_friction if friction is None else friction, rate))
        if points:
            rates[short[policy]] = points
    return friction_figure(rates) if rates else None


def _air(result: SuiteResult) -> dict[str, Any]:
    """Figures of the outcomes in the air, and of each policy by object and by distance."""
    air = result.merged("air", "air-training")
    short = labels(result.policies)
    rows = [(policy, row) for policy in result.policies if (row := _own(result, "air", policy)) is not None]
    return {
        "air_outcomes": None if air is None else outcome_figure(air),
        "air": [
            (
                short[policy],
                object_outcomes_figure(row),
                distance_figure(row)
                if sum(not e.fell for e in row.result.episodes) >= LEAST_POINTS
                else None,
            )
            for policy, row in rows
        ],
    }


def _students(result: SuiteResult) -> dict[str, Figure | None]:
    """Figures that only students have."""
    predicted = result.merged("air", "air-training") if result.students else None
    scanned = result.merged("scanned-goals") if result.students else None
    return {
        "scatter": scatter_figure(predicted) if predicted and predicted.predictions else None,
        "scanned": None if scanned is None else ecdf_figure(scanned),
    }


def _lead(result: SuiteResult) -> str:
    short = labels(result.policies)
    kinds = {row.policy: row.kind for part in result.found.values() for row in part.rows}
    named = (
        short[name] if kinds.get(name, name) == name else f"{short[name]} ({kinds[name]})"
        for name in result.policies
    )
    return f"{', '.join(named)} beside what the paper reports{', the reduced suite' if result.quick else ''}"
