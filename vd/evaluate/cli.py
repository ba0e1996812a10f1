"""Command line of evaluation: ``vd-eval POLICY ... --objects SET ... --episodes M``."""

import json
import sys
from collections.abc import Sequence
from itertools import chain

import tyro

from vd import interrupt
from vd.evaluate.agents import check_names, check_second_view
from vd.evaluate.cfg import EvalCfg, parse_groups
from vd.files import check_folder


@interrupt.command("vd-eval")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``vd-eval``; returns the exit status."""
    cfg = tyro.cli(EvalCfg, args=arguments, prog="vd-eval")
    try:
        cfg.validate()
        names = cfg.agent_names
        check_names(names, chain(*parse_groups(cfg.object_sets).values()), cfg.hand)
        check_folder(cfg.out)
        if cfg.second_view:
            check_second_view(names)
        return _evaluate(cfg) if cfg.suite is None else _run_suite(cfg)
    except (ValueError, OSError, RuntimeError) as error:
        print(f"vd-eval: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        hint = "; the same command goes on from here" if cfg.suite else ""
        print(f"\nvd-eval: interrupted{hint}", file=sys.stderr)
        return interrupt.INTERRUPTED


def _evaluate(cfg: EvalCfg) -> int:
    from vd.evaluate.compare import compare

    comparison = compare(cfg)
    from vd.evaluate.comparison_page import terminal_text

    if cfg.json:
        print(json.dumps(comparison.summary(), indent=1))
    else:
        print(f"{terminal_text(comparison)}\n{cfg.out / 'eval.json'}\n{cfg.out / 'eval.html'}")
    return 0


def _run_suite(cfg: EvalCfg) -> int:
    from vd.evaluate.suite_page import out_of_time, terminal_table
    from vd.evaluate.suite_run import PAGE_FILE, RESULT_FILE, run_suite

    result = run_suite(cfg)
    if cfg.json:
        print(json.dumps(result.summary(), indent=1))
    else:
        print(f"{terminal_table(result)}\n")
        if result.found:
            print(f"{cfg.out / RESULT_FILE}\n{cfg.out / PAGE_FILE}")
    if result.late:
        print(f"vd-eval: {out_of_time(result)}", file=sys.stderr)
    for (condition, policy), why in result.failed.items():
        print(f"vd-eval: {condition} of {policy} failed: {why}", file=sys.stderr)
    return 1 if result.failed else 0


if __name__ == "__main__":
    sys.exit(main())
