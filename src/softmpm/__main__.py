"""``python -m softmpm run.h5``: turn a recording into a Rerun file, on any machine."""

import argparse
import sys
from pathlib import Path

from softmpm.recording.rerun_export import to_rerun


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m softmpm",
        description="Turn a recording (HDF5) into a Rerun file; works during a run and after a crash.",
    )
    parser.add_argument("recording", type=Path, help="the run's HDF5 file, such as run.h5")
    parser.add_argument("rrd", type=Path, nargs="?", help="file to write; beside the recording if not given")
    parser.add_argument("--every", type=int, default=1, metavar="K", help="convert each K-th frame only")
    parser.add_argument(
        "--max-particles", type=int, metavar="N", help="convert N particles only, chosen evenly"
    )
    given = parser.parse_args()
    try:
        rrd = to_rerun(given.recording, given.rrd, every=given.every, max_particles=given.max_particles)
    except (ImportError, OSError, ValueError) as error:
        print(f"softmpm: {error}", file=sys.stderr)
        return 1
    print(f"rerun {rrd}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
