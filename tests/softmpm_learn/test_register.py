"""Robots, observers, policies and optimisers of one's own: written as on docs/robots.md, run by one command, refused in a sentence."""

import csv
import dataclasses
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from textwrap import dedent

import forked
import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from PIL import Image, ImageDraw

import softmpm
from softmpm_learn import plugins, register
from softmpm_learn.command import app
from softmpm_learn.observe import Latent, VelocityImage, latent
from softmpm_learn.policy import make_policy
from softmpm_learn.register import POLICIES, TABLES, TASKS
from softmpm_learn.runs.run import Run
from softmpm_learn.settings import ObserverConf, OptimizerConf, PolicyConf, Settings
from softmpm_learn.tasks import TaskConf, make_task

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "robots.md").read_text()
LOOK, JUMPER, HOPPER, PARTS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
(END,) = (dedent(text) for text in re.findall(r"^    if __name__.*?(?=^\S)", PAGE, re.DOTALL | re.MULTILINE))
TINY = [
    *("experiment=smoke", "task.seconds=0.05", "task.control_period=0.025", "device=cpu"),
    *("learning.epochs=1", "train.iterations=2", "train.record_every=0", "train.examine=false"),
    "train.pictures=false",
]

OWN = """import torch
from softmpm_learn import register

class Own(torch.nn.Linear):
    def forward(self, z, time, goal=None):
        return self.mixed(torch.tanh(super().forward(z)))

    def mixed(self, a):
        return a @ torch.ones(3, 4)

@register.policy("own")
def own(conf, space):
    return Own(space.features, space.muscles)
"""


@pytest.fixture(autouse=True)
def fresh_tables(monkeypatch):
    """What a test registers is forgotten after it."""
    for table in TABLES:
        monkeypatch.setattr(table, "_entries", dict(table._all()))
    monkeypatch.setattr(plugins, "loaded", [])
    monkeypatch.setattr(sys, "path", sys.path[:])


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "hopper.py").write_text(HOPPER)
    (tmp_path / "parts.py").write_text(PARTS)
    return tmp_path


def run(folder, *words, python=("-m", "softmpm_learn")):
    """``python -m softmpm_learn WORDS`` in a process that has registered nothing yet."""
    return forked.python(*python, *words, folder=folder)


def iterations(folder) -> int:
    with open(folder / "metrics.csv", newline="") as file:
        return len(list(csv.DictReader(file)))


def refusal(done) -> str:
    assert done.returncode == 1, done.stderr
    said = done.stderr.strip().splitlines()
    assert len(said) == 1 and said[0].startswith("softmpm_learn: "), done.stderr
    return said[0]


def draw(path):
    """A robot with two legs, which are its muscles."""
    pen = ImageDraw.Draw(drawing := Image.new("RGB", (60, 40), "white"))
    pen.rectangle((0, 0, 59, 19), fill="#808080")
    for left, colour in ((5, "#ff0000"), (40, "#0000ff")):
        pen.rectangle((left, 20, left + 14, 39), fill=colour)
    drawing.save(path)


def test_a_robot_of_a_picture_is_shown(tmp_path, monkeypatch):
    """By the lines of the page, in a folder with the picture."""
    monkeypatch.chdir(tmp_path)
    draw(tmp_path / "robot.png")
    exec(LOOK, {})
    with Image.open(tmp_path / "scene.png") as picture:
        assert picture.width > 300


def test_a_robot_of_a_picture_takes_another_objective(folder):
    """The jumper of the page trains: its height is a column of metrics.csv, and nothing of a walk is left."""
    (folder / "jumper.py").write_text(JUMPER)
    draw(folder / "robot.png")
    words = ("jumper.py", "task=jumper", "task.file=robot.png", *TINY, "task.at=0.02", "hydra.run.dir=run")
    done = run(folder, *words)
    assert done.returncode == 0, done.stderr
    with open(folder / "run" / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 and {"jump", "effort", "stretch"} < set(rows[0]) and "progress" not in rows[0]
    assert -0.01 < float(rows[0]["jump"]) < 0.01


def test_a_task_of_a_stranger_trains_and_goes_on(folder):
    """One command trains it; resuming needs the file and says so, with a command that works from another folder."""
    done = run(folder, "hopper.py", "task=hopper", "task.width=0.1", *TINY, "hydra.run.dir=run")
    assert done.returncode == 0, done.stderr
    assert iterations(folder / "run") == 2 and "width: 0.1" in (folder / "run" / "config.yaml").read_text()
    said = refusal(run(folder, "resume=run"))
    assert "the task 'hopper' of the run in run was registered by a file" in said
    command = re.search(r"python (-m softmpm_learn hopper\.py resume=run)", said)
    assert command, said
    done = run(folder, *command[1].split()[2:], "train.iterations=3")
    assert done.returncode == 0, done.stderr
    assert iterations(folder / "run") == 3


def test_an_observer_and_an_optimiser_of_a_stranger_train(folder):
    """On a robot of the package; options are set by name."""
    words = ("observer=height", "observer.options.scale=0.02", "optimizer=rmsprop", "policy=linear")
    done = run(folder, "parts.py", "task=biped", *words, *TINY, "hydra.run.dir=run")
    assert done.returncode == 0, done.stderr
    saved = (folder / "run" / "config.yaml").read_text()
    assert iterations(folder / "run") == 2 and "scale: 0.02" in saved and "alpha: 0.99" in saved
    assert "the observer 'height'" in refusal(run(folder, "resume=run"))


def test_a_policy_of_a_stranger_trains_from_their_own_program(folder):
    """``softmpm_learn.main()`` is the command line; names of the program are resumed with it as a file."""
    (folder / "mine.py").write_text(f"{PARTS}\n\n{END}")
    words = ("task=biped", "observer=centroids", "policy=spring", "policy.options.gain=0.3", *TINY)
    done = run(folder, *words, "hydra.run.dir=run", python=("mine.py",))
    assert done.returncode == 0, done.stderr
    assert iterations(folder / "run") == 2
    assert "python -m softmpm_learn mine.py resume=run" in refusal(run(folder, "resume=run"))
    assert "spring" in run(folder, "--help", python=("mine.py",)).stdout


def test_what_a_stranger_adds_has_the_tasks_hints(tmp_path):
    """The learning rate of another optimiser and the influence of another learned observer are those of the task."""
    register.observer("seen")(lambda conf, model, task: latent(conf, model, task))
    register.optimizer("rmsprop")(lambda groups: torch.optim.RMSprop(groups))
    task = dataclasses.replace(make_task(TASKS["biped"].kind(seconds=0.05)), rate=0.007, feature_gain=0.4)
    settings = Settings(observer=ObserverConf(name="seen"), optimizer=OptimizerConf(name="rmsprop"))
    run = Run(task, softmpm.build(task.scene, device="cpu", **task.build), settings, tmp_path)
    assert run.settings.policy.feature_gain == 0.4 and run.settings.optimizer.policy_rate == 0.007
    assert run.optimizer.param_groups[0]["lr"] == 0.007


def test_an_encoder_that_learning_phases_cannot_train_is_refused(tmp_path):
    """It is named before anything runs."""
    register.observer("odd")(
        lambda conf, model, task: Latent(VelocityImage(model, conf.nodes), torch.nn.Flatten(), 2)
    )
    task = make_task(TASKS["biped"].kind(seconds=0.05))
    settings = Settings(observer=ObserverConf(name="odd"))
    with pytest.raises(
        TypeError, match="encoder of observer 'odd' must be .*Autoencoder.* got Flatten; derive"
    ):
        Run(task, softmpm.build(task.scene, device="cpu", **task.build), settings, tmp_path)


def test_help_lists_what_files_register(folder):
    """After the text that comes without files."""
    said = run(folder, "hopper.py", "parts.py", "--help").stdout
    assert said.startswith("softmpm_learn: a soft robot learns to move")
    assert re.search(r"task +hopper\n +observer +height\n +policy +spring\n +optimizer +rmsprop", said)
    assert "Registered by" not in run(folder, "--help").stdout


@pytest.mark.parametrize(
    "words, says",
    [
        (("nothing.py", "task=hopper"), "there is no file .*nothing.py"),
        (("broken.py",), r"broken.py, line 2: ZeroDivisionError: division by zero"),
        (("torn.py",), "torn.py, line 1: SyntaxError"),
        (("eager.py",), r'eager.py calls softmpm_learn.main\(\) when it is imported; write if __name__'),
        (("task=hopper",), r"no task called hopper; choose .*needs its file: python -m softmpm_learn FILE.py task=hopper"),
        (("parts.py", "policy=spring", "+policy.options.gian=1"), "no setting policy.options.gian; policy spring has gain"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_in_a_sentence(folder, monkeypatch, capsys, words, says):
    """Files that are missing, raise, are no Python or start a run when imported; names and options that nobody registered."""
    (folder / "broken.py").write_text("x = 1\nx / 0\n")
    (folder / "torn.py").write_text("def\n")
    (folder / "eager.py").write_text("import softmpm_learn\nsoftmpm_learn.main()\n")
    monkeypatch.chdir(folder)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    files, words = plugins.split(words)
    quiet = ["hydra/job_logging=none", "hydra/hydra_logging=none"]
    monkeypatch.setattr(sys, "argv", ["softmpm_learn", *words, "hydra.run.dir=run", *quiet])
    GlobalHydra.instance().clear()
    with pytest.raises(SystemExit) as stop:
        app.main(own=files)
    GlobalHydra.instance().clear()
    (said,) = capsys.readouterr().err.splitlines()
    assert stop.value.code == 1 and said.startswith("softmpm_learn: ") and re.search(says, said)


def test_an_entry_point_is_imported_once(folder, monkeypatch):
    """A package that names its module in the group is loaded; one that raises is named."""
    from importlib.metadata import EntryPoint

    monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr(plugins, "_packages", set())
    points = [EntryPoint("parts", "parts", "softmpm_learn")]
    monkeypatch.setattr(plugins, "entry_points", lambda group: points if group == "softmpm_learn" else [])
    assert plugins.has_packages()
    plugins.load_packages()
    plugins.load_packages()
    assert POLICIES.added == ["spring"]
    points.append(EntryPoint("none", "module_that_is_not_there", "softmpm_learn"))
    with pytest.raises(
        ValueError, match="entry point none = 'module_that_is_not_there' .* cannot be imported"
    ):
        plugins.load_packages()


def test_files_of_one_name_do_not_replace_each_other(folder):
    """Those of other folders are other files: what the second registers is taken."""
    for place in ("a", "b"):
        (folder / place).mkdir()
        (folder / place / "parts.py").write_text(PARTS)
    plugins.load(folder / "a" / "parts.py")
    with pytest.raises(ValueError, match="b/parts.py, line .* is registered already, by"):
        plugins.load(folder / "b" / "parts.py")


def test_a_taken_name_is_refused():
    """Also one of the package; the same function may come again, as in a notebook."""
    for _ in range(2):

        @register.policy("cpg")
        def cpg(conf, space): ...

    def other(conf, space): ...

    with pytest.raises(ValueError, match=r"'cpg' is registered already, by .*cpg; choose another name"):
        register.policy("cpg")(other)
    with pytest.raises(ValueError, match="policy 'mlp' is registered already"):
        register.policy("mlp")(other)
    with pytest.raises(ValueError, match="letters, digits and underscores, got 'my-policy'"):
        register.policy("my-policy")(other)


@pytest.mark.parametrize(
    "kind, build, says",
    [
        ("policy", lambda conf: None, r"policy 'mine' must take \(conf, space\)"),
        ("policy", lambda conf, space, seed: None, "also needs seed: give options a default"),
        ("observer", lambda model, task: None, r"must take \(conf, model, task\)"),
        ("optimizer", lambda: None, r"must take \(groups\)"),
    ],
)
def test_another_signature_is_refused(kind, build, says):
    """Where it is registered, with the arguments that it must take."""
    with pytest.raises(ValueError, match=says):
        getattr(register, kind)("mine")(build)


def test_options_may_be_a_dataclass():
    """Their types are checked, and the builder has an object of the class."""

    @dataclass
    class Options:
        size: float = 1.0
        names: list[str] | None = None

    @register.policy("typed", Options)
    def typed(conf, space, *, options):
        layer = torch.nn.Linear(space.features, space.muscles)
        torch.nn.init.constant_(layer.weight, options.size)
        return layer

    policy = make_policy(PolicyConf(name="typed", options={"size": 2}), 3, 2, 1.0, seed=0)
    assert policy.weight.shape == (2, 3) and bool((policy.weight == 2.0).all())
    with pytest.raises(ValueError, match=r"policy\.options\.size: Value 'much'"):
        make_policy(PolicyConf(name="typed", options={"size": "much"}), 3, 2, 1.0, seed=0)
    with pytest.raises(ValueError, match=r"no setting policy\.options\.weight; policy typed has size, names"):
        make_policy(PolicyConf(name="typed", options={"weight": 1}), 3, 2, 1.0, seed=0)
    with pytest.raises(ValueError, match=r"must take \(conf, space, \*, options\)"):
        register.policy("untyped", Options)(lambda conf, space: None)
    with pytest.raises(ValueError, match="no setting policy.options.size; policy mlp has no options"):
        make_policy(PolicyConf(options={"size": 2}), 3, 2, 1.0, seed=0)


def test_settings_of_a_task_are_a_dataclass_of_tasks():
    """With the registered name and a default for every field; what the decorator was forgotten on has neither."""

    class Bare(TaskConf):
        name: str = "bare"

    @dataclass(kw_only=True)
    class Other(TaskConf):
        name: str = "other"

    @dataclass(kw_only=True)
    class Needy(TaskConf):
        length: float
        name: str = "needy"

    for name, kind in (("bare", Bare), ("mine", Other), ("needy", Needy), ("mine", ObserverConf)):
        with pytest.raises(ValueError, match=f"the settings of task {name!r} must be a @dataclass"):
            register.task(name, kind)


def test_a_builder_that_returns_something_else_is_refused():
    """By the name of what it is."""
    register.policy("nothing")(lambda conf, space: None)
    with pytest.raises(ValueError, match="policy nothing must be a torch.nn.Module, got NoneType"):
        make_policy(PolicyConf(name="nothing"), 3, 2, 1.0, seed=0)


def test_an_error_in_a_file_of_one_s_own_has_its_line(folder):
    """Any error of PyTorch looks alike; the traceback is named too."""
    (folder / "own.py").write_text(OWN)
    done = run(folder, "own.py", "task=arm", "policy=own", *TINY, "hydra.run.dir=run")
    assert done.returncode == 1 and "cannot be multiplied" in done.stderr
    assert "(RuntimeError in own.py, line 9)" in done.stderr and "The traceback is in" in done.stderr
    assert "in mixed" in (folder / "run" / "error.txt").read_text()
