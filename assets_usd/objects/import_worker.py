"""Child process of the importer: one job as JSON on standard input, its result on standard output."""

import ctypes
import json
import os
import signal
import sys
from dataclasses import asdict
from types import FrameType

PR_SET_PDEATHSIG = 1
"""Option of Linux's prctl: the signal that a process gets when its parent ends."""


def end_with(parent: int) -> None:
    """End this process in order on SIGTERM, which it also gets when its parent ends, however that ends."""

    def end(number: int, _frame: FrameType | None) -> None:
        sys.exit(128 + number)

    signal.signal(signal.SIGTERM, end)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:  # it has ended already
        sys.exit(1)


def main() -> None:
    """Run one import, as the head of a process group. A refusal is a result, anything else a traceback."""
    end_with(int(sys.argv[1]))  # before what takes long to import
    from vd.assets_usd.objects.decompose import DecomposeSettings
    from vd.assets_usd.objects.importer import ImportResult, import_mesh
    from vd.assets_usd.objects.meshes import MeshError, Sizing
    from vd.assets_usd.objects.model import ObjectError
    from vd.assets_usd.objects.plan import ImportSettings, Job

    request = json.load(sys.stdin)
    given = request["settings"]
    given["decompose"] = DecomposeSettings(**given["decompose"])
    given["sizing"] = Sizing(**given["sizing"])
    job = Job(**request["job"])
    try:
        result = import_mesh(job, ImportSettings(**given))
    except SystemExit:  # what was half written is removed by now; a decomposition under way may not listen
        os.killpg(0, signal.SIGKILL)
        raise
    except (MeshError, ObjectError, OSError) as error:
        result = ImportResult(job.source, job.name, "refused", str(error))
    print(json.dumps(asdict(result)))


if __name__ == "__main__":
    main()
