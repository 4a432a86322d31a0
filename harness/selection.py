"""What the user names: solvers and scenarios with their settings, as text.

    qce                                     a law of the registry, with its default settings
    qce:tolerance=1e-8,max_iterations=50    with settings
    my_law.py:MyLaw                         a class in a file of the user's
    my_law.py:MyLaw:tolerance=1e-8          with settings
    three-ball-chain                        all of a family that the tier has, else its default parameters
    three-ball-chain:va=0.5                 one member of the family
    pool-*                                  every family whose name matches

Values are Python literals (0.5, 3, true, [1,2,3]) or plain words. Solvers of other packages are found under the entry
point group "impactbench.solvers".
"""

from __future__ import annotations

import ast
import dataclasses
import difflib
import enum
import fnmatch
import hashlib
import importlib.util
import inspect
import sys
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from scenarios import CATALOG
from scenarios.moving import MOVING
from scenarios.scenario import Scenario
from scenarios.world.impact import Streamed
from scenarios.world.moving_scene import STREAMED, MovingScene
from solvers import PEERS, SOLVERS, Solver

ENTRY_POINT_GROUP = "impactbench.solvers"
# difflib's default of 0.6 misses "pgs" for "lcp-pgs".
NEARNESS = 0.5


class SelectionError(ValueError):
    """A specification names what does not exist, or does not parse; the text has the near names."""


@dataclass(frozen=True)
class SolverChoice:
    """A solver that was asked for, made and checked."""

    specification: str
    """As it is stored and shown; naming it again makes the same solver."""
    name: str
    """Name in the registry, under which references know the law; the specification for a user's own."""
    solver: Solver
    settings: Mapping[str, object]
    """All settings, JSON-able; "source" is the hash of a user's own file."""


@dataclass(frozen=True)
class ScenarioChoice:
    """A family that was asked for."""

    name: str
    parameters: Mapping[str, object]
    """Parameters that were given; the family's own for the others."""
    exact: bool
    """True where parameters were given: this member and no other."""


def available_solvers() -> dict[str, type[Solver]]:
    """Every solver that has a name: the registry's, then those of other packages.

    Raises:
        SelectionError: a package's entry point cannot be loaded.
    """
    foreign = {name: _load_entry_point(entry) for name, entry in _entry_points().items()}
    return {**SOLVERS, **foreign}


def judged_solvers() -> dict[str, type[Solver]]:
    """The solvers that a scorecard is about where none is named: all but further methods for a law that is there.

    Raises:
        SelectionError: a package's entry point cannot be loaded.
    """
    return {name: law for name, law in available_solvers().items() if name not in PEERS}


def choose_solver(specification: str) -> SolverChoice:
    """Make a solver from its specification.

    Raises:
        SelectionError: the name, the file, the class or a setting does not exist, or a value has the wrong type.
    """
    name, settings_text = _split_solver(specification)
    path_text, separator, class_name = name.rpartition(":")
    if separator:
        law, source = _load_class(Path(path_text), class_name)
    else:
        law, source = _named_solver(name), None
    given = _read_settings(law, name, settings_text)
    try:
        solver = law(**given)
    except (TypeError, ValueError) as error:
        raise SelectionError(f"solver {specification} cannot be made: {error}") from error
    settings = _settings_of(solver) | ({"source": source} if source else {})
    return SolverChoice(_canonical(name, given), name, solver, settings)


def choose_scenarios(specification: str, extra_names: Iterable[str] = ()) -> tuple[ScenarioChoice, ...]:
    """Find the families that a specification names; parameters are checked by building the scene.

    Args:
        specification: name or pattern, with or without parameters.
        extra_names: names beside the catalog's that may be chosen too (sweeps); they take no parameters here.

    Raises:
        SelectionError: nothing has that name, or a parameter does not exist or is refused by the family.
    """
    pattern, _, text = specification.partition(":")
    names = (*CATALOG, *extra_names)
    matching = [name for name in names if fnmatch.fnmatchcase(name, pattern)]
    if not matching:
        raise SelectionError(unknown("scenario", pattern, names))
    texts = _split_pairs(text, specification)
    chosen = []
    for name in matching:
        if texts and name not in CATALOG:
            raise SelectionError(f"{name} is a sweep and takes no parameters")
        parameters = _read_parameters(name, CATALOG[name], texts) if texts else {}
        if parameters:
            build_scenario(name, parameters)
        chosen.append(ScenarioChoice(name, parameters, exact=bool(texts)))
    return tuple(chosen)


def choose_moving(specification: str) -> MovingScene:
    """Make a moving scene from its name and parameters, as "extended-pattern:pattern=stripes".

    Raises:
        SelectionError: the scene or a parameter does not exist, or a value is refused.
    """
    name, _, text = specification.partition(":")
    if name not in MOVING:
        raise SelectionError(unknown("moving scene", name, MOVING))
    parameters = _read_parameters(name, MOVING[name], _split_pairs(text, specification))
    try:
        return MOVING[name](**parameters)
    except (TypeError, ValueError) as error:
        raise SelectionError(f"scene {name} refuses its parameters: {error}") from error


def choose_resolver(specification: str) -> tuple[str, Solver | Streamed]:
    """Make what solves the impacts of a moving scene: a solver, or a packed one of `STREAMED`.

    Returns:
        The specification in one spelling, and the solver.

    Raises:
        SelectionError: as `choose_solver`.
    """
    name, _, text = specification.partition(":")
    if name not in STREAMED:
        if name not in available_solvers() and ".py" not in specification:
            raise SelectionError(unknown("solver", name, (*available_solvers(), *STREAMED)))
        choice = choose_solver(specification)
        return choice.specification, choice.solver
    given = _read_settings(Streamed, name, text)
    return _canonical(name, given), dataclasses.replace(STREAMED[name], **given)  # type: ignore[arg-type]


def build_scenario(name: str, parameters: Mapping[str, object]) -> Scenario:
    """Build one scene of the catalog.

    Raises:
        SelectionError: the family does not exist, or refuses the parameters.
    """
    if name not in CATALOG:
        raise SelectionError(unknown("scenario", name, CATALOG))
    try:
        return CATALOG[name](**parameters)
    except (TypeError, ValueError) as error:
        raise SelectionError(f"scenario {name} refuses its parameters: {error}") from error


def setting_fields(law: type[Any]) -> dict[str, Any]:
    """Names and defaults of a solver's settings, in the order of the class; empty where it is no dataclass."""
    if not dataclasses.is_dataclass(law):
        return {}
    return {field.name: field.default for field in dataclasses.fields(law) if field.init}


def unknown(what: str, name: str, known: Iterable[str]) -> str:
    """Say that a name does not exist, with the near ones first."""
    names = sorted(known)
    near = difflib.get_close_matches(name, names, n=3, cutoff=NEARNESS)
    near += [other for other in names if name and name in other and other not in near]
    if near:
        *others, last = near
        alternatives = f"{', '.join(others)} or {last}" if others else last
        return f"unknown {what} {name!r}; did you mean {alternatives}?"
    return f"unknown {what} {name!r}; there are: {', '.join(names) or 'none'}"


def _split_solver(specification: str) -> tuple[str, str]:
    """Part a specification in the name (with the class, for a file) and the text of the settings."""
    path, separator, rest = specification.partition(".py:")
    if separator:
        class_name, _, settings = rest.partition(":")
        return f"{path}.py:{class_name}", settings
    name, _, settings = specification.partition(":")
    if name.endswith(".py"):
        raise SelectionError(f"{name}: name the class too, as {name}:MyLaw")
    return name, settings


def _named_solver(name: str) -> type[Solver]:
    """Find a solver by its name; only the one that is asked for is loaded."""
    if name in SOLVERS:
        return SOLVERS[name]
    entries = _entry_points()
    if name not in entries:
        raise SelectionError(unknown("solver", name, (*SOLVERS, *entries)))
    return _load_entry_point(entries[name])


def _entry_points() -> dict[str, metadata.EntryPoint]:
    """Solvers of other packages; none of them replaces a law of the benchmark under the law's own name."""
    entries = metadata.entry_points(group=ENTRY_POINT_GROUP)
    return {entry.name: entry for entry in entries if entry.name not in SOLVERS}


def _load_entry_point(entry: metadata.EntryPoint) -> type[Solver]:
    try:
        law: type[Solver] = entry.load()
    except (ImportError, AttributeError) as error:
        raise SelectionError(
            f"solver {entry.name} of another package ({entry.value}) does not load: {error}"
        ) from error
    return law


def _load_class(path: Path, class_name: str) -> tuple[type[Solver], str]:
    """Load a user's own class; returns it with the hash of its file."""
    try:
        source = path.read_bytes()
    except OSError as error:
        raise SelectionError(f"cannot read the solver file {path}: {error.strerror}") from error
    digest = hashlib.sha256(source).hexdigest()[:16]
    module_name = f"impactbench_user_{path.stem}_{digest}"
    module = sys.modules.get(module_name) or _import_file(path, module_name)
    law = getattr(module, class_name, None)
    if not isinstance(law, type) or not callable(getattr(law, "solve", None)):
        laws = [key for key, value in vars(module).items() if isinstance(value, type) and hasattr(value, "solve")]
        raise SelectionError(f"{path}: " + unknown("solver class", class_name, laws))
    return law, digest


def _import_file(path: Path, module_name: str) -> types.ModuleType:
    """Execute a user's file as a module; what it imports from its own folder is found."""
    spec = importlib.util.spec_from_file_location(module_name, path)
    if spec is None or spec.loader is None:
        raise SelectionError(f"{path} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses and numba look their module up while it is executed.
    sys.modules[module_name] = module
    sys.path.insert(0, str(path.resolve().parent))
    try:
        spec.loader.exec_module(module)
    except (SyntaxError, ImportError, AttributeError, NameError, TypeError, ValueError) as error:
        del sys.modules[module_name]
        raise SelectionError(f"{path} does not load: {type(error).__name__}: {error}") from error
    finally:
        sys.path.remove(str(path.resolve().parent))
    return module


def _split_pairs(text: str, specification: str) -> dict[str, str]:
    """Part "a=1,b=[1,2]" at the commas outside brackets."""
    parts, depth, start = [], 0, 0
    for position, letter in enumerate(text):
        depth += (letter in "[(") - (letter in "])")
        if letter == "," and depth == 0:
            parts.append(text[start:position])
            start = position + 1
    parts.append(text[start:])
    pairs: dict[str, str] = {}
    for part in parts:
        if not part.strip() and len(parts) == 1:
            break
        key, separator, value = part.partition("=")
        if not separator or not key.strip() or not value.strip():
            raise SelectionError(f"{specification}: {part.strip()!r} is no setting; write name:key=value,key=value")
        if key.strip() in pairs:
            raise SelectionError(f"{specification}: {key.strip()} is given twice")
        pairs[key.strip()] = value.strip()
    return pairs


def _read_settings(law: type[Any], name: str, text: str) -> dict[str, object]:
    """Convert settings by the types of the class's fields."""
    pairs = _split_pairs(text, name)
    if not pairs:
        return {}
    fields = setting_fields(law)
    types_of = typing.get_type_hints(law)
    for key in pairs:
        if key not in fields:
            raise SelectionError(f"solver {name}: " + unknown("setting", key, fields))
    return {key: _convert(value, types_of.get(key, object), f"{name}: {key}") for key, value in pairs.items()}


def _read_parameters(name: str, family: Callable[..., object], texts: Mapping[str, str]) -> dict[str, object]:
    """Convert a family's parameters by its annotations."""
    known = inspect.signature(family).parameters
    for key in texts:
        if key not in known:
            raise SelectionError(f"scenario {name}: " + unknown("parameter", key, known))
    types_of = typing.get_type_hints(family)
    return {key: _convert(text, types_of.get(key, object), f"{name}: {key}") for key, text in texts.items()}


def _convert(text: str, wanted: Any, where: str) -> object:
    """Read a value as the annotated type.

    Raises:
        SelectionError: the text is no value of that type.
    """
    options = typing.get_args(wanted)
    if isinstance(wanted, types.UnionType) or typing.get_origin(wanted) is typing.Union:
        if type(None) in options and text.lower() == "none":
            return None
        wanted = next(option for option in options if option is not type(None))
    if typing.get_origin(wanted) is typing.Literal and text in options:
        return text
    if isinstance(wanted, type) and issubclass(wanted, enum.Enum):
        for member in wanted:
            if text in (member.name, member.name.lower(), str(member.value)):
                return member
        raise SelectionError(
            f"{where} must be one of {', '.join(member.name.lower() for member in wanted)}, not {text}"
        )
    if wanted is str:
        return text
    value = _literal(text)
    if wanted is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    if wanted is int and isinstance(value, float) and value.is_integer():
        return int(value)
    if wanted is float or (wanted in (int, bool, list, tuple) and type(value) is not wanted):
        raise SelectionError(f"{where} must be of type {wanted.__name__}, not {text!r}")
    return value


def _literal(text: str) -> object:
    """Read a Python literal, true, false, none, inf or nan; anything else is a word."""
    words: dict[str, object] = {
        "true": True, "false": False, "none": None, "inf": float("inf"), "-inf": float("-inf"), "nan": float("nan"),
    }  # fmt: skip
    if text.lower() in words:
        return words[text.lower()]
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def _settings_of(solver: object) -> dict[str, object]:
    """All settings of a made solver, JSON-able."""
    if not dataclasses.is_dataclass(solver):
        return {}
    return {field.name: _storable(getattr(solver, field.name)) for field in dataclasses.fields(solver)}


def _storable(value: object) -> object:
    """A setting as JSON keeps it."""
    if isinstance(value, enum.Enum):
        return value.name.lower()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Sequence):
        return [_storable(item) for item in value]
    return repr(value)


def _canonical(name: str, given: Mapping[str, object]) -> str:
    """The specification in one spelling: the same settings are the same tasks."""
    if not given:
        return name
    texts = (f"{key}={str(_storable(value)).replace(' ', '')}" for key, value in sorted(given.items()))
    return f"{name}:{','.join(texts)}"
