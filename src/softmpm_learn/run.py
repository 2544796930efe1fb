"""One run, from its settings to what it leaves in its folder. No Hydra here."""

from pathlib import Path
def run(conf, out: Path, *, resume: bool) -> None:
    print("run", conf.task.name, out, resume, conf.train.iterations)
