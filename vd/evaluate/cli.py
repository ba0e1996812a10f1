"""Command line of evaluation: ``vd-eval POLICY ... --objects SET ... --episodes M``."""

import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

from vd.command import interrupt
from vd.command.files import check_file, check_folder
from vd.command.line import flags_of, parse, say_same_as
from vd.command.warp_quiet import quiet_warp
from vd.evaluate.cfg import EvalCfg, parse_groups
from vd.evaluate.suite import read_suite
from vd.policy.agents import check_names


@interrupt.command("vd-eval")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``vd-eval``; returns the exit status."""
    cfg: EvalCfg = parse(EvalCfg, arguments, prog="vd-eval")
    try:
        cfg.validate()
        check_names(cfg.agent_names, chain(*parse_groups(cfg.object_sets).values()), cfg.hand)
        check_folder(cfg.out)
        if not (cfg.policies or cfg.suite):
            full = replace(cfg, objects=cfg.object_sets)
            flags = flags_of(full, "policies", always=("episodes", "out"))
            say_same_as("vd-eval", *cfg.agent_names, *flags)
        if cfg.suite is None:
            check_file(cfg.out / "eval.json")
        else:
            read_suite(cfg.suite)
        return _evaluate(cfg)
    except KeyboardInterrupt:
        hint = "; the same command goes on from here" if cfg.suite else ""
        print(f"\nvd-eval: interrupted{hint}", file=sys.stderr)
        return interrupt.INTERRUPTED


def _evaluate(cfg: EvalCfg) -> int:
    from vd.evaluate.compare import compare, open_agents
    from vd.evaluate.page import terminal_text, write_page
    from vd.evaluate.spin import SPIN_FILE, evaluate_spin, spins
    from vd.evaluate.suite_run import run_suite

    quiet_warp()
    policies = {} if cfg.suite else open_agents(cfg)
    if any(map(spins, policies.values())):
        print(f"{evaluate_spin(cfg, policies).text()}\n{cfg.out / SPIN_FILE}")
        return 0
    written = cfg.out / f"{cfg.suite_name}.json"
    page = cfg.out / f"{cfg.suite_name}.html"
    if cfg.suite is None:
        result = compare(cfg, policies=policies)
        write_page(result, page)
    else:
        result = run_suite(cfg)
    if cfg.shard is not None:
        print(
            f"{cfg.out}: part {cfg.shard}; the same command without --shard writes the page",
            file=sys.stderr,
        )
    else:
        print(f"{terminal_text(result)}\n{written}\n{page}")
    for condition, policy, why in result.missing:
        print(f"vd-eval: {condition} of {policy}: {why}", file=sys.stderr)
    return int(bool(result.missing))


if __name__ == "__main__":
    sys.exit(main())
