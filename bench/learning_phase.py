"""Time of a learning phase, for one learner and for many in lock step.

    python bench/learning_phase.py [--device cuda] [--json bench/results/learning_phase.json]

Pictures have the shape of those of the elephant at its standard resolution, and the replay buffers are full of random smooth ones.
Early stopping is off, so a phase has the most epochs that the settings allow; on a CPU a tenth of them. ``captured`` is yes where an
epoch is one CUDA graph. ``first s`` has the capture in it; ``phase s`` is a median of later phases.
"""

import dataclasses
import tempfile
import time
from pathlib import Path

import torch
from common import Table, arguments, median_seconds, sync
from torch import Tensor
from torch.nn import functional

import softmpm
from softmpm_learn.autoencoder import Autoencoder
from softmpm_learn.learning.learner import Learner
from softmpm_learn.learning.phase import learn_together
from softmpm_learn.learning.replay import Replay
from softmpm_learn.observe import VelocityImage
from softmpm_learn.seeding import seeded
from softmpm_learn.settings import LearningConf, ObserverConf
from softmpm_learn.tasks.elephant import ElephantConf, elephant

LEARNERS = (1, 10)
COARSE = 5
"""Random numbers along each axis of a picture, between which it is smooth."""


def shape_of_pictures(device: torch.device) -> tuple[int, ...]:
    """Frames of an episode of the elephant, dim, nodes of a picture."""
    task = elephant(ElephantConf())
    model = softmpm.build(task.scene, device=device, **task.build)
    frames = -(-task.control_steps // LearningConf().frame_every)
    return frames, model.dim, *VelocityImage(model, ObserverConf().nodes).shape


def smooth(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    coarse = torch.randn(*shape[:2], COARSE, COARSE, generator=generator)
    return functional.interpolate(coarse, size=shape[2:], mode="bilinear", align_corners=True)


def make_learner(folder: Path, conf: LearningConf, shape: tuple[int, ...], seed: int, device) -> Learner:
    limits = dict(simulations=conf.simulations, megabytes=conf.megabytes, validation=conf.validation)
    replay, generator = Replay(folder, shape, **limits, device=device), torch.Generator().manual_seed(seed)
    for number in range(replay.capacity):
        replay.add(number, smooth(shape, generator))
    observer = ObserverConf()
    with seeded(seed):
        autoencoder = Autoencoder(shape[1], shape[2:], observer.latent_size, observer.channels)
    return Learner(conf, autoencoder.to(device), replay, seed)


def main():
    args = arguments(__doc__)
    device = torch.device(args.device, 0) if args.device == "cuda" else torch.device(args.device)
    on_gpu = device.type == "cuda"
    conf = LearningConf(early_stopping=False)
    conf = conf if on_gpu else dataclasses.replace(conf, epochs=conf.epochs // 10)
    shape, repeats = shape_of_pictures(device), args.repeats if on_gpu else 1
    table = Table("A learning phase, float32", device, args.json)
    with tempfile.TemporaryDirectory() as folder:
        learners = [
            make_learner(Path(folder) / str(seed), conf, shape, seed, device) for seed in range(max(LEARNERS))
        ]
        for count in LEARNERS:
            for capture in (False, True) if on_gpu else (False,):
                some = learners[:count]
                sync(device)
                begin = time.perf_counter()
                learn_together(some, capture=capture)
                sync(device)
                first = time.perf_counter() - begin
                seconds = median_seconds(
                    lambda some=some, capture=capture: learn_together(some, capture=capture), device, repeats
                )
                table.add(
                    {
                        "picture": "×".join(map(str, shape[1:])),
                        "learners": count,
                        "captured": "yes" if capture else "no",
                        "simulations": learners[0].replay.capacity,
                        "MB each": 1e-6 * learners[0].replay.memory.nbytes,
                        "epochs": conf.epochs,
                        "first s": first,
                        "phase s": seconds,
                        "epoch ms": 1e3 * seconds / conf.epochs,
                    }
                )


if __name__ == "__main__":
    main()
