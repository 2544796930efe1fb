"""The command line: what it accepts, how it refuses, what a run leaves behind, and that it can go on."""

import csv
import logging
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir

import softmpm
import softmpm_learn
from softmpm_learn import plugins
from softmpm_learn.__main__ import help_text
from softmpm_learn.command import app, experiment, farewell
from softmpm_learn.command.sentences import sentence
from softmpm_learn.config import DeviceConf, RunConf, check_keys, conf_dir, to_run
from softmpm_learn.distributed import Group
from softmpm_learn.register import CHOICES
from softmpm_learn.runs.saved import load, save
from softmpm_learn.storage import checkpoint
from softmpm_learn.tasks import ArmConf, Resolution, make_task

pytestmark = pytest.mark.usefixtures("fresh_hydra")

ROOT = Path(__file__).parents[3]
TINY = [  # the smallest run that has every phase
    *("task=arm", "experiment=smoke", "task.seconds=0.05", "task.control_period=0.025", "device=cpu"),
    *("learning.epochs=1", "learning.batches=1", "train.iterations=2", "train.examine=false"),
]
LEFT = (
    *("config.yaml", "metrics.csv", "timing.csv", "run.h5", "run.rrd", "checkpoint.pt"),
    *("loss.png", "latent.png", "robot.png"),
)


def composed(*overrides):
    app.register()
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        return compose("config", list(overrides))


@pytest.mark.parametrize(
    "word, read",
    [
        *(
            ("optimizer.fade=.inf", "optimizer.fade=inf"),
            ("optimizer.fade=0.1,.inf", "optimizer.fade=0.1,inf"),
        ),
        *(
            ("optimizer.restart_above=-.Inf", "optimizer.restart_above=-inf"),
            ("task.file=a.inf", "task.file=a.inf"),
        ),
        *(("resume=./x.inf", "resume=./x.inf"), ("-m", "-m")),
    ],
)
def test_infinity_may_be_written_as_in_yaml(word, read):
    """As a file of settings has it, so that what config.yaml says can be given on the command line."""
    assert app.with_infinity(word) == read


def commands_of(page: Path) -> list[list[str]]:
    """Settings of each command of a page, of a list of values the first; without the commands for files of one's own."""
    text = page.read_text().replace("\\\n", " ")
    found = [shlex.split(line) for line in re.findall(r"python -m softmpm_learn ([^`\n]*)", text)]
    found = [
        words
        for words in found
        if not any(re.search(r"\.py$|^--|resume=|SETTINGS|train.log", w) for w in words)
    ]
    return [[re.sub(r"^([^=\[]*=[^,\[]*),.*", r"\1", w) for w in words if w != "-m"] for words in found]


PAGES = [page for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))) if commands_of(page)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_commands_of_the_pages_are_accepted(page):
    """Each setting exists, and has a value of its type."""
    for words in commands_of(page):
        to_run(composed(*words))


def refusal(monkeypatch, capsys, *overrides) -> str:
    """Message of ``python -m softmpm_learn`` on stderr when it ends with exit code 1."""
    with pytest.raises(SystemExit) as stop:
        main(monkeypatch, *overrides)
    assert stop.value.code == 1
    said = capsys.readouterr().err
    assert said.startswith("softmpm_learn: ") and said.count("\n") == 1, said
    return said.removeprefix("softmpm_learn: ").strip()


def main(monkeypatch, *overrides) -> None:
    """``python -m softmpm_learn`` in this process; Hydra leaves the logging alone."""
    quiet = ["hydra/job_logging=none", "hydra/hydra_logging=none"]
    monkeypatch.setattr(sys, "argv", ["softmpm_learn", *overrides, *quiet])
    app.main()


def test_gradients_need_not_fade(monkeypatch, capsys):
    """``optimizer.fade=.inf`` is a setting of the command line, and is printed as it was written."""
    monkeypatch.setattr(sys, "argv", ["softmpm_learn", "optimizer.fade=.inf", "--cfg", "job"])
    app.main()
    assert "fade: .inf" in capsys.readouterr().out
    assert to_run(composed("optimizer.fade=inf")).optimizer.fade == float("inf")


def test_a_robot_of_another_law_learns(monkeypatch, tmp_path):
    """One iteration through the barrier law leaves a finite loss and a row."""
    words = (
        "task.law=barrier_corotated",
        "train.iterations=1",
        "train.pictures=false",
        "train.record_every=0",
    )
    main(monkeypatch, *TINY, *words, f"hydra.run.dir={tmp_path}")
    with open(tmp_path / "metrics.csv", newline="") as file:
        (row,) = csv.DictReader(file)
    assert 0.0 < float(row["loss"]) < float("inf")
    assert "law: barrier_corotated" in (tmp_path / "config.yaml").read_text()


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder with a run of two iterations, and what it said."""
    folder = tmp_path_factory.mktemp("run")
    said = []
    keep = logging.Handler()
    keep.emit = lambda record: said.append(record.getMessage())
    experiment.logger.addHandler(keep)
    experiment.logger.setLevel(logging.INFO)
    conf = to_run(composed(*TINY))
    experiment.run_experiment(conf, folder)
    experiment.logger.removeHandler(keep)
    return folder, "\n".join(said)


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


# What it accepts


def test_the_default_is_the_elephant_with_a_learned_latent():
    """``python -m softmpm_learn`` runs the loop of the workshop paper with all three refinements and co-design."""
    conf = to_run(composed())
    assert conf.task.name == "elephant" and conf.observer.name == "latent" and conf.design.enabled
    assert conf.learning.replay and conf.learning.early_stopping and conf.learning.target_network


GROUPS = [
    (group.name, option.stem)
    for group in sorted(Path(conf_dir()).iterdir())
    if group.is_dir()
    for option in sorted(group.glob("*.yaml"))
]


@pytest.mark.parametrize(("group", "option"), GROUPS)
def test_every_choice_composes_and_is_in_the_help(group, option):
    """Each file of ``conf/`` is valid by itself, is named in the help, and sets what its name says."""
    conf = to_run(composed(f"{group}={option}"))
    described = (Path(conf_dir()) / "config.yaml").read_text().partition("template:")[2]
    line = next(line for line in described.splitlines() if line.strip().startswith(group + " "))
    assert option in line.replace(",", " ").split()
    if group in ("task", "observer", "policy", "optimizer", "device"):
        assert getattr(conf, group).name == option


@pytest.mark.parametrize("table", CHOICES, ids=lambda table: table.what)
def test_every_choice_has_its_file(table):
    """Each table of the package and its folder in ``conf/`` have the same names."""
    assert {path.stem for path in (Path(conf_dir()) / table.what).glob("*.yaml")} == set(table)


def test_the_learning_rate_is_the_tasks_unless_it_is_chosen():
    """Walkers learn faster than the arm; plain gradient descent has a rate of its own."""

    def rate(*words):
        conf = to_run(composed(*words))
        return conf.settings.suited(make_task(conf.task), encoded=False).optimizer.policy_rate

    rates = {
        words: rate(*words)
        for words in [
            ("task=elephant",),
            ("task=arm",),
            ("task=elephant", "optimizer.policy_rate=0.02"),
            ("task=arm", "optimizer=sgd"),
        ]
    }
    assert list(rates.values()) == [1e-2, 5e-3, 2e-2, 0.1]


def test_plain_settings_reach_the_run():
    """A value on the command line is that value in the settings, of its own type."""
    conf = to_run(composed("task=arm", "task.resolution=fine", "train.seed=7", "task.goal=[0.5,0.3]"))
    assert isinstance(conf.task, ArmConf) and conf.task.resolution is Resolution.fine
    assert conf.settings.train.seed == 7 and conf.task.goal == [0.5, 0.3]


def test_a_saved_configuration_reads_back(tmp_path):
    """``config.yaml`` of a run gives the very same settings again."""
    conf = to_run(composed("task=biped", "task.young=4e4", "policy=linear", "learning=plain", "device=cpu"))
    save(conf, tmp_path)
    assert load(tmp_path) == conf


def test_help_is_worth_reading(monkeypatch, capsys):
    """It shows how to run, resume and sweep, what can be chosen, and what a run leaves."""
    monkeypatch.setattr(sys, "argv", ["softmpm_learn", "--help"])
    with pytest.raises(SystemExit) as stop:
        app.main()
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for word in ("python -m softmpm_learn task=arm", "resume=", "-m train.seed=0,1,2", *LEFT):
        assert word in text
    assert "src/" not in text and text.strip().endswith("python -m softmpm_learn task=elephant --cfg job")
    assert "_schema" not in text and max(map(len, text.splitlines())) <= 110
    assert text.strip() == help_text().strip()


def test_help_does_not_wait_for_pytorch():
    """The text comes without the imports that take seconds."""
    code = (
        "import runpy, sys\n"
        "sys.argv = ['softmpm_learn', '--help']\n"
        "runpy.run_module('softmpm_learn', run_name='__main__')\n"
        "sys.exit(bool({'torch', 'warp', 'softmpm', 'hydra'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("softmpm_learn: a soft robot learns to move")


# How it refuses


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("task=elefant", "there is no task called elefant; choose one of arm, biped, elephant, image, mesh, voxels."),
        ("task.sekonds=3", "there is no setting task.sekonds; did you mean task.seconds?"),
        ("tsk=arm", "there is no setting tsk; did you mean task?"),
        ("optimizer.options.betas=[0.9,0.99]", "write +optimizer.options.betas=VALUE to add it."),
        ("train.iterations=1.5", "train.iterations: Value '1.5' of type 'float' could not be converted"),
        ("design.young=perhaps", "design.young: Value 'perhaps' is not a valid bool"),
        ("task.resolution=huge", "task.resolution: Invalid value 'huge', expected one of [draft, standard, fine]."),
        ("train.goal_spread=0.05", "train.goal_spread must be a list, got 0.05: write \"train.goal_spread=[0.05]\", with a"),
        ("train.log=wandb", "train.log must be a list, got wandb: write \"train.log=[wandb]\", with a comma between"),
        ("task.goal=[1", "cannot read 'task.goal=[1': write key=value"),
        ("resume=nowhere", "nowhere holds no run: there is no config.yaml in it."),
        ("experiment=nope", "there is no experiment called nope; choose one of comparison, smoke."),
    ],
)  # fmt: skip
def test_a_wrong_word_ends_in_one_sentence(monkeypatch, capsys, tmp_path, override, sentence):
    """Misspelt keys and choices, wrong types and unreadable words: one line, exit code 1, nothing left behind."""
    monkeypatch.chdir(tmp_path)
    assert sentence in refusal(monkeypatch, capsys, override)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("--iterations 5", "there is no flag --iterations: settings are words such as train.iterations=5; --help lists them."),
        ("task=arm --train.iterations=5", "there is no flag --train.iterations=5: settings are words"),
        ("task=arm --cfg job train.seed=1", "settings must follow each other: write train.seed=1 before the flags."),
        ("--cfg every", "argument --cfg/-c: invalid choice: 'every'"),
    ],
)  # fmt: skip
def test_a_flag_that_hydra_lacks_ends_in_one_sentence(monkeypatch, capsys, words, sentence):
    """In place of Hydra's usage."""
    monkeypatch.setattr(sys, "argv", ["softmpm_learn", *words.split()])
    with pytest.raises(SystemExit) as stop:
        app.main()
    said = capsys.readouterr().err
    assert stop.value.code == 1 and said.startswith(f"softmpm_learn: {sentence}") and said.count("\n") == 1


@pytest.mark.parametrize("key", ["foo", "task.foo", "train.foo", "policy.foo.bar"])
def test_a_key_that_is_not_in_the_schema_is_refused(key):
    """Hydra lets ``+key=value`` pass; the schema does not."""
    config = composed(f"+{key}=1")
    with pytest.raises(ValueError, match="there is no setting "):
        to_run(config)
    check_keys(composed("train.seed=1"))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["task.seconds=-1"], "task.seconds must be > 0"),
        (["design.young_factor=[3,1]"], "design.young_factor must be"),
        (["device.threads=0"], "device.threads must be at least 1"),
        (["device.dtype=float16"], "device.dtype must be one of float32, float64"),
        (["device.memory=-1"], "device.memory must be > 0 MB or null"),
        (["device.name=tpu"], "device.name must be one of auto, cpu, cuda"),
        (
            ["~task"],
            "choose a task: task=elephant, task=arm, task=biped, task=image, task=mesh, task=voxels.",
        ),
    ],
)
def test_a_wrong_value_says_what_must_hold(overrides, message):
    """Ranges are checked when the settings are made."""
    with pytest.raises(ValueError, match="^" + message.replace(".", r"\.").replace("=", "=")):
        to_run(composed(*overrides))


def test_a_setting_that_no_resumed_run_may_have_is_named(monkeypatch, capsys, finished):
    """Also if the default task has none of this name."""
    said = refusal(monkeypatch, capsys, f"resume={finished[0]}", "task.file=robot.png")
    assert said.startswith("a run is resumed with its own settings") and "may change, not task.file." in said


def test_a_fault_of_the_program_is_called_so():
    """Errors that are not meant for people give their type; messages of several lines become one, and notes follow."""
    assert sentence(KeyError("x")) == "KeyError: 'x' (a fault of the program)."
    assert sentence(RuntimeError("first\n  second")) == "first second."
    assert sentence(RuntimeError()) == "no details."
    broken = "[gloo/transport/tcp/pair.cc:553] Connection closed by peer [127.0.0.1]:48860."
    assert sentence(RuntimeError(broken)).startswith("another process of this run has ended; its own message")
    noted = RuntimeError("No memory.")
    noted.add_note("Buy some")
    assert sentence(noted) == "No memory. Buy some."


def test_too_little_memory_names_the_settings_that_help(tmp_path):
    """This holds if the device is full, and if the simulator's budget is."""
    full = sentence(torch.OutOfMemoryError("CUDA out of memory."))
    assert full.startswith("CUDA out of memory. Settings for that: train.worlds") and "device.memory" in full
    with pytest.raises(ValueError, match="memory_budget is 1,000 bytes") as refused:
        experiment.run_experiment(to_run(composed(*TINY, "device.memory=0.001")), tmp_path)
    assert "device.memory" in sentence(refused.value)


def test_cuda_without_a_gpu_is_refused_in_a_sentence(monkeypatch, capsys, tmp_path):
    """``device=cuda`` never falls back silently; the traceback of a failed run is in its folder."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    said = refusal(monkeypatch, capsys, *TINY, "device=cuda", f"hydra.run.dir={tmp_path}/run")
    assert said.startswith("device 'cuda' was asked for")
    assert "Traceback" in (tmp_path / "run" / "error.txt").read_text()


# What a run leaves, and going on


def test_a_run_leaves_everything(finished):
    """All files are there and not empty; the last line is the command that opens the recording."""
    folder, said = finished
    for name in LEFT:
        assert (folder / name).stat().st_size > 0, name
    assert len(rows(folder / "metrics.csv")) == 2
    assert said.splitlines()[-1].endswith(f"rerun {folder / 'run.rrd'}")
    assert "after 2 of 2 iterations: loss" in said and "mm from the goal" in said
    assert "2 calls of 52 substeps with gradient" in said  # which share the memory
    assert said.index("after 2 of 2") < said.index("The run took") < said.index("mm from the goal")
    with softmpm.Recording(folder / "run.h5") as recording:
        assert len(recording.episodes) == 3  # both iterations and the best once more


def test_a_folder_with_a_run_is_not_overwritten(monkeypatch, capsys, finished):
    """A second run into the same folder is refused and says how to go on."""
    folder, _ = finished
    before = (folder / "metrics.csv").read_bytes()
    said = refusal(monkeypatch, capsys, *TINY, f"hydra.run.dir={folder}")
    assert f"holds a run already; go on with resume={folder}" in said
    assert (folder / "metrics.csv").read_bytes() == before


def test_the_latest_run_in_a_folder_is_named(monkeypatch, capsys, tmp_path):
    """Where a folder of runs is to be resumed in place of one of them."""
    for name in ("2026-01-02_09-00-00", "2026-01-03_09-00-00", "notes"):
        (tmp_path / name).mkdir()
    for name, when in (("2026-01-02_09-00-00", 2e9), ("2026-01-03_09-00-00", 1e9)):
        (tmp_path / name / "config.yaml").touch()
        os.utime(tmp_path / name / "config.yaml", (when, when))
    said = refusal(monkeypatch, capsys, f"resume={tmp_path}")
    assert said.endswith(
        f"there is no config.yaml in it; the latest run in it is {tmp_path}/2026-01-02_09-00-00."
    )


@pytest.mark.parametrize("name", ["plain-1.0", "my runs", "läufe", "Bob's (2), [3]"])
def test_the_command_that_resumes_can_be_pasted(name, monkeypatch, capsys, tmp_path):
    """Into a shell, whatever the name of the folder."""
    (tmp_path / name).mkdir()
    (argument,) = shlex.split(plugins.resume(tmp_path / name))
    assert f"{tmp_path / name} holds no run" in refusal(monkeypatch, capsys, argument)


def test_resume_goes_on_with_the_run_s_own_settings(monkeypatch, tmp_path, finished):
    """Two iterations and one more give the metrics of three in one go, to the last bit."""
    shutil.copytree(finished[0], tmp_path / "run")
    more = ("train.iterations=3", "train.pictures=false")
    main(monkeypatch, f"resume={tmp_path}/run", *more)
    main(monkeypatch, *TINY, *more, f"hydra.run.dir={tmp_path}/whole")
    resumed, whole = (rows(tmp_path / name / "metrics.csv") for name in ("run", "whole"))
    assert resumed == whole and len(whole) == 3
    assert load(tmp_path / "run").task.name == "arm"


def test_a_refused_resume_changes_nothing(monkeypatch, capsys, tmp_path, finished):
    """Refused for another precision, a package that is missing, or because another run is writing, the run continues unaffected."""
    shutil.copytree(finished[0], tmp_path / "run")
    before = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir() if path.is_file()}
    asked = (f"resume={tmp_path}/run", "train.iterations=9", "device.dtype=float64")
    assert "dtype: torch.float32 then, torch.float64 now" in refusal(monkeypatch, capsys, *asked)
    (tmp_path / "run" / "error.txt").unlink()
    with checkpoint.locked(tmp_path / "run"):
        assert "another run is writing" in refusal(monkeypatch, capsys, *asked)
    monkeypatch.setitem(sys.modules, "wandb", None)
    said = refusal(monkeypatch, capsys, *asked[:2], "train.log=[wandb]")
    assert 'pip install "softmpm[wandb]"' in said
    (tmp_path / "run" / "error.txt").unlink()
    assert before == {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir() if path.is_file()}


def test_the_words_about_the_best_are_about_the_best(finished):
    """Of a run that was stopped the last recorded episode is another one, of which the last lines say nothing."""
    task, best = make_task(load(finished[0]).task), softmpm_learn.load(finished[0]).best["iteration"]
    assert farewell._outcome(task, finished[0], best).startswith("; ")
    assert farewell._outcome(task, finished[0], best + 1) == ""


def test_the_objective_is_part_of_a_run(monkeypatch, capsys, tmp_path, finished):
    """A weight of the loss that was edited in config.yaml is refused: the numbers after it would be others."""
    shutil.copytree(finished[0], tmp_path / "run")
    path = tmp_path / "run" / "config.yaml"
    path.write_text(path.read_text().replace("effort: 1.0e-05", "effort: 0.5"))
    said = refusal(monkeypatch, capsys, f"resume={tmp_path}/run")
    assert "task.objective.terms[2].weight: 1e-05 then, 0.5 now" in said


def test_the_log_follows_the_run(monkeypatch, tmp_path, finished):
    """It holds what was said from the start, and what a resumed run says comes after that."""
    main(monkeypatch, *TINY, "train.pictures=false", f"hydra.run.dir={tmp_path}/run")
    first = (tmp_path / "run" / "softmpm_learn.log").read_text()
    assert first.startswith("softmpm model: 2D") and "after 2 of 2 iterations" in first
    main(monkeypatch, f"resume={tmp_path}/run", "train.iterations=3")
    log = (tmp_path / "run" / "softmpm_learn.log").read_text()
    assert log.startswith(first) and "of which 2 iterations are done" in log and "after 3 of 3" in log


def test_memory_is_for_a_whole_simulation():
    """The memory budget for its gradient is shared by all control steps."""
    conf = to_run(composed(*TINY, "device.memory=1"))
    model = experiment.make_model(make_task(conf.task), conf, Group())
    assert (model.budget, model.calls) == (1_000_000, 2)


@pytest.mark.parametrize("wanted", [True, False])
def test_determinism_reaches_simulator_and_networks(wanted):
    """``device.deterministic`` is that of the model, and of PyTorch while the run lasts."""
    conf = to_run(composed(*TINY, f"device.deterministic={wanted}"))
    assert experiment.make_model(make_task(conf.task), conf, Group()).deterministic is wanted
    before = torch.are_deterministic_algorithms_enabled()
    try:
        experiment.need_determinism(conf.device.deterministic)
        assert torch.are_deterministic_algorithms_enabled() is wanted
        assert not wanted or os.environ["CUBLAS_WORKSPACE_CONFIG"]
    finally:
        torch.use_deterministic_algorithms(before)


def test_a_deterministic_run_repeats_itself(monkeypatch, tmp_path):
    """A run with all parts takes no operation that PyTorch refuses, and gives the same metrics again."""
    try:
        for name in ("one", "two"):
            words = ("device.deterministic=true", "train.record_every=0", "train.pictures=false")
            main(monkeypatch, *TINY, *words, f"hydra.run.dir={tmp_path}/{name}")
    finally:
        torch.use_deterministic_algorithms(False)
    one, two = (rows(tmp_path / name / "metrics.csv") for name in ("one", "two"))
    assert one == two and load(tmp_path / "one").device.deterministic


@pytest.mark.gpu
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_deterministic_run_repeats_itself_on_a_gpu(monkeypatch, tmp_path, dtype):
    """Where sums are otherwise taken in any order; in float64 no graph is captured."""
    try:
        for name in ("one", "two"):
            words = (
                "device=cuda",
                "device.deterministic=true",
                f"device.dtype={dtype}",
                "train.iterations=4",
            )
            main(monkeypatch, *TINY, *words, f"hydra.run.dir={tmp_path}/{name}")
    finally:
        torch.use_deterministic_algorithms(False)
    one, two = (rows(tmp_path / name / "metrics.csv") for name in ("one", "two"))
    assert one == two


def test_pictures_may_be_left_out(tmp_path):
    """Neither while a run is recorded nor at its end is anything drawn; resumed with pictures, it is."""
    experiment.run_experiment(to_run(composed(*TINY, "train.pictures=false")), tmp_path)
    assert (tmp_path / "run.h5").exists() and not list(tmp_path.glob("*.png"))
    again = to_run(composed("train.pictures=true"))
    again.resume = str(tmp_path)
    conf = app.resumed(again, [f"resume={tmp_path}", "train.pictures=true"])
    experiment.run_experiment(conf, tmp_path)
    assert {path.name for path in tmp_path.glob("*.png")} == {"loss.png", "latent.png", "robot.png"}


def test_resume_changes_nothing_but_what_may_change(tmp_path):
    """Iterations, recording and device may differ; another key is refused by name."""
    old = RunConf(task=ArmConf(young=4e4))
    save(old, tmp_path)
    new = to_run(composed("task=elephant", "train.iterations=7", "device=cpu"))
    new.resume = str(tmp_path)
    conf = app.resumed(new, [f"resume={tmp_path}", "train.iterations=7", "device=cpu"])
    assert conf.task == old.task and conf.train.iterations == 7 and conf.device.name == "cpu"
    assert conf.resume is None and conf.train.seed == old.train.seed
    with pytest.raises(ValueError, match="may change, not train.seed"):
        app.check_words([f"resume={tmp_path}", "train.seed=3"])


@pytest.mark.parametrize("word, name, threads", [("device.threads=1", "cpu", 1), ("device=auto", "auto", 3)])
def test_resume_keeps_what_is_not_said_of_the_device(tmp_path, word, name, threads):
    """One setting of it, or its choice, changes no other."""
    device = DeviceConf(name="cpu", threads=3, dtype="float64", deterministic=True)
    save(RunConf(task=ArmConf(), device=device), tmp_path)
    new = to_run(composed(word))
    new.resume = str(tmp_path)
    device = app.resumed(new, [f"resume={tmp_path}", word]).device
    assert (device.name, device.threads, device.dtype, device.deterministic) == (
        name,
        threads,
        "float64",
        True,
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_at_start_up_is_answered(tmp_path, number):
    """While the program is imported, before Hydra or PyTorch is there: one sentence, and the exit code of the signal."""
    code = (
        "import os, runpy, signal, sys; sys.path.insert(0, sys.argv[1]); number = int(sys.argv[2])\n"
        "sys.addaudithook(lambda event, args: event == 'import' and args[0] == 'torch' and os.kill(os.getpid(), number))\n"
        "runpy.run_module('softmpm_learn', run_name='__main__')"
    )
    words = [sys.executable, "-c", code, str(ROOT / "src"), str(int(number))]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 128 + number and not list(tmp_path.iterdir())
    assert done.stderr == "softmpm_learn: interrupted. No iteration had begun, so nothing is lost.\n"


def test_ctrl_c_ends_cleanly_and_saves(tmp_path):
    """After SIGINT the iteration is finished and saved though none was due; exit code 0, and the last line says how to go on."""
    words = [sys.executable, "-m", "softmpm_learn", *TINY, "train.iterations=1000", "hydra.run.dir=run"]
    words.append("train.save_every=1000")
    process = subprocess.Popen(
        words,
        cwd=tmp_path,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    metrics, end = tmp_path / "run" / "metrics.csv", time.monotonic() + 120
    while not (metrics.exists() and metrics.read_text().count("\n") > 1):
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    done = len(rows(metrics))
    assert 1 <= done < 1000 and checkpoint.load(tmp_path / "run")["iteration"] == done
    assert f"Stopped after {done} iterations." in out
    assert out.rstrip().splitlines()[-1] == "To go on: python -m softmpm_learn resume=run"
    assert (tmp_path / "run" / "loss.png").exists()


def test_an_interruption_elsewhere_says_how_to_go_on(monkeypatch, capsys, tmp_path):
    """While pictures are drawn, or before anything began: one sentence, no traceback, and the exit code of an interruption."""

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(experiment, "draw", interrupted)
    for run, advice in (("run", f"resume={tmp_path}/run"), ("other", "No iteration had begun")):
        with pytest.raises(SystemExit) as caught:
            main(monkeypatch, *TINY, f"hydra.run.dir={tmp_path}/{run}")
        said = capsys.readouterr().err
        assert (
            caught.value.code == 130 and "interrupted." in said and advice in said and "Traceback" not in said
        )
        monkeypatch.setattr(app, "to_run", interrupted)


def test_without_rerun_the_recording_can_be_converted_later(monkeypatch, tmp_path):
    """Without rerun installed a run still ends well, and reports which command converts its recording elsewhere."""

    def missing(*_):
        raise ImportError("no rerun here")

    monkeypatch.setattr(softmpm, "to_rerun", missing)
    monkeypatch.chdir(tmp_path)
    said = farewell.convert(tmp_path / "out")
    assert said.startswith(f"python -m softmpm {Path('out') / 'run.h5'} && rerun {Path('out') / 'run.rrd'}")


def test_the_configuration_is_found_in_a_wheel(tmp_path):
    """A wheel holds ``conf/``, and its command line works away from the checkout."""
    pytest.importorskip("hatchling")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True, timeout=120)
    (wheel,) = tmp_path.glob("*.whl")
    unpack = [sys.executable, "-m", "zipfile", "-e", str(wheel), str(tmp_path / "site")]
    subprocess.run(unpack, check=True, timeout=60)
    assert (tmp_path / "site" / "softmpm_learn" / "conf" / "task" / "elephant.yaml").is_file()
    done = subprocess.run(
        [sys.executable, "-m", "softmpm_learn", "task=arm", "--cfg", "job"],
        cwd=tmp_path,
        env=environment() | {"PYTHONPATH": str(tmp_path / "site")},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0 and "name: arm" in done.stdout, done.stderr
