"""Tables of tasks, observers, policies, optimisers and loggers by name; users add theirs without editing the package (docs/robots.md).

    @softmpm_learn.register.task("hopper", HopperConf)
    def hopper(conf: HopperConf) -> Task: ...

    @softmpm_learn.register.observer("touch")
    def touch(conf: ObserverConf, model: Model, task: Task, *, radius: float = 0.02) -> Observer: ...

    @softmpm_learn.register.policy("cpg", CpgOptions)
    def cpg(conf: PolicyConf, space: Space, *, options: CpgOptions) -> nn.Module: ...

    @softmpm_learn.register.optimizer("lion")
    def lion(groups: list[dict], *, decay: float = 0.0) -> torch.optim.Optimizer: ...

    @softmpm_learn.register.logger("printer")
    def printer(out: Path, first: int, settings: Mapping[str, Any]) -> Logger: ...

What follows the ``*`` are options, from ``observer.options``, ``policy.options`` and ``optimizer.options`` of the settings: keywords
with defaults, or one dataclass, which also checks their types. Nothing heavy is imported here.
"""

import dataclasses
import importlib
import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, TypeVar

Builder = TypeVar("Builder", bound=Callable)
GROUP = "softmpm_learn"
"""Group of the entry points by which installed packages register theirs: each names a module, which registers when imported."""


class Entry(NamedTuple):
    """A registered name."""

    kind: type | None
    """Dataclass of a task's settings, or of the options of an observer, a policy or an optimiser; None for keywords."""
    build: Callable[..., Any]

    @property
    def is_own(self) -> bool:
        """True if the package itself registered it."""
        return str(self.build.__module__).split(".")[0] == GROUP


class Table(Mapping[str, Entry]):
    """Registered names of one kind, the package's own first.

    Args:
        what: Noun for messages, and group of the settings.
        arguments: Positional arguments of a builder.
        module: Module that registers the package's own.
    """

    def __init__(self, what: str, arguments: tuple[str, ...], module: str):
        self.what, self.arguments, self._module = what, arguments, module
        self._entries: dict[str, Entry] = {}

    def __getitem__(self, name: str) -> Entry:
        return self._all()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())

    @property
    def added(self) -> list[str]:
        """Names that users registered; imports nothing."""
        return [name for name, entry in self._entries.items() if not entry.is_own]

    def need(self, name: str, options: Mapping[str, Any]) -> None:
        """Raise ValueError unless the name is registered and has these options, of the right types."""
        if name not in self._all():
            raise ValueError(f"{self.what}.name must be one of {', '.join(self)}; got {name!r}.")
        self._checked(name, self[name], dict(options))

    def add(self, name: str, entry: Entry) -> None:
        """Register; the same function of the same module may come again, as in a notebook.

        Raises:
            ValueError: The name is taken or unfit, or the builder takes other arguments.
        """
        if not (isinstance(name, str) and name.isidentifier()):
            raise ValueError(
                f"the name of a {self.what} must be letters, digits and underscores, got {name!r}."
            )
        if not entry.is_own and name in self._all():
            before = self._entries[name].build
            if _origin(before) != _origin(entry.build):
                raise ValueError(
                    f"the {self.what} {name!r} is registered already, by {_words(before)}; choose another name, or give only one "
                    "of two files of which one imports the other."
                )
        self._check(name, entry)
        self._entries[name] = entry

    def build(self, name: str, options: Mapping[str, Any], *arguments: Any) -> Any:
        """Call the builder of a name with its options.

        Raises:
            ValueError: An option is unknown or has another type.
        """
        entry = self[name]
        return entry.build(*arguments, **self._checked(name, entry, dict(options)))

    def defaults(self, name: str) -> dict[str, Any]:
        """Options of a name with their defaults."""
        entry = self[name]
        if entry.kind is not None:
            return dataclasses.asdict(entry.kind())
        plain = (bool, int, float, str, list, tuple, dict, type(None))
        known = _keywords(entry.build)
        return {key: p.default for key, p in known.items() if isinstance(p.default, plain)}

    def _all(self) -> dict[str, Entry]:
        importlib.import_module(self._module)
        return self._entries

    def _check(self, name: str, entry: Entry) -> None:
        form = ", ".join(self.arguments) + (", *, options" if entry.kind and self.what != "task" else "")
        given = {} if entry.kind is None or self.what == "task" else {"options": None}
        try:
            inspect.signature(entry.build).bind_partial(*self.arguments, **given)
            missing = [
                key
                for key, p in list(inspect.signature(entry.build).parameters.items())[len(self.arguments) :]
                if p.default is p.empty
                and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
                and key not in given
            ]
        except TypeError as error:
            raise ValueError(
                f"the {self.what} {name!r} must take ({form}); {_words(entry.build)} does not: {error}."
            ) from error
        if missing:
            raise ValueError(
                f"the {self.what} {name!r} must take ({form}); {_words(entry.build)} also needs {', '.join(missing)}: "
                "give options a default."
            )

    def _checked(self, name: str, entry: Entry, options: dict[str, Any]) -> dict[str, Any]:
        where = f"{self.what}.options"
        if entry.kind is not None:
            known: list[str] = [field.name for field in dataclasses.fields(entry.kind)]
        else:
            known = list(_keywords(entry.build))
        unknown = [key for key in options if key not in known]
        if unknown and not (entry.kind is None and _takes_any(entry.build)):
            has = f"has {', '.join(known)}" if known else "has no options"
            raise ValueError(f"there is no setting {where}.{unknown[0]}; {self.what} {name} {has}.")
        if entry.kind is None:
            return options
        from omegaconf import OmegaConf
        from omegaconf.errors import OmegaConfBaseException

        try:
            typed = OmegaConf.merge(OmegaConf.structured(entry.kind), options)
        except OmegaConfBaseException as error:
            raise ValueError(f"{where}.{error.full_key}: {str(error).splitlines()[0]}") from error
        return {"options": OmegaConf.to_object(typed)}


TASKS = Table("task", ("conf",), "softmpm_learn.tasks")
OBSERVERS = Table("observer", ("conf", "model", "task"), "softmpm_learn.observe")
POLICIES = Table("policy", ("conf", "space"), "softmpm_learn.policy")
OPTIMIZERS = Table("optimizer", ("groups",), "softmpm_learn.optimizers")
LOGGERS = Table("logger", ("out", "first", "settings"), "softmpm_learn.loggers")
CHOICES = (TASKS, OBSERVERS, POLICIES, OPTIMIZERS)
"""Tables of which a run has one name each, in a group of the settings."""
TABLES = (*CHOICES, LOGGERS)


def task(name: str, kind: type) -> Callable[[Builder], Builder]:
    """Register a task: its settings, which derive from :class:`softmpm_learn.tasks.TaskConf`, and a builder conf → Task."""
    from softmpm_learn.tasks.task import TaskConf

    need = (
        f"the settings of task {name!r} must be a @dataclass(kw_only=True) that derives from TaskConf or WalkerConf, with "
        f'name: str = "{name}" and a default for every field; '
    )
    if not (isinstance(kind, type) and issubclass(kind, TaskConf)):
        raise ValueError(f"{need}got {getattr(kind, '__name__', kind)}.")
    try:
        own = kind().name  # pyright: ignore[reportCallIssue]
    except TypeError as error:
        raise ValueError(f"{need}{error}.") from error
    if own != name:
        raise ValueError(f"{need}{kind.__name__} has the name {own!r}.")
    return _decorator(TASKS, name, kind)


def observer(name: str, options: type | None = None) -> Callable[[Builder], Builder]:
    """Register an observer: a builder (conf, model, task) → :class:`softmpm_learn.observe.Observer`."""
    return _decorator(OBSERVERS, name, options)


def policy(name: str, options: type | None = None) -> Callable[[Builder], Builder]:
    """Register a policy: a builder (conf, space) → module, see :class:`softmpm_learn.policy.Space`."""
    return _decorator(POLICIES, name, options)


def optimizer(name: str, options: type | None = None) -> Callable[[Builder], Builder]:
    """Register an optimiser: a builder groups → ``torch.optim.Optimizer``; each group has ``params`` and ``lr``."""
    return _decorator(OPTIMIZERS, name, options)


def logger(name: str) -> Callable[[Builder], Builder]:
    """Register a logger: a builder (out, first, settings) → :class:`softmpm_learn.loggers.Logger`, of the run's folder, the first
    iteration that the logger has not seen yet, and the plain settings by group, with the task's name.
    """
    return _decorator(LOGGERS, name, None)


def added() -> str:
    """Names that users registered, a line for each kind; empty if there are none."""
    rows = [(table.what, ", ".join(table.added)) for table in TABLES]
    return "\n".join(f"  {what:<11} {names}" for what, names in rows if names)


def _decorator(table: Table, name: str, kind: type | None) -> Callable[[Builder], Builder]:
    if kind is not None and not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        raise ValueError(f"the options of {table.what} {name!r} must be a dataclass, got {kind!r}.")

    def decorate(build: Builder) -> Builder:
        table.add(name, Entry(kind, build))
        return build

    return decorate


def _keywords(build: Callable) -> dict[str, inspect.Parameter]:
    """Parameters with a default, which are options: keyword-only ones, or all of a class such as an optimiser's."""
    parameters = inspect.signature(build).parameters
    return {key: p for key, p in parameters.items() if p.default is not p.empty}


def _takes_any(build: Callable) -> bool:
    return any(p.kind is p.VAR_KEYWORD for p in inspect.signature(build).parameters.values())


def _origin(build: Callable) -> tuple[str, str]:
    return build.__module__, getattr(build, "__qualname__", repr(build))


def _words(build: Callable) -> str:
    return ".".join(_origin(build))
