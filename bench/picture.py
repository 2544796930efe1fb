"""Pictures of a Rerun file without a screen: ``python bench/picture.py run.rrd pictures --times 0.2 0.8``.

Needs a Vulkan driver; without a GPU, Mesa's will do (Debian: ``apt install mesa-vulkan-drivers libvulkan1``).
"""

import argparse
import os
import sys
import time
from pathlib import Path


def take(rrd: Path, folder: Path, times: list[float], view: str | None, port: int) -> list[Path]:
    """One PNG for each time [s] on the time line ``time``, of the window or of one view."""
    import rerun as rr

    os.environ["PATH"] = (
        f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"  # where pip put the viewer
    )
    folder.mkdir(parents=True, exist_ok=True)
    client = rr.experimental.ViewerClient.spawn(
        headless=True, port=port, hide_welcome_screen=True, detach_process=False
    )
    paths = []
    with client:
        client.open(str(rrd))
        time.sleep(2)
        chosen = {}
        if view:
            chosen["view_id"] = next(v.view_id for v in client.get_state().views if v.name.startswith(view))
        for seconds in times:
            client.set_time("time", duration=seconds, play_state="paused")
            time.sleep(0.5)
            paths.append(folder / f"{rrd.stem}_{seconds:g}.png")
            paths[-1].write_bytes(client.take_screenshot(**chosen))
    return paths


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rrd", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--times", type=float, nargs="+", default=[0.5], help="seconds on the time line 'time'"
    )
    parser.add_argument("--view", help="name of one view, or how it begins; the whole window without")
    parser.add_argument("--port", type=int, default=9957)
    given = parser.parse_args()
    for path in take(given.rrd, given.folder, given.times, given.view, given.port):
        print(path)
