"""``vd-gap contact``: what an object's recorded motions tell of its contact."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

if TYPE_CHECKING:
    from vd.gap.contact import ContactEstimate

FORMAT = "vd-contact-report/1"
REPORT = "report.json"
LAYER = "identified.usda"


@dataclass(frozen=True)
class Contact:
    """Friction, restitution, mass, its centre and soft fingertips from the recorded motions of an object.

    Writes DIR/report.json and DIR/identified.usda, a layer over the object's file that --objects
    takes.
    """

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """Folder with recording.json (model contact) and its CSV files."""
    object: str
    """The object: a set of one, such as cube, its file, as vd-assets writes it, or a layer over
    that.
    """
    out: Path = Path("contact")
    """DIR: folder of the report and of the layer."""

    def run(self) -> int:
        """Identify, write, and print the verdict."""
        from vd.logs.contact_recording import read_contact_recording

        recording = read_contact_recording(self.recording)
        began = time.perf_counter()
        from vd.assets_usd.objects.model import read_object, write_contact_layer
        from vd.assets_usd.objects.sets import set_files
        from vd.command.files import make_folder, write_json
        from vd.gap.contact import identify_contact

        file, *others = set_files([self.object])
        if others:
            raise ValueError(
                f"--object {self.object} has {1 + len(others)} objects; name the one that moved"
            )
        item = read_object(file)
        layer = self.out / LAYER
        if layer.exists() and layer.samefile(file):
            raise ValueError(f"--out {self.out} holds --object itself; name another folder")
        found = identify_contact(recording, item)
        report = contact_report(
            found, str(self.recording), self.object, time.perf_counter() - began
        )
        make_folder(self.out)
        write_contact_layer(layer, file, identified(found), str(self.recording))
        write_json(self.out / REPORT, report)
        names = [effect["name"] for effect in report["effects"]]
        print(f"{report['verdict']}: {', '.join(names) or 'nothing named'}")
        for each in found:
            values = []
            for value, low, high in zip(each.value, each.low, each.high, strict=True):
                values.append(f"{value:.4g} ({low:.4g} to {high:.4g})")
            print(f"  {each.name}: {each.verdict}: {' '.join(values)}; {each.reason}")
        print(f"{self.out / REPORT}\n{layer}")
        return 0


def identified(found: "Sequence[ContactEstimate]") -> dict[str, tuple[tuple[float, ...], ...]]:
    """What is told, as :func:`vd.assets_usd.objects.contact_layer.write_contact_layer` takes it."""
    result = {}
    for each in found:
        if each.verdict == "unknown":
            continue
        low = each.low
        if len(low) == 1:  # a coarse interval may reach below zero, which cannot be simulated
            low = np.maximum(low, 0.1 * each.value)
        result[each.name] = tuple(map(tuple, np.stack([each.value, low, each.high]).tolist()))
    return result


def contact_report(
    found: "Sequence[ContactEstimate]", recording: str, item: str, seconds: float
) -> Mapping[str, Any]:
    """``report.json``; a number that is not known is None."""
    from vd.assets_usd.objects.contact_layer import CONTACT
    from vd.gap.contact import by_weight, verdict

    def numbers(values: Any) -> list[float | None]:
        return [float(value) if value == value else None for value in values]

    estimates = {}
    parameters = {}
    for each in found:
        one = estimates[each.name] = {
            "value": numbers(each.value),
            "ci95": [numbers(each.low), numbers(each.high)],
            "unit": CONTACT[each.name].unit,
        }
        parameters[each.name] = {
            **one,
            "verdict": each.verdict,
            "nominal": numbers(each.nominal),
            "motions": each.motions,
            "reason": each.reason,
        }
    effects = []
    for each in by_weight(found):
        named = {each.name: estimates[each.name]}
        effects.append({"name": each.name, "confidence": each.confidence, "parameters": named})
    return {
        "format": FORMAT,
        "verdict": verdict(found),
        "effects": effects,
        "parameters": parameters,
        "recording": recording,
        "object": item,
        "seconds": seconds,
    }
