"""Command line of evaluation: ``vd-eval POLICY ... --objects SET ... --episodes M``."""

import json
import sys
from collections.abc import Sequence
from itertools import chain

import tyro

from vd import interrupt
from vd.evaluate.agents import check_names
from vd.evaluate.cfg import EvalCfg, parse_groups
from vd.files import check_file, check_folder


@interrupt.command("vd-eval")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``vd-eval``; returns the exit status."""
    cfg = tyro.cli(EvalCfg, args=arguments, prog="vd-eval")
    try:
        cfg.validate()
        check_names(cfg.agent_names, chain(*parse_groups(cfg.object_sets).values()), cfg.hand)
        check_folder(cfg.out)
        if cfg.suite is None:
            check_file(cfg.out / "eval.json")
        return _evaluate(cfg) if cfg.suite is None else _run_suite(cfg)
    except KeyboardInterrupt:
        hint = "; the same command goes on from here" if cfg.suite else ""
        print(f"\nvd-eval: interrupted{hint}", file=sys.stderr)
        return interrupt.INTERRUPTED


def _evaluate(cfg: EvalCfg) -> int:
    from vd.evaluate.compare import compare

    result = compare(cfg)
    from vd.evaluate.page import terminal_text, write_page

    write_page(result, cfg.out / "eval.html")
    if cfg.json:
        print(json.dumps(result.summary(), indent=1))
    else:
        print(f"{terminal_text(result)}\n{cfg.out / 'eval.json'}\n{cfg.out / 'eval.html'}")
    return 0


def _run_suite(cfg: EvalCfg) -> int:
    from vd.evaluate.page import terminal_text
    from vd.evaluate.suite_run import OUT_OF_TIME, run_suite

    result = run_suite(cfg)
    written, page = (cfg.out / f"{cfg.suite}{suffix}" for suffix in (".json", ".html"))
    print(written.read_text() if cfg.json else f"{terminal_text(result)}\n{written}\n{page}")
    for condition, policy, why in result.missing:
        print(f"vd-eval: {condition} of {policy}: {why}", file=sys.stderr)
    return int(any(why != OUT_OF_TIME for _, _, why in result.missing))


if __name__ == "__main__":
    sys.exit(main())
