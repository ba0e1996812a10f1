"""Child process of the importer: one job as JSON on standard input, its result on standard output."""

import json
import os
import signal
import sys
from dataclasses import asdict
from types import FrameType

from vd.interrupt import end_with_parent


def _end(number: int, _frame: FrameType | None) -> None:
    """End in order."""
    sys.exit(128 + number)


def main() -> None:
    """Run one import, as the head of a process group. A refusal is a result, anything else a traceback."""
    signal.signal(signal.SIGTERM, _end)
    end_with_parent(int(sys.argv[1]))  # before what takes long to import
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
