"""The page of the demo: what was trained, what came out, what each number means, and what to do next."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vd.config import to_dict
from vd.envs.cfg import ReorientCfg
from vd.evaluate.agents import open_teacher, trained_task
from vd.evaluate.plots import ecdf_figure
from vd.evaluate.report import number, percent
from vd.evaluate.result import EvalResult
from vd.page import Page
from vd.paper import PAPER
from vd.train.demo_deploy import add_deploy
from vd.train.demo_gap import add_gap
from vd.train.demo_student import add_student
from vd.train.metrics import PROGRESS_FILE, read_progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vd.train.demo_agents import GoalCount
    from vd.train.demo_config import DemoCfg

COLORS = {"trained": "#0072B2", "random": "#D55E00", "zero": "#8a8f98"}
"""Of Okabe and Ito, which colour-blind readers can tell apart."""

NAMES = {"trained": "trained policy", "random": "random actions", "zero": "no action"}

# Settings that say how much is simulated or shown, not what the task is.
NOT_THE_TASK = ("num_worlds", "seed", "objects", "hand", "visuals", "success_ends_episode")

STAGE_NAMES = {
    "assets": "author hand and objects",
    "import": "import meshes",
    "sheet": "draw the objects",
    "gap": "find a hidden gap",
    "train": "train",
    "compare": "compare with random and no actions",
    "video": "record",
    "imported": "compare on imported meshes",
    "imported-video": "record with imported meshes",
    "student": "let a student imitate",
    "deploy": "fly simulated hands",
    "paper": "evaluate by the paper's criteria",
}


@dataclass
class DemoResults:
    """What the page shows.

    Attributes:
        cfg: Settings of the demo.
        preset: Preset that was trained.
        machine: What it ran on.
        hand: Name of the hand.
        run_dir: Folder of the training.
        sheet: Contact sheet of the objects.
        agents: Result of each agent in the task of the training: first goals, and all goals of an episode.
        imported: The same on the imported meshes; empty if there are none or there was no time.
        gap: Whether a hidden gap was looked for; its report is in ``folder``.
        student: Whether students were trained; their runs are in ``folder``.
        deployed: Whether twins of the hands were flown; their logs are in ``folder``.
        folder: Files of this demo.
        paper: Result of an installed policy under the paper's criteria and goals.
        video: Recording of the trained policy.
        imported_video: The same with imported meshes.
        seconds: Duration of each stage.
        left_out: What there was no time for, and the command that does it by hand.
        commands: The whole demo by hand, in order.
    """

    cfg: "DemoCfg"
    preset: str
    machine: str
    hand: str
    run_dir: Path
    sheet: Path | None
    agents: "dict[str, tuple[EvalResult, GoalCount]]"
    imported: "dict[str, tuple[EvalResult, GoalCount]]"
    gap: bool
    student: bool
    deployed: bool
    folder: Path
    paper: "EvalResult | None"
    video: Path | None
    imported_video: Path | None
    seconds: dict[str, float]
    left_out: list[tuple[str, str]]
    commands: list[str]


def write_page(results: DemoResults, path: Path) -> None:
    """Write the demo's page."""
    task = trained_task(open_teacher(str(results.run_dir), "cpu"))
    rows = read_progress(results.run_dir / PROGRESS_FILE)
    page = Page(
        "Visual Dexterity: the demo",
        f"A teacher for the hand {results.hand}, trained with the preset {results.preset} on "
        f"{results.machine} for {rows[-1]['env_steps']:,} control steps, "
        f"{rows[-1]['elapsed_s'] / 60.0:.0f} min.",
    )
    _outcome(page, results, task)
    page.section("What was asked")
    for sentence in task_sentences(task):
        page.text(sentence)
    page.table(["setting", "paper (default)", "this demo"], list(differences(task)))
    page.text("Settings that are not in the table are the paper's, as in vd/paper.py.", small=True)
    _learning(page, results, task, rows)
    if results.imported:
        _imported(page, results)
    if results.sheet is not None:
        page.section("The objects")
        page.figure(
            results.sheet,
            f"The objects of this demo; it was trained on {_trained_on(results)} only. Left of each pair "
            "the mesh, right the convex parts that collide, with the relative error of their volume.",
        )
    if results.paper is not None:
        _paper_criteria(page, results.paper)
    if results.student:
        add_student(page, results.folder)
    if results.deployed:
        add_deploy(page, results.folder)
    if results.gap:
        add_gap(page, results.folder, path.parent)
    if results.left_out:
        page.section("Left out")
        page.text("There was no time for these; the commands do them by hand:")
        for what, command in results.left_out:
            page.text(f"{what[0].upper()}{what[1:]}.")
            page.code(command)
    page.section("What the numbers mean")
    for text in _MEANINGS:
        page.text(text)
    page.section("Next")
    page.text("The same by hand, stage by stage:")
    for command in results.commands:
        page.code(command)
    page.text("A policy that was trained on a GPU and comes with the package, in the browser:")
    page.code("vd-play dclaw4-cube")
    page.text("The paper's task on a GPU, with our 150 procedural objects:")
    page.code("vd-assets objects --procedural 150 --seed 0")
    page.code("vd-train teacher --preset gpu --objects procedural-150-seed0 --run-dir runs/first")
    page.text("README.md lists all commands, and every command explains itself with --help.")
    page.section("Time")
    durations = [
        (STAGE_NAMES[key], f"{results.seconds[key]:.0f}") for key in STAGE_NAMES if key in results.seconds
    ]
    page.table(["stage", "seconds"], durations)
    page.write(path)


def task_sentences(task: ReorientCfg) -> list[str]:
    """The task in words, with what makes it easier than the paper's said plainly."""
    paper = ReorientCfg()
    wanted = (
        "An object lies or falls between the fingers, and a policy that sees the simulator's state has to "
        f"turn it to goal orientations, one after the other, for {task.episode_s:g} s."
    )
    easier = []
    if task.start.at_rest:
        easier.append("the object starts at rest on the table instead of falling")
    if task.goal.about_vertical:
        easier.append(
            f"goals turn the object about the vertical only, by up to {task.goal.max_angle_rad:.2g} rad"
        )
    elif task.goal.max_angle_rad < paper.goal.max_angle_rad:
        easier.append(
            f"goals lie within {task.goal.max_angle_rad:.2g} rad of the object's orientation, not in all "
            "of SO(3)"
        )
    if task.success.joint_speed_rad_s == 0.0 and task.success.object_spin_rad_s == 0.0:
        easier.append("a goal counts when the orientation is reached, fingers and object need not be still")
    if task.success.rotation_rad > paper.success.rotation_rad:
        easier.append(f"within {task.success.rotation_rad:g} rad, not {paper.success.rotation_rad:g}")
    if task.reward.table_contact == 0.0:
        easier.append("the object may rest on the table at no cost")
    if not task.randomisation.enabled:
        easier.append("dynamics, observations and actions are not randomised, and nothing pushes the object")
    if not easier:
        return [wanted, "This is the paper's task, trained for a fraction of the paper's time."]
    return [
        wanted,
        "This is easier than the paper's task on purpose, so that learning shows within minutes: "
        f"{'; '.join(easier)}. Its rates must not be compared with the paper's.",
    ]


def differences(task: ReorientCfg) -> Iterator[tuple[str, str, str]]:
    """Settings of ``task`` that are not the paper's: name, paper's value, value here."""
    paper, here = _leaves(to_dict(ReorientCfg())), _leaves(to_dict(task))
    for name, value in here.items():
        if value != paper[name] and name not in NOT_THE_TASK:
            yield name, _text(paper[name]), _text(value)


def _leaves(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted name."""
    leaves: dict[str, Any] = {}
    for name, value in values.items():
        leaves |= _leaves(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {prefix + name: value}
    return leaves


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _outcome(page: Page, results: DemoResults, task: ReorientCfg) -> None:
    agents = {name: result for name, (result, _) in results.agents.items()}
    tiles = []
    for name, result in agents.items():
        rate = result.overall.stop_rate
        tiles.append(
            (
                f"{results.agents[name][1].per_episode:.1f}",
                f"goals an episode, {NAMES[name]}",
                f"first goal: {100 * rate.value:.0f} % ({100 * rate.low:.0f} to {100 * rate.high:.0f})",
            )
        )
    page.tiles(tiles)
    page.text(verdict(agents))
    if results.video is not None:
        page.video(
            results.video,
            "The trained policy at control rate. Beside each scene stands the goal; below it the error over "
            "time with the tolerance, and the terms of the reward.",
        )
    page.section("Trained, random, none")
    page.figure(
        comparison_figure(agents),
        "Left: share of episodes whose first goal was reached, with 95 % intervals. Right: error when the "
        f"episode ended (at the goal, at a drop, or after {task.episode_s:g} s); a drop counts as pi. All "
        f"three had the same starts and first goals, {agents['trained'].overall.episodes} episodes each.",
    )
    _agents_table(page, results.agents)


def _agents_table(page: Page, agents: "Mapping[str, tuple[EvalResult, GoalCount]]") -> None:
    rows = [
        (
            NAMES[name],
            percent(result.overall.stop_rate),
            f"{count.per_episode:.2f}",
            number(result.overall.time_to_success_s),
            number(result.overall.median_error_rad),
            percent(result.overall.drop_rate),
        )
        for name, (result, count) in agents.items()
    ]
    header = ["agent", "first goal", "goals an episode", "time [s]", "error [rad]", "dropped"]
    page.table(header, rows)
    page.text(
        "Time to the first goal and error at its end are medians; brackets are 95 % intervals.", small=True
    )


def _imported(page: Page, results: DemoResults) -> None:
    """What the policy does with meshes that it has never seen."""
    trained = results.imported["trained"][0]
    page.section("Imported meshes, on which it was not trained")
    page.text(
        f"The same task with imported meshes ({len(trained.object_names)}) in place of what it trained on "
        f"({_trained_on(results)}): {trained.overall.episodes} episodes, the same for each agent. The "
        "policy has never seen these shapes, and gets no description of a shape; the table says how much of "
        "what it learned carries over."
    )
    _agents_table(page, results.imported)
    if results.imported_video is not None:
        page.video(results.imported_video, "The trained policy with some of the imported meshes.")


def _trained_on(results: DemoResults) -> str:
    return results.agents["trained"][0].protocol.objects


def verdict(agents: "Mapping[str, EvalResult]") -> str:
    """Whether the trained policy is better than the random agent, as far as these episodes tell."""
    trained, random = (agents[name].overall.stop_rate for name in ("trained", "random"))
    numbers = f"{100 * trained.value:.0f} % against {100 * random.value:.0f} % of first goals"
    if trained.low > random.high:
        return (
            f"The trained policy is better than random actions: {numbers}, and the intervals do not overlap."
        )
    if trained.value > random.value:
        return (
            f"The trained policy reached more goals than random actions ({numbers}), but the intervals "
            "overlap: these episodes do not settle it. More training time or more episodes would."
        )
    return (
        f"The trained policy is not better than random actions ({numbers}). It had too little training: "
        "give the demo more time (make demo DEMO_ARGS='--minutes 30 --out demo-30')."
    )


def comparison_figure(agents: "Mapping[str, EvalResult]") -> "Figure":
    """Goals reached and distribution of the final error of each agent."""
    import numpy as np
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 3.6), layout="constrained")
    bars, curves = figure.subplots(1, 2, width_ratios=(1.0, 1.6))
    for position, (name, result) in enumerate(agents.items()):
        rate = result.overall.stop_rate
        spread = [[100 * (rate.value - rate.low)], [100 * (rate.high - rate.value)]]
        bars.bar(position, 100 * rate.value, color=COLORS[name], width=0.6)
        bars.errorbar(position, 100 * rate.value, yerr=np.maximum(spread, 0.0), color="0.2", capsize=5)
        errors = np.sort(result.errors().ravel())
        share = np.arange(1, len(errors) + 1) / len(errors)
        curves.step(
            np.append(errors, np.pi),
            np.append(share, 1.0),
            where="post",
            color=COLORS[name],
            label=NAMES[name],
        )
    bars.set_xticks(range(len(agents)), [NAMES[name].replace(" ", "\n") for name in agents])
    bars.set(ylabel="goals reached [%]", ylim=(0.0, 100.0))
    tolerance = next(iter(agents.values())).protocol.stop_tolerance_rad
    curves.axvline(tolerance, color="0.6", linewidth=0.8, linestyle="--")
    curves.set(
        xlabel="error at the end [rad]", ylabel="share of episodes", xlim=(0.0, np.pi), ylim=(0.0, 1.02)
    )
    curves.legend(frameon=False, loc="lower right")
    for axes in (bars, curves):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def _learning(page: Page, results: DemoResults, task: ReorientCfg, rows: list[dict[str, Any]]) -> None:
    from vd.train.curves import plot_curves

    page.section("Learning")
    counts = {name: count.per_episode for name, (_, count) in results.agents.items()}
    page.figure(
        learning_figure(rows, counts, first=task.num_worlds * task.max_episode_steps),
        "Goals reached in an episode during training, with exploration noise, from the first whole "
        "episode of all worlds on. Line and dot: random actions and the trained policy without noise, as "
        "in the table.",
    )
    curves = results.run_dir / "curves.png"
    plot_curves(results.run_dir / PROGRESS_FILE, curves)
    page.figure(curves, "Everything that was logged, against control steps of all worlds together.")


def learning_figure(rows: list[dict[str, Any]], per_episode: Mapping[str, float], *, first: int) -> "Figure":
    """The curve of the training beside the random agent.

    Args:
        rows: Rows of ``progress.jsonl``.
        per_episode: Goals that the ``random`` and the ``trained`` agent reached in an episode.
        first: Control steps before which only episodes with early ends are counted; left out.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 3.4), layout="constrained")
    axes = figure.subplots()
    last = rows[-1]["env_steps"] / 1e3
    points = [
        (row["env_steps"] / 1e3, row["goals_per_episode"])
        for row in rows
        if row["env_steps"] >= first and row["goals_per_episode"] is not None
    ]
    if points:
        axes.plot(*zip(*points, strict=True), color=COLORS["trained"], label="in training")
    axes.axhline(per_episode["random"], color=COLORS["random"], linewidth=1.4, label=NAMES["random"])
    axes.plot(last, per_episode["trained"], "o", color=COLORS["trained"], label="trained policy, no noise")
    axes.set(xlabel="control steps [thousand]", ylabel="goals an episode")
    axes.set_xlim(0.0, 1.03 * last)
    axes.set_ylim(bottom=0.0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="upper left")
    return figure


def _paper_criteria(page: Page, paper: EvalResult) -> None:
    overall = paper.overall
    page.section("An installed policy, judged as in the paper")
    page.text(
        "Objects fall into the hand, goals are from all of SO(3), and a goal counts only when fingers and "
        f"object are still. The demo's own training is far too short for that: these are of "
        f"{paper.protocol.policy}, which comes with the package and was trained on a GPU, on none of the "
        "demo's own objects."
    )
    rows = [
        (
            f"within {tolerance} rad at the end or stop",
            percent(rate),
            f"{100 * overall.chance[tolerance]:.2f} %",
        )
        for tolerance, rate in overall.success.items()
    ]
    rows.append(("stopped by itself: oriented and still", percent(overall.stop_rate), ""))
    rows.append(("dropped", percent(overall.drop_rate), ""))
    page.table([f"{overall.episodes} episodes", "this policy", "a random orientation"], rows)
    page.figure(
        ecdf_figure(paper),
        "Share of episodes that ended within each error. A dropped object never counts.",
    )
    page.text(
        f"Objects: {', '.join(paper.object_names)}. Every figure of this evaluation: evaluation/eval.html in "
        "the demo's folder. All of the paper's evaluations of the installed policies:",
        small=True,
    )
    page.code("vd-eval --suite paper --quick")


_MEANINGS = (
    "Error: the angle of the rotation from the object's orientation to the goal's, 0 to pi. "
    f"{PAPER.success.rotation_rad} rad is about {round(PAPER.success.rotation_rad * 57.3)} degrees. For a "
    "symmetric object such as the cube, the evaluation by the paper's criteria takes the smallest angle "
    "over its symmetries; training and comparison do not.",
    "Goal reached: all criteria of the task held in one step. The hand then gets a new goal without a "
    "reset. Some goals are reached by luck, since a new goal may lie within the tolerance at once: "
    "compare with the random agent.",
    "Dropped: the object left the workspace, farther than the fall distance from the hand's centre.",
    "Intervals: 95 %, t intervals on the log odds, over the episodes. They say how far a rate "
    "would move with other starts and goals, not with another training seed.",
    "Control step: one action at 12 Hz in one world, ten physics steps at 120 Hz.",
)
