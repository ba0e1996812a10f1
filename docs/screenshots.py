"""``python docs/screenshots.py [NAME ...]``: the pages of the commands as pictures in docs/media.

It runs every command on a CPU and looks with a headless Chromium; minutes. Look at each picture
before you commit it.
"""

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.error import URLError
from urllib.request import urlopen

from PIL import Image

MEDIA = Path(__file__).parent / "media"
BIN = Path(sys.executable).parent
PORT = 8123
WIDTH, QUALITY = 880, 70
"""Pixels across, and quality of the WebP: some 30 kB each."""
FLAGS = [
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
    "--disable-features=DisableLoadExtensionCommandLineSwitch",
]
HIDDEN = {
    "manifest_version": 3,
    "name": "quiet",
    "version": "1",
    "content_scripts": [{"matches": ["http://127.0.0.1/*"], "css": ["quiet.css"]}],
}
"""An extension that hides viser's note of a browser without a GPU."""
UNSEEN = "procedural-heldout-4-seed0"
PAGES: dict[str, tuple[tuple[str, ...], str, int]] = {
    "play": ((f"vd-play dclaw4-vision --objects {UNSEEN} --device cpu --port {PORT}",), "", 800),
    "eval": (
        (f"vd-eval dclaw4 dclaw4-cube --objects {UNSEEN} --episodes 6 --device cpu --out .",),
        "eval.html",
        710,
    ),
    "gap": (
        (
            "vd-gap hide servo --effect backlash:width_rad=0.06 --out rec",
            "vd-gap run rec --out gap",
        ),
        "gap/report.html",
        738,
    ),
    "deploy": (
        ("vd-deploy --hand dclaw3 --twin --random-goals 2 --seed 1 --safety.misses 99 --log run",),
        "run/run.html",
        880,
    ),
}
"""Of each picture the commands, the page that they leave (the viewer is one itself), and its
height.
"""
LOOK_S, START_S = 60, 600.0
"""Time that the viewer is watched for [s]: its panel unfolds slowly; and the longest it takes to
start.
"""


def main(names: list[str]) -> None:
    """Take the pictures of these names, or all."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        raise SystemExit("no browser found; install chromium")
    for name in names or PAGES:
        commands, page, height = PAGES[name]
        with TemporaryDirectory() as work:
            shot = Path(work) / "shot.png"
            quiet = Path(work) / "quiet"
            quiet.mkdir()
            (quiet / "manifest.json").write_text(json.dumps(HIDDEN))
            (quiet / "quiet.css").write_text(".mantine-Notifications-root { display: none; }")
            look = [browser, *FLAGS, f"--window-size=1280,{height}", f"--load-extension={quiet}"]
            look += [f"--user-data-dir={work}/profile", f"--screenshot={shot}"]
            calls = [[str(BIN / command.split()[0]), *command.split()[1:]] for command in commands]
            if page:
                for call in calls:
                    subprocess.run(call, cwd=work, check=True)
                (file,) = Path(work).glob(page)
                file.write_text(file.read_text().replace(" controls", ""))  # they lie over a film
                subprocess.run([*look, file.as_uri()], check=True)
            else:
                with subprocess.Popen(calls[0], cwd=work) as server:
                    try:
                        wait_for(f"http://127.0.0.1:{PORT}")
                        address = f"http://127.0.0.1:{PORT}"
                        subprocess.run(
                            [*look, f"--virtual-time-budget={1000 * LOOK_S}", address], check=True
                        )
                    finally:
                        server.terminate()
            with Image.open(shot) as picture:
                size = WIDTH, round(picture.height * WIDTH / picture.width)
                target = MEDIA / f"page-{name}.webp"
                picture.convert("RGB").resize(size, Image.Resampling.LANCZOS).save(
                    target, quality=QUALITY
                )
        print(f"{target}: {target.stat().st_size / 1e3:.0f} kB", flush=True)


def wait_for(address: str) -> None:
    """Wait until a page answers, and a while more, for the hand to move."""
    begun = time.monotonic()
    while time.monotonic() < begun + START_S:
        try:
            urlopen(address).close()
            return time.sleep(10.0)
        except URLError:
            time.sleep(1.0)
    raise SystemExit(f"{address} does not answer")


if __name__ == "__main__":
    main(sys.argv[1:])
