"""The suite as one HTML page, and its table for a terminal."""

from pathlib import Path
from typing import TYPE_CHECKING

from vd.evaluate import plots
from vd.evaluate.comparison import Row
from vd.evaluate.comparison_page import aligned, ecdf_figure, labels, outcome_figure, scatter_figure
from vd.evaluate.report import number, shown_name
from vd.evaluate.statistics import Interval
from vd.evaluate.suite import CLAIMS, NO_STUDENT, OUT_OF_TIME, Claim, Condition, own_row, within
from vd.evaluate.suite_plots import distance_figure, friction_figure, object_outcomes_figure
from vd.evaluate.trace import HOLD_S
from vd.page import Page
from vd.paper import PAPER

if TYPE_CHECKING:
    from vd.evaluate.suite_run import SuiteResult

NOTHING = "–"  # noqa: RUF001
LEAST_POINTS = 30
"""Episodes that did not lose their object, below which errors by distance are not drawn."""


def write_suite(result: "SuiteResult", path: Path) -> None:
    """Write the page."""
    page = Page("The paper's evaluations", _lead(result))
    for group, objects in result.objects.items():
        note = " No others were given: our own objects stand for the paper's meshes." if objects.own else ""
        page.text(f"Objects, {group}: {objects.text}.{note if group != 'symmetric' else ''}", small=True)
    page.text(WHO_JUDGES, small=True)
    if not result.found:
        page.text("Nothing has been measured yet; the same command goes on from here.")
    page.section("The paper's figures beside ours")
    _add_figures(page, result)
    page.text(_HOW_TO_READ, small=True)
    named = {condition.name: condition.title for condition in result.conditions}
    page.table(
        ("figure", "condition", "paper", "source"),
        [
            (claim.text, named[claim.condition], paper_text(claim), claim.source)
            for claim in CLAIMS
            if claim.paper is not None and claim.condition in named
        ],
        words=(1, 3),
        folded="Where the paper's figures come from (P: the paper)",
    )
    if result.late:
        page.text(out_of_time(result))
    for (condition, policy), why in result.failed.items():
        page.text(f"Not measured: {condition} of {shown_name(policy)}. {why}")
    if result.found:
        page.section("Objects")
        for group, image in result.pictures.items():
            page.figure(image, f"Objects, {group}, each at its own scale.")
    _errors(page, result)
    _materials(page, result)
    _air(page, result)
    _students(page, result)
    page.section("Conditions")
    page.table(
        ("condition", "the paper's", "vd-eval POLICY --objects ..."),
        [(f"{c.name}: {c.title}", c.paper, c.flags) for c in result.conditions],
        words=(1, 2),
    )
    if result.quick:
        page.text(
            "This is the reduced suite: few objects of each set and few episodes of each object, whatever "
            "the flags above say. Its intervals are wide.",
            small=True,
        )
    everything = result.merged(*(condition.name for condition in result.conditions))
    if everything is not None:
        page.table(("software", "version"), list(everything.software.items()), words=(1,))
    page.write(path)


def _add_figures(page: Page, result: "SuiteResult") -> None:
    """A table for each condition: those of the paper, then what is ours."""
    names = _columns(result)
    for condition in sorted(result.conditions, key=lambda condition: bool(condition.mark)):
        claims = [claim for claim in CLAIMS if claim.condition == condition.name]
        rows = [(claim.text, *_cells(result, claim, condition)) for claim in claims]
        page.table((condition.title, "paper", *names), rows)


def out_of_time(result: "SuiteResult") -> str:
    """What the reduced suite had no time for."""
    return f"{len(result.late)} evaluations are {OUT_OF_TIME}."


def terminal_table(result: "SuiteResult") -> str:
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


def _columns(result: "SuiteResult") -> tuple[str, ...]:
    """Headings of the policies' columns, and first one for students where there is none."""
    return (*(() if result.students else ("students",)), *labels(result.policies).values())


def _cells(result: "SuiteResult", claim: Claim, condition: Condition) -> tuple[str, ...]:
    """The paper's figure and that of each column of :func:`_columns`."""
    ours = (_cell(result, claim, condition, name) for name in result.policies)
    return (paper_text(claim), *(() if result.students else (NO_STUDENT,)), *ours)


def _cell(result: "SuiteResult", claim: Claim, condition: Condition, policy: str) -> str:
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


def _own(result: "SuiteResult", condition: str, policy: str) -> Row | None:
    """The row of a policy's own rule."""
    comparison = result.found.get((condition, policy))
    return None if comparison is None else own_row(comparison)


def _errors(page: Page, result: "SuiteResult") -> None:
    table = result.merged("training", "held-out", "symmetric")
    if table is None:
        return
    page.section("Errors on the table")
    page.figure(
        ecdf_figure(table),
        "Share of episodes that ended within each error (the paper's Figures 7D to 7G, 4F). Solid: stopped "
        "by its own rule. Dashed: a student stopped by the true distance. A lost object never counts.",
    )
    short = labels(result.policies)
    for condition in ("held-out", "training", "symmetric"):
        for policy in result.policies:
            if (row := _own(result, condition, policy)) is not None:
                note = plots.drawn_note(row.result)
                page.figure(
                    plots.violin_figure(row.result),
                    f"{short[policy]}, {condition} objects: errors by object (Figure 2D).{note}",
                )


def _materials(page: Page, result: "SuiteResult") -> None:
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
    if not rates:
        return
    page.section("Materials of the table")
    page.figure(
        friction_figure(rates),
        "Success with 95 % intervals on held-out objects. Contacts of table and object get the mean of the "
        f"table's friction and the object's {PAPER.materials.friction:g}. The paper's Figures 2F and 2G show "
        "the same for five real materials, whose friction it does not give, and one object each.",
    )


def _air(page: Page, result: "SuiteResult") -> None:
    air = result.merged("air", "air-training")
    if air is None:
        return
    page.section("In the air")
    page.figure(
        outcome_figure(air),
        f"How episodes end when the table goes after {PAPER.scene.air_table_s:g} s.",
    )
    short = labels(result.policies)
    for policy in result.policies:
        if (row := _own(result, "air", policy)) is not None:
            page.figure(
                object_outcomes_figure(row),
                f"{short[policy]}, held-out objects: how episodes of each object end (Figure S12c).",
            )
            if sum(not e.fell for e in row.result.episodes) >= LEAST_POINTS:
                page.figure(
                    distance_figure(row),
                    f"{short[policy]}: error beside the distance that was to go, lost objects left out "
                    "(Figure S12b).",
                )


def _students(page: Page, result: "SuiteResult") -> None:
    page.section("Predicted distance, and goals from scans")
    if not result.students:
        page.text(
            "Both are of students, which see point clouds and predict the distance to the goal: "
            f"{NO_STUDENT}. The paper's figures of students stand in the table without ours."
        )
        return
    predicted = result.merged("air", "air-training")
    if predicted is not None and predicted.predictions:
        page.figure(
            scatter_figure(predicted),
            "Predicted beside true distance in the air, in a sample of all states of all episodes; right, "
            "near ones (Figure S14). Lines are 0.1 rad apart from equal.",
        )
    scanned = result.merged("scanned-goals")
    if scanned is not None:
        page.figure(
            ecdf_figure(scanned),
            "Errors with goals that have the errors of a scan: 4 mm of noise, and a fifth of the points "
            "missing on one side, the same in every step (Figure 5).",
        )


def _lead(result: "SuiteResult") -> str:
    short = labels(result.policies)
    kinds = {row.policy: row.kind for part in result.found.values() for row in part.rows}
    named = (
        short[name] if kinds.get(name, name) == name else f"{short[name]} ({kinds[name]})"
        for name in result.policies
    )
    return f"{', '.join(named)} beside what the paper reports{', the reduced suite' if result.quick else ''}"


WHO_JUDGES = (
    "Held-out objects judge, and nothing is chosen on them. What is chosen (which checkpoint, rules of "
    "stopping, settings of the registration) is chosen on training objects and on those of validation."
)
_HOW_TO_READ = (
    "Intervals are 95 %. The paper's figures are of students, which see point clouds, with three fingers on "
    "the table and four in the air, on seven training and five test objects; ours are of the policies and "
    "objects named here. Its own rule: a student stops when the distance that it predicts is below its "
    "bound, others when the true distance is below 0.4 rad, both with a bound of 1 on the norm of the "
    "action, as in the released code; stillness is not asked for. Error at most: to the very goal, at the "
    "stop, or at the end of an episode without one; up to symmetry: to what looks like it. Stopped within: "
    f"the bound stands in place of the rule's. Held: and still there {HOLD_S:g} s later, the hand keeping "
    "its last targets. "
    "Cameras have the errors of a D415. A lost object's error counts as pi. Conditions marked ours have what "
    "the paper's have not."
)
