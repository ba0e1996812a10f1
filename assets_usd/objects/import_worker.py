"""Child process of the importer: one job as JSON on standard input, its result on standard output."""

import json
import sys
from dataclasses import asdict

from vd.assets_usd.objects.decompose import DecomposeSettings
from vd.assets_usd.objects.importer import ImportResult, ImportSettings, Job, import_mesh
from vd.assets_usd.objects.meshes import MeshError
from vd.files import OutputError


def main() -> None:
    """Run one import; a refusal is a result, anything else ends with a traceback."""
    request = json.load(sys.stdin)
    given = request["settings"]
    settings = ImportSettings(**{**given, "decompose": DecomposeSettings(**given["decompose"])})
    job = Job(**request["job"])
    try:
        result = import_mesh(job, settings)
    except (MeshError, OutputError) as error:
        result = ImportResult(job.source, job.name, "refused", str(error))
    print(json.dumps(asdict(result)))


if __name__ == "__main__":
    main()
