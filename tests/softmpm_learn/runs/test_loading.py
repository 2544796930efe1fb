"""A run that is loaded from its folder moves as it did, in an episode and in an environment; the blocks of docs/learning.md run."""

import dataclasses
import re
import shutil
from pathlib import Path

import pytest
import torch

import softmpm_learn
from softmpm_learn.command import experiment
from softmpm_learn.config import DeviceConf, RunConf
from softmpm_learn.episode import run_episode
from softmpm_learn.gym import EnvConf, SoftRobotEnv
from softmpm_learn.settings import DesignConf, LearningConf, ObserverConf, PolicyConf, TrainConf
from softmpm_learn.storage import checkpoint
from softmpm_learn.tasks import BipedConf

PAGE = Path(__file__).parents[3] / "docs" / "learning.md"


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder with a short run of a biped that learned a latent and designed its muscles too, and its result."""
    out = tmp_path_factory.mktemp("loading") / "walk"
    conf = RunConf(
        task=BipedConf(name="biped", seconds=0.1, control_period=0.025, lead=0.0),
        observer=ObserverConf(latent_size=3, channels=[4, 4]),
        policy=PolicyConf(hidden=[8]),
        design=DesignConf(strength=True),
        learning=LearningConf(every=2, epochs=1, batches=1, batch=4),
        train=TrainConf(iterations=3, record_every=0, examine=False, pictures=False, endurance=1),
        device=DeviceConf(name="cpu"),
    )
    (result,) = experiment.run_experiment(conf, out)
    return out, result


def losses(run) -> torch.Tensor:
    params, inputs = run.design()
    with torch.no_grad():
        return run_episode(run.task, run.model, run.observer, run.policy, params, inputs=inputs).loss


def test_a_loaded_run_is_at_its_best(finished, tmp_path):
    """Without its replay buffer, from a copy in which nothing changes; the motion is that of the best, to the last bit."""
    out, result = finished
    copy = tmp_path / "copy"
    shutil.copytree(out, copy, ignore=shutil.ignore_patterns("replay", "*.csv", ".lock"))
    before = {path: path.read_bytes() for path in copy.rglob("*")}
    run = softmpm_learn.load(copy, device="cpu")
    assert {path: path.read_bytes() for path in copy.rglob("*")} == before and run.out == copy
    result.run.load_policy(result.run.best)
    assert losses(run).item() == losses(result.run).item()
    first = run.settings.suited(run.task, encoded=True)
    assert first == run.settings and run.best["iteration"] == result.best_iteration


def test_a_run_of_a_program_is_loaded_with_its_task_and_settings(finished, tmp_path):
    """A folder without config.yaml; other settings, another task and one of the two alone are refused."""
    out, result = finished
    shutil.copy(out / "checkpoint.pt", tmp_path)
    task, settings = result.run.task, result.run.settings
    run = softmpm_learn.load(tmp_path, device="cpu", task=task, settings=settings)
    assert losses(run).item() == losses(softmpm_learn.load(out, device="cpu")).item()
    with pytest.raises(ValueError, match=r"must have a config.yaml, .* load\(folder, task=…, settings=…\)"):
        softmpm_learn.load(tmp_path, device="cpu")
    with pytest.raises(ValueError, match="both task= and settings="):
        softmpm_learn.load(tmp_path, device="cpu", task=task)
    slower = dataclasses.replace(settings, policy=PolicyConf(hidden=[9]))
    with pytest.raises(ValueError, match=r"policy.hidden: \[8\] then, \[9\] now"):
        softmpm_learn.load(tmp_path, device="cpu", task=task, settings=slower)
    steps = dataclasses.replace(task, control_steps=task.control_steps + 1)
    with pytest.raises(ValueError, match="task.control_steps: 4 then, 5 now"):
        softmpm_learn.load(tmp_path, device="cpu", task=steps, settings=settings)


def test_worlds_of_a_loaded_run_may_differ_in_friction(finished):
    """In one simulation, with the muscles that were designed: each world has the loss of a scene with its friction."""
    out, _ = finished
    run = softmpm_learn.load(out, device="cpu")
    model, (params, inputs) = run.model_of(run.task, worlds=2, inputs=["friction"]), run.design()
    frictions = torch.tensor([[0.1, 0.0], [0.8, 0.0]])  # of the floor and of the wall behind
    with torch.no_grad():
        given = inputs._replace(friction=frictions)
        found = run_episode(run.task, model, run.observer, run.policy, params, inputs=given).loss
    assert found[1].item() == pytest.approx(losses(run).item(), rel=1e-5)
    floor, behind = run.task.scene.walls
    scene = dataclasses.replace(run.task.scene, walls=[dataclasses.replace(floor, friction=0.1), behind])
    run.task = dataclasses.replace(run.task, scene=scene)
    run.model = run.model_of(run.task, worlds=1)
    assert found[0].item() == pytest.approx(losses(run).item(), rel=1e-5) and abs(found[0] - found[1]) > 1e-6


def test_an_environment_has_the_trained_body(finished):
    """With observer and body of the run, the policy has the loss of the episode; the scene's body has another."""
    out, _ = finished
    run, found = softmpm_learn.load(out, device="cpu"), []
    for body in (run.design(), None):
        env = SoftRobotEnv(
            run.task, EnvConf(observer=lambda task, model: run.observer, body=body, device="cpu")
        )
        features, info = env.reset()
        for step in range(run.task.control_steps):
            time = torch.tensor(step * run.task.control_period)
            with torch.no_grad():
                (action,) = run.policy(torch.as_tensor(features)[None], time, None)
            features, *_, info = env.step(action.numpy())
        found.append(info["loss"])
    want = losses(run).item()
    assert found[0] == pytest.approx(want, rel=1e-5) and abs(found[1] - want) > 1e-4 * abs(want)


def test_what_is_no_run_is_refused(finished, tmp_path):
    """An empty folder, one of runs of several tasks, one without a checkpoint, one of several seeds, one of a robot that is not
    registered, a damaged checkpoint."""
    out, _ = finished
    with pytest.raises(ValueError, match="there is no config.yaml in it"):
        softmpm_learn.load(tmp_path)
    other = tmp_path / "outputs" / "arm" / "today"
    other.mkdir(parents=True)
    (other / "config.yaml").touch()
    with pytest.raises(ValueError, match=f"outputs holds no run: .*; the latest run in it is {other}."):
        softmpm_learn.load(tmp_path / "outputs")
    text = (out / "config.yaml").read_text()
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"must have a checkpoint.pt, and has none\.$"):
        softmpm_learn.load(tmp_path)
    (tmp_path / "config.yaml").write_text(text.replace("seeds: 1", "seeds: 2"))
    with pytest.raises(ValueError, match=r"each seed has one: load .*seed_…"):
        softmpm_learn.load(tmp_path)
    own = text.replace("name: biped", "name: hopper").replace("files: []", "files: [/robots/hopper.py]")
    (tmp_path / "config.yaml").write_text(own)
    with pytest.raises(
        ValueError, match=r"'hopper' .* registered by a file: .*hopper.py .* program imports that file before"
    ):
        softmpm_learn.load(tmp_path)
    (tmp_path / "config.yaml").write_text(text)
    (tmp_path / "checkpoint.pt").write_bytes(b"nothing")
    with pytest.raises(checkpoint.CheckpointError, match="is damaged"):
        softmpm_learn.load(tmp_path)


def test_the_code_of_the_page_runs(finished, tmp_path, monkeypatch, capsys):
    """Each block alone: the first one leaves a film, the second one ends with the loss of the episode."""
    out, _ = finished
    monkeypatch.chdir(tmp_path)
    shutil.copytree(out, "outputs/walk")
    blocks = [
        b for b in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL) if "learn.load(" in b
    ]
    for code in blocks:
        exec(code, {})
    assert len(blocks) == 2 and Path("walk.gif").stat().st_size > 1000
    said = capsys.readouterr().out
    assert f"loss {losses(softmpm_learn.load(out, device='cpu')).item():.4f}" in said
