"""A model file from parts: the text of a vehicle of `models/`, with other controls, sensors and landmarks."""

import ast
import inspect
import json
import keyword
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import steady_ppl.sensors
from steady_ppl.errors import UsageError
from steady_ppl.model.loading import load_program
from steady_ppl.model.program import FIRST_MEASUREMENTS, Program, names, units
from steady_ppl.model.roles import ROLES
from steady_ppl.model.validate import probe
from steady_ppl.runs.workbench import workbench
from steady_ppl.sensors import Sensor
from steady_ppl.utils.files import whole_file

CODE_COLUMNS = 120  # characters of a line
MIN_EXTENT = 1.0  # m, standard deviation of a start on a map
MIN_SPEED = 0.5  # m/s
INITIAL = """    def initial(self):
        mean = tensor({mean}).to(self.noise)  # the middle of the landmarks
        sd = tensor({sd}).to(self.noise)
        return pyro.sample("start", dist.Normal(mean, sd).to_event(1))"""


@dataclass(frozen=True)
class Vehicle:
    """A vehicle of `models/` that lists its sensors."""

    kind: str  # the file's name without its ending
    file: Path

    @cached_property
    def program(self) -> Program:
        return load_program(self.file)

    @property
    def about(self) -> str:
        """What it is, in one line."""
        said = ast.get_docstring(ast.parse(self.file.read_text(encoding="utf-8"))) or self.kind
        return re.split(r"[:;\n]|, with ", said)[0].rstrip(".")

    def own(self, kind: type[Sensor], name: str) -> Sensor | None:
        """Its sensor of a class: the one of a name, or the only one that is not on the other side by its name."""
        listed = [one for one in self.program.sensors if type(one) is kind]
        named = [one for one in listed if one.name == name]
        fitting = named or [one for one in listed if len(_sides(one.name) | _sides(name)) < 2]
        return fitting[0] if len(fitting) == 1 else None


def _sides(name: str) -> set[str]:
    return {"left", "right"} & {*name.lower().split("_")}


def vehicles() -> dict[str, Vehicle]:
    """The vehicles by kind: files of `models/` whose class of the file's name lists `sensors`."""
    found = {}
    for file in sorted((workbench() / "models").glob("*.py")):
        for statement in ast.parse(file.read_text(encoding="utf-8")).body:
            own = statement.body if isinstance(statement, ast.ClassDef) else []
            if getattr(statement, "name", "") == class_name(file.stem) and any(
                "sensors" in _assigned(part) for part in own
            ):
                found[file.stem] = Vehicle(file.stem, file)
    return found


def sensor_kinds() -> dict[str, type[Sensor]]:
    """The classes of sensors by kind, as `yaw-rate`."""
    listed = [getattr(steady_ppl.sensors, name) for name in steady_ppl.sensors.__all__]
    return {one.kind.replace(" ", "-"): one for one in listed if not inspect.isabstract(one) and hasattr(one, "kind")}


def class_name(stem: str) -> str:
    """The name of a file's program, see `load_program`."""
    return "".join(word.capitalize() for word in stem.split("_"))


def write_model(
    path: Path,
    vehicle: Vehicle,
    *,
    controls: Sequence[str],
    sensors: Sequence[Sensor],
    landmarks: Sequence[tuple[float, float]] = (),
    fastest: float = 0.0,
    force: bool = False,
) -> Program:
    """Write a vehicle with other controls, sensors and landmarks to a file of its own, and try it on a probe.

    Args:
        path: the file, after which the class is named: `my_robot.py` holds `MyRobot`.
        controls: the names in the table of the vehicle's controls, in its order.
        sensors: with all settings.
        landmarks: m.
        fastest: m/s, that it is commanded or measured to go; a trajectory may begin so fast.
        force: overwrite a file.

    Returns:
        The program of the file.

    Raises:
        UsageError: the file cannot be written there, or its name is none for a program.
    """
    name = _checked_name(path, vehicle, force)
    text = _Text(vehicle, name).changed(controls, sensors, landmarks, fastest)
    with whole_file(path, beside=path.with_name(f"partial_{path.name}")) as beside:
        beside.write_text(text, encoding="utf-8")
        probe(load_program(f"{beside}:{name}"))
    return load_program(path)


def _checked_name(path: Path, vehicle: Vehicle, force: bool) -> str:
    name = class_name(path.stem)
    if path.suffix != ".py" or not path.stem.isidentifier() or keyword.iskeyword(name):
        raise UsageError(f"{path}: expected a name such as my_{vehicle.kind}.py")
    if not path.parent.is_dir():
        raise UsageError(f"{path} cannot be written: there is no folder {path.parent}")
    if name in {*steady_ppl.sensors.__all__, *vars(steady_ppl), "PyroParam"}:
        raise UsageError(f"{path}: its class would be {name}, which steady_ppl has: choose another name")
    if path.exists() and not force:
        raise UsageError(f"{path} exists: choose another name, or --force to overwrite")
    return name


class _Text:
    """The text of a vehicle's file, changed statement by statement so that the rest stays as it is written."""

    def __init__(self, vehicle: Vehicle, name: str) -> None:
        self.vehicle, self.name = vehicle, name
        self.source = vehicle.file.read_text(encoding="utf-8")
        self.module = ast.parse(self.source)
        classes = [one for one in self.module.body if isinstance(one, ast.ClassDef)]
        (self.body,) = (one for one in classes if one.name == class_name(vehicle.kind))
        self.others = [one for one in classes if one is not self.body]
        self.lines: list[str | None] = list(self.source.splitlines())

    def changed(
        self,
        controls: Sequence[str],
        sensors: Sequence[Sensor],
        landmarks: Sequence[tuple[float, float]],
        fastest: float,
    ) -> str:
        vehicle = self.vehicle
        about = f'"""{vehicle.about}; begun from models/{vehicle.file.name}."""'
        self._put(self.module.body[0], about if len(about) <= CODE_COLUMNS else f'"""{vehicle.about}."""')
        for other in self.others:
            self._put(other, None)
        for statement in self.module.body:
            if isinstance(statement, ast.ImportFrom) and statement.module == "steady_ppl.sensors":
                used = ", ".join(sorted({type(one).__name__ for one in sensors}))
                self._put(statement, f"from steady_ppl.sensors import {used}")
        first = self.body.lineno - 1
        self.lines[first] = re.sub(r"class \w+", f"class {self.name}", str(self.lines[first]), count=1)
        dropped = self._without_settings(sensors)
        written = {
            "controls": self._controls(controls),
            "sensors": _listed("sensors", [as_code(one) for one in sensors]) + self._start(sensors),
            "landmarks": _listed("landmarks", [f"({x!r}, {y!r})" for x, y in landmarks]) if landmarks else "",
            "guesses": _listed("guesses", [f'"{one}"' for one in self.vehicle.program.guesses if one not in dropped]),
        }
        for statement in self.body.body:
            for target in _assigned(statement) & written.keys():
                self._put(statement, written.pop(target) or None)
            if (
                isinstance(statement, ast.FunctionDef)
                and statement.name == "initial"
                and _sees_landmarks_alone(sensors)
            ):
                self._put(statement, _initial(landmarks, fastest))
        if landmarks and "landmarks" in written:
            place = next(one for one in self.body.body if "sensors" in _assigned(one)).lineno - 1
            self.lines[place] = f"{written['landmarks']}\n{self.lines[place]}"
        text = "\n".join(line for line in self.lines if line is not None).strip() + "\n"
        return re.sub(r"\n{4,}", "\n\n\n", text)

    def _put(self, statement: ast.stmt, text: str | None) -> None:
        first, last = statement.lineno - 1, statement.end_lineno or statement.lineno
        self.lines[first:last] = [text, *[None] * (last - first - 1)]

    def _controls(self, controls: Sequence[str]) -> str:
        program = self.vehicle.program
        declared = [
            f"{name} [{unit}]" if unit else name for name, unit in zip(controls, program.control_units, strict=True)
        ]
        lines = _listed("controls", [json.dumps(one, ensure_ascii=False) for one in declared])
        known = getattr(program, "roles", {})
        told = ", ".join(
            f'"{name}": "{role}"'
            for name, own, unit in zip(controls, program.control_names, program.control_units, strict=True)
            if (role := known.get(own, own)) in ROLES and name != role and ROLES[role].unit in ("", unit)
        )
        return f"{lines}\n    roles = {{{told}}}  # what each control is" if told else lines

    @staticmethod
    def _start(sensors: Sequence[Sensor]) -> str:
        told = "each trajectory begins about there; `initial` says how far from it"
        return "" if _sees_landmarks_alone(sensors) else f'\n    start = "{FIRST_MEASUREMENTS}"  # {told}'

    def _without_settings(self, sensors: Sequence[Sensor]) -> set[str]:
        """Take out parameters that only sensors asked for which are no longer there; returns their names."""
        named = [_names_of(listed) for listed in (self.vehicle.program.sensors, sensors)]
        dropped = set()
        for name in named[0] - named[1]:
            if len(re.findall(rf"\bself\.{name}\b", self.source)) != 1:
                continue
            for method in self.body.body:
                for statement in method.body if isinstance(method, ast.FunctionDef) else ():
                    if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == f"self.{name}":
                        self._put(statement, None)
                        dropped.add(name)
        return dropped


def _assigned(statement: ast.stmt) -> set[str]:
    """The names that a statement in the body of a class gives a value."""
    if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
        return {statement.target.id}
    targets = statement.targets if isinstance(statement, ast.Assign) else []
    return {target.id for target in targets if isinstance(target, ast.Name)}


def _names_of(sensors: Sequence[Sensor]) -> set[str]:
    """Names of parameters that settings of sensors are."""
    own = {"name"}
    return {
        value
        for one in sensors
        for field in fields(one)
        if field.name not in own and isinstance(value := getattr(one, field.name), str)
    }


def _listed(name: str, items: Sequence[str]) -> str:
    """`name = (items)` in the body of a class, on one line where it fits."""
    comma = "," if len(items) == 1 else ""
    line = f"    {name} = ({', '.join(items)}{comma})"
    if len(line) <= CODE_COLUMNS:
        return line
    if all(len(item) < 25 for item in items):
        rows = textwrap.wrap(", ".join(items) + ",", CODE_COLUMNS - 8, break_long_words=False)
    else:
        rows = [f"{item}," for item in items]
    return "\n".join([f"    {name} = (", *(f"        {row}" for row in rows), "    )"])


def as_code(sensor: Sensor) -> str:
    """A sensor as a line of Python: what differs from its class's defaults."""
    parts = []
    for field in sorted(fields(sensor), key=lambda field: field.name not in ("sd", "name")):
        value = getattr(sensor, field.name)
        default = sensor.kind.replace(" ", "_") if field.name == "name" else field.default
        if default is MISSING or value != default:
            parts.append(
                f"{field.name}={json.dumps(value, ensure_ascii=False) if isinstance(value, str) else repr(value)}"
            )
    return f"{type(sensor).__name__}({', '.join(parts)})"


def with_settings(
    kind: type[Sensor], settings: Mapping[str, Any], vehicle: Vehicle, others: Sequence[Sensor] = ()
) -> Sensor:
    """A sensor with some settings, the rest as the vehicle's own of its class has them, but for names of parameters
    that other sensors' settings are."""
    like, taken = vehicle.own(kind, settings.get("name", "")), _names_of(others)
    own = {} if like is None else {one.name: getattr(like, one.name) for one in fields(like) if one.name != "name"}
    own = {name: value for name, value in own.items() if not (isinstance(value, str) and value in taken)}
    return kind(**(own | dict(settings)))


def _sees_landmarks_alone(sensors: Sequence[Sensor]) -> bool:
    """Whether only landmarks tell where the vehicle is."""
    told = [column for one in sensors for column in names(one.columns(_ANY_MAP))]
    return needs_landmarks(sensors) and not any(column.endswith("_x") for column in told)


def needs_landmarks(sensors: Sequence[Sensor]) -> bool:
    """Whether some sensor sees landmarks: how many columns it has depends on their number."""
    return any(len(one.columns(_ANY_MAP)) != len(one.columns(_Map(2))) for one in sensors)


def _initial(landmarks: Sequence[tuple[float, float]], fastest: float) -> str:
    """A start anywhere on a map of landmarks, in any direction."""
    middle, sizes = [], []
    for axis in zip(*landmarks, strict=True):
        middle.append(round(0.5 * (min(axis) + max(axis)), 2))
        sizes.append(max(MIN_EXTENT, round(0.5 * (max(axis) - min(axis)), 2)))
    speed = max(MIN_SPEED, round(fastest, 1))
    return INITIAL.format(mean=[*middle, 0.0, 0.0, 0.0, 0.0], sd=[*sizes, 3.0, speed, speed, 0.5])


@dataclass(frozen=True)
class _Map:
    """As much of a vehicle as a sensor's columns depend on."""

    count: int

    @property
    def landmarks(self) -> tuple[tuple[float, float], ...]:
        return tuple((float(index), 0.0) for index in range(self.count))


_ANY_MAP = _Map(1)


def columns_of(sensor: Sensor, landmarks: int) -> dict[str, str]:
    """A sensor's columns with so many landmarks: name → unit."""
    declared = sensor.columns(_Map(landmarks))
    return dict(zip(names(declared), units(declared), strict=True))
