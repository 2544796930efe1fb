"""Hostile run folders: links and pipes, interpolations, decompression bombs, with valid hashes.

No file outside the folder may be written or deleted, no environment variable may leak into it, no run may hang or exhaust the memory,
and each refusal names the file.

    python -m bench.faults.hostile [--share 0.1]
"""

import hashlib
import io
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import torch
from bench.faults import common

from softmpm_learn.storage import checkpoint

SECRET = "a-secret-of-the-environment"
MEMORY = 600.0
"""Largest memory of a child beyond that of this process [MB]."""
LINKED = (
    *(".lock", "config.yaml", "metrics.csv", "timing.csv", "run.h5", "checkpoint.pt", "checkpoint.previous.pt"),
    *("softmpm_learn.log", "error.txt", "replay/00000003.h5", "run.h5.new", "metrics.csv.new", "timing.csv.new"),
    *("checkpoint.pt.new", "config.yaml.new", "softmpm_learn.log.new"),
)  # fmt: skip
TEXTS = {
    "environment in resume": ("resume: null", "resume: ${oc.env:SECRET}"),
    "environment in a name": ("name: mlp", "name: ${oc.env:SECRET}"),
    "environment with a default": ("effort: 0.001", "effort: ${oc.env:SECRET,0.5}"),
    "interpolation": ("seed: 0", "seed: ${train.worlds}"),
    "resolver": ("seed: 0", "seed: ${began:%Y}"),
    "python object": ("seed: 0", "seed: !!python/object/apply:os.mkdir [hacked]"),
    "target": ("resume: null", "_target_: os.mkdir\nresume: null"),
    "billion laughs": (
        "task:",
        "a: &a [x, x, x, x, x, x, x, x, x]\n"
        + "".join(
            f"{b}: &{b} [{', '.join(9 * ['*' + a])}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
        )
        + "task:",
    ),
    "deep": ("resume: null", "resume: " + 9999 * "[" + 9999 * "]"),
    "wide": ("resume: null", "resume: " + 10**7 * "x"),
    "parent folder": ("name: arm", "name: ../../arm"),
    "no text": ("resume: null", "resume: \udcff"),
}


def main(share: float = 1.0) -> common.Table:
    """All trials, or a share of them."""
    bad = ["wrote elsewhere", "leak", "memory", "hang", "unclear"]
    table = common.Table("hostile run folders", bad)
    os.environ["SECRET"] = SECRET
    with common.workshop() as folder:
        ended = common.forked(common.fresh(folder / "run"))
        assert ended.code == 0, ended.output
        for kind, name, harm in common.some(trials(), share):
            table.add(kind, *outcome(folder, name, harm))
    return table


def trials() -> list[tuple[str, str, Callable[[Path, Path], None]]]:
    found = [("link to a file", name, symbolic(name)) for name in LINKED]
    found += [("link to nothing", name, dangling(name)) for name in LINKED]
    found += [("hard link", name, hard(name)) for name in LINKED if not name.startswith("replay")]
    found += [("pipe", name, pipe(name)) for name in (".lock", "config.yaml", "metrics.csv", "run.h5")]
    found += [("link to a folder", "replay", linked_replay)]
    found += [("config.yaml", name, edited(*texts)) for name, texts in TEXTS.items()]
    found += [("bomb", work.__name__, work) for work in BOMBS]
    return found


def outcome(folder: Path, name: str, harm: Callable[[Path, Path], None]) -> tuple[str, str]:
    run, elsewhere = folder / "harmed", folder / "elsewhere"
    shutil.copytree(folder / "run", run)
    elsewhere.mkdir()
    (elsewhere / "00000009.h5").write_bytes(b"precious")
    (elsewhere / "draft.new").write_bytes(b"precious")
    harm(run, elsewhere)
    before = contents(folder)
    ended = common.forked(common.resume(run, iterations=5))
    try:
        return judged(folder, run, ended, before, name)
    finally:
        shutil.rmtree(run)
        shutil.rmtree(elsewhere)


def contents(folder: Path) -> dict[str, bytes]:
    """Contents of all files outside the harmed run."""
    found = (path for path in folder.rglob("*") if path.is_file() and "harmed" not in path.parts)
    return {str(path): path.read_bytes() for path in found}


def judged(
    folder: Path, run: Path, ended: common.Ended, before: dict[str, bytes], name: str
) -> tuple[str, str]:
    message = f"{name}: {ended.output}"
    if contents(folder) != before:
        return "wrote elsewhere", message
    if ended.hung:
        return "hang", message
    files = [path.read_bytes() for path in run.rglob("*") if path.is_file() and not path.is_symlink()]
    if SECRET in ended.output or any(SECRET.encode() in data for data in files):
        return "leak", message
    if ended.megabytes > MEMORY:
        return "memory", f"{ended.megabytes:.0f} MB: {message}"
    if ended.code and (common.unclear(ended.output) or str(run) not in ended.output):
        return "unclear", message
    return ("refused" if ended.code else "went on"), ""


def symbolic(name: str) -> Callable[[Path, Path], None]:
    """The file is moved out of the folder and replaced by a symbolic link to it."""

    def harm(run: Path, elsewhere: Path) -> None:
        if (run / name).exists():
            shutil.move(run / name, elsewhere / "target")
        else:
            (elsewhere / "target").write_bytes(b"precious")
        (run / name).symlink_to(elsewhere / "target")

    return harm


def dangling(name: str) -> Callable[[Path, Path], None]:
    def harm(run: Path, elsewhere: Path) -> None:
        (run / name).unlink(missing_ok=True)
        (run / name).symlink_to(elsewhere / "not-there")

    return harm


def hard(name: str) -> Callable[[Path, Path], None]:
    def harm(run: Path, elsewhere: Path) -> None:
        if not (run / name).exists():
            (run / name).write_bytes(b"precious")
        os.link(run / name, elsewhere / "target")

    return harm


def pipe(name: str) -> Callable[[Path, Path], None]:
    def harm(run: Path, elsewhere: Path) -> None:
        (run / name).unlink()
        os.mkfifo(run / name)

    return harm


def linked_replay(run: Path, elsewhere: Path) -> None:
    for path in (run / "replay").iterdir():
        shutil.copy(path, elsewhere)
    shutil.rmtree(run / "replay")
    (run / "replay").symlink_to(elsewhere)


def edited(old: str, new: str) -> Callable[[Path, Path], None]:
    def harm(run: Path, elsewhere: Path) -> None:
        text = (run / "config.yaml").read_text()
        assert old in text, old
        (run / "config.yaml").write_bytes(text.replace(old, new, 1).encode(errors="surrogateescape"))

    return harm


def resealed(run: Path, **changes: object) -> None:
    """Rewrite the checkpoint with changed content and a valid hash."""
    checkpoint.save(run, checkpoint.load(run) | changes)
    (run / checkpoint.PREVIOUS).unlink()


def replay_bomb(run: Path, elsewhere: Path) -> None:
    """2 kB that declare 950 MB, with a valid hash."""
    path = run / "replay" / "00000003.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("velocity", (2400, 2, 222, 222), np.float32, chunks=True, compression=1)
    learner = checkpoint.load(run)["learner"]
    learner["replay"][3] = hashlib.sha256(path.read_bytes()).hexdigest()
    resealed(run, learner=learner)


def many_simulations(run: Path, elsewhere: Path) -> None:
    learner = checkpoint.load(run)["learner"]
    learner["replay"] = dict.fromkeys(range(10**5), "0" * 64)
    resealed(run, learner=learner)


def stride_bomb(run: Path, elsewhere: Path) -> None:
    """A tensor of 500 MB that stores one number."""
    resealed(run, safe=[torch.zeros(1).expand(125_000_000)])


def packed_bomb(run: Path, elsewhere: Path) -> None:
    """A checkpoint of 0.5 MB that decompresses to 500 MB."""
    import zipfile

    buffer = io.BytesIO()
    torch.save(checkpoint.load(run) | {"zeros": torch.zeros(125_000_000)}, buffer)
    packed = io.BytesIO()
    with zipfile.ZipFile(buffer) as old, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as new:
        for entry in old.namelist():
            new.writestr(entry, old.read(entry))
    body = packed.getvalue()[:-2] + (71).to_bytes(2, "little")
    (run / checkpoint.NAME).write_bytes(body + b"sha256=" + hashlib.sha256(body).hexdigest().encode())
    (run / checkpoint.PREVIOUS).unlink()


def code_in_a_checkpoint(run: Path, elsewhere: Path) -> None:
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(elsewhere / "hacked"),)

    resealed(run, evil=Evil())


def wrong_structure(run: Path, elsewhere: Path) -> None:
    resealed(run, policy=7, seals=[])


def not_finite(run: Path, elsewhere: Path) -> None:
    policy = checkpoint.load(run)["policy"]
    resealed(run, policy={name: torch.full_like(tensor, torch.nan) for name, tensor in policy.items()})


def recording_bomb(run: Path, elsewhere: Path) -> None:
    """Tables that declare a million rows which were never written."""
    with h5py.File(run / "run.h5", "r+") as file:
        for name in ("x", "v", "strain"):
            table = file[f"frame/{name}"]
            table.resize((10**6, *table.shape[1:]))


def recording_elsewhere(run: Path, elsewhere: Path) -> None:
    shutil.move(run / "run.h5", elsewhere / "run.h5")
    with h5py.File(run / "run.h5", "w") as file:
        for name in ("static", "frame", "field", "latent", "episode", "scalar"):
            file[name] = h5py.ExternalLink(str(elsewhere / "run.h5"), name)
        for name, value in (("format", np.bytes_(b"softmpm recording")), ("version", 1), ("dt", 1.0)):
            file.attrs[name] = value
        file.attrs["spacing"], file.attrs["share"] = 1.0, 1.0


BOMBS = (
    *(replay_bomb, many_simulations, stride_bomb, packed_bomb, code_in_a_checkpoint, wrong_structure),
    *(not_finite, recording_bomb, recording_elsewhere),
)


if __name__ == "__main__":
    common.report(main)
