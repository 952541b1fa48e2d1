"""`steady new`: a model file from parts, with the names of a table."""

import ast
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import steady_ppl as st
from steady_ppl.errors import SteadyError, UsageError
from steady_ppl.utils.text import counted, say, shown, tell

if TYPE_CHECKING:
    from steady_ppl.runs.table_header import Column, Header, Seen
    from steady_ppl.runs.vehicle_parts import Vehicle
    from steady_ppl.sensors import Sensor

SENSOR_FORM = "KIND[=NAME][:SD][,SETTING=VALUE]..."
MIN_STICK, MIN_DEGREES = 1.3, 2.0  # of a steering angle's size, beyond which it is none in rad


@dataclass
class Parts:
    """What a model is made of."""

    vehicle: "Vehicle"
    controls: list[str]  # their names in the table
    sensors: "list[Sensor]" = field(default_factory=list)
    columns: dict[str, str] = field(default_factory=dict)  # of the table → as the model's table has them
    landmarks: int = 0  # that the table's columns are of
    guessed: list[str] = field(default_factory=list)  # what is to be checked


def new(
    file: Annotated[Path, typer.Argument(metavar="FILE.py", help="Model to write.")],
    table: Annotated[Path | None, typer.Argument(help="Table whose columns name controls and sensors.")] = None,
    vehicle: Annotated[
        str | None, typer.Option(metavar="KIND", help="A file of models/ that lists sensors: car, unicycle, …")
    ] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(metavar=SENSOR_FORM, help="As position=gps:0.3; repeat for several. Overrides TABLE."),
    ] = None,
    control: Annotated[
        list[str] | None,
        typer.Option(metavar="COLUMN=CONTROL", help="Control of a column: delta=steering; repeat for several."),
    ] = None,
    landmark: Annotated[
        list[str] | None, typer.Option(metavar="X,Y", help="Landmark, m; repeat in the order of the columns.")
    ] = None,
    table_out: Annotated[
        Path | None, typer.Option(metavar="TABLE", help="Table to write, with the model's names and units.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite existing files.")] = False,
) -> None:
    """Write a model from parts: vehicle, controls, sensors.

    The columns of TABLE select them; options set the rest. At a terminal it asks.
    """
    from steady_ppl.runs.table_header import Header
    from steady_ppl.runs.vehicle_parts import needs_landmarks, sensor_kinds, write_model

    header = None if table is None else Header.read(table)
    given = _controls(control or [])
    parts = _vehicle(file, vehicle, header, given)
    kinds = sensor_kinds()
    wanted = [_sensor(text, kinds) for text in sensor or []]
    if header is not None:
        _read_sensors(parts, header, kinds, wanted)
    else:
        _own_sensors(parts, wanted)
    if not parts.sensors:
        answer = _asked("Sensors, with blanks between them (position=gps:0.3 yaw-rate=gyro:0.02)")
        wanted = [_sensor(text, kinds) for text in shlex.split(answer or "")]
        if not wanted:
            raise UsageError(
                f"no sensor is known by TABLE's columns: name each, --sensor {SENSOR_FORM}; {_kinds(kinds)}"
            )
        _own_sensors(parts, wanted)
    places = [_landmark(text) for text in landmark or []] if needs_landmarks(parts.sensors) else []
    if needs_landmarks(parts.sensors) and not places:
        count = str(parts.landmarks or "the")
        answer = _asked(f"Places of {count} landmarks, m, with blanks between them (0,0 5,0 5,5)")
        places = [_landmark(text) for text in (answer or "").split()]
        if not places:
            raise UsageError(f"the sensors see {count} landmarks: name each by --landmark X,Y, in the order of columns")
    if parts.landmarks and len(places) != parts.landmarks:
        raise UsageError(f"{table}: its columns are of {parts.landmarks} landmarks, --landmark names {len(places)}")
    if landmark and not places:
        raise UsageError("--landmark: no sensor of this model sees landmarks")
    renamed = {} if header is None else {old: now for old, now in parts.columns.items() if old != now}
    if header is not None:
        renamed |= {name: "" for name in (header.time,) if name != "time"}
        renamed |= {header.label: ""} if header.label not in (None, "trajectory") else {}
        _require_table_out(header, table_out, renamed, force)
    drives = None if header is None else _read(parts, header)
    raw = [raw for raw, called in parts.columns.items() if called.startswith("u.")]
    units = zip(raw, parts.vehicle.program.control_units, strict=True) if header else ()
    speeds = [header.largest(name) for name, unit in units if header and unit == "m/s"]
    given_parts: Any = {"controls": parts.controls, "sensors": parts.sensors, "landmarks": places}
    program = write_model(file, parts.vehicle, **given_parts, fastest=max(speeds, default=0.0), force=force)
    place = table_out if header and table_out else table
    if drives is not None and table_out is not None:
        st.write_table(drives, table_out)
    _report(file, parts, header, place)
    if drives is not None and place is not None:
        for finding in st.doctor(st.for_program(program, drives), program).findings:
            say(f"{place.name}: {finding} (`steady doctor {shlex.quote(str(place))}` says how to mend it)")
    read = shlex.quote(str(place)) if place is not None else "TRAIN.csv"
    out = shlex.quote(f"runs/{file.stem}")
    tell(f"\nnext:\n  steady fit {shlex.quote(str(file))} {read} --recipe likelihood --out {out}")
    tell(f"  steady check {out} {read}")


def _vehicle(file: Path, kind: str | None, header: "Header | None", given: Mapping[str, str]) -> Parts:
    """The vehicle, as named or as a table's controls say."""
    from steady_ppl.runs.table_header import controls_of
    from steady_ppl.runs.vehicle_parts import vehicles

    known = vehicles()
    listed = ", ".join(f"{one} ({', '.join(it.program.controls)})" for one, it in known.items())
    for name, control in given.items():
        if header is not None and not any(one.is_called(name) for one in header.of("u")):
            what = f"{header.name} has no column {shown(name, 40)}"
            raise UsageError(f"--control {shown(name, 40)}={shown(control, 40)}: {what}; it has {_names(header)}")
        if kind is None and not any(control in it.program.control_names for it in known.values()):
            what = f"no vehicle has a control {shown(control, 40)}"
            raise UsageError(f"--control {shown(name, 40)}={shown(control, 40)}: {what}; there are {listed}")
    if kind is None and header is not None:
        fitting = {one: found for one, it in known.items() if (found := controls_of(it, header, given)) is not None}
        if fitting:
            y_columns = {one.name for one in header.of("y")}

            def rank(one: str) -> tuple[bool, int, bool, int]:
                """Controls of other names; whether it lacks the first column of its own; its parameters."""
                program = known[one].program
                others = sum(
                    own not in (column.name, *given.values())
                    for own, column in zip(program.control_names, fitting[one], strict=True)
                )
                size = sum(value.numel() for value in program.parameters())
                return one != file.stem, others, program.measurement_names[0] not in y_columns, size

            kind, *others = sorted(fitting, key=rank)
            units = known[kind].program.control_units
            others = [one for one in others if known[one].program.control_units == units]
            guessed = [f"the vehicle: {kind}" + (f"; --vehicle {' or '.join(others)} fits as well" if others else "")]
            return _with_controls(known[kind], fitting[kind], guessed)
    kind = kind or _asked(f"Vehicle: {listed}")
    if kind is None:
        wrong = "" if header is None else f"{header.name}: no vehicle has its controls ({_names(header)}): "
        how = "name the vehicle by --vehicle KIND" + (", its controls by --control COLUMN=CONTROL" if header else "")
        raise UsageError(f"{wrong}{how}; there are {listed}")
    if kind not in known:
        raise UsageError(f"--vehicle {shown(kind, 40)}: there is no such vehicle; there are {listed}")
    own, units = known[kind].program.control_names, known[kind].program.controls
    if strange := {*given.values()} - {*own}:
        raise UsageError(f"--control: {kind} has no control {', '.join(strange)}; it has {', '.join(own)}")
    if header is None:
        names = {control: name for name, control in given.items()}
        return Parts(known[kind], [names.get(one, one) for one in own])
    found = controls_of(known[kind], header, given)
    if found is None:
        what = f"{header.name}: which columns are {', '.join(units)}?"
        raise UsageError(f"{what} say it by --control COLUMN=CONTROL; it has {_names(header)}")
    return _with_controls(known[kind], found, [])


def _with_controls(vehicle: "Vehicle", columns: "Sequence[Column]", guessed: list[str]) -> Parts:
    called = {one.raw: one.called("u") for one in columns}
    return Parts(vehicle, [name.removeprefix("u.") for name in called.values()], columns=called, guessed=guessed)


def _names(header: "Header") -> str:
    return shown(", ".join(one.raw for one in header.of("u")) or "none", 200)


def _read_sensors(
    parts: Parts, header: "Header", kinds: "Mapping[str, type[Sensor]]", wanted: "Sequence[_Wanted]"
) -> None:
    """The sensors that are asked for and those that the columns say, with the columns' names."""
    from steady_ppl.runs.table_header import example, sensors_in
    from steady_ppl.runs.vehicle_parts import columns_of

    for one in wanted:
        found = sensors_in(header, [one.kind], parts.columns, one.name)
        if not found:
            units = dict.fromkeys(columns_of(example(one.kind, "n"), 1).values())
            what = f"{header.name} has no columns of {one.name or one.kind.kind} in {', '.join(units)}"
            raise UsageError(f"--sensor {one.text}: {what}; it has {_y_names(header)}")
        _take(parts, header, found[0], one)
    own = parts.vehicle.program.sensors
    found = sensors_in(header, list(kinds.values()), parts.columns, own=own)
    for seen in sorted(found, key=lambda seen: seen.name not in [one.name for one in own]):
        _take(parts, header, seen, None)


def _y_names(header: "Header") -> str:
    return shown(", ".join(one.raw for one in header.of("y")), 200)


def _take(parts: Parts, header: "Header", seen: "Seen", wanted: "_Wanted | None") -> None:
    """Put a sensor that a table has into the model."""
    from steady_ppl.runs.table_header import Column, required_settings

    settings = {"name": seen.name} | (wanted.settings if wanted else {})
    own = parts.vehicle.own(seen.kind, seen.name)
    for setting in required_settings(seen.kind):
        if setting in settings:
            continue
        noises = [noise for column in _columns_for(setting, seen) if (noise := header.noise(column)) is not None]
        value = float(f"{sorted(noises)[len(noises) // 2]:.1g}") if noises else getattr(own, setting, None)
        if not isinstance(value, float) or not value > 0:
            raise UsageError(
                f"the {setting} of {seen.name} cannot be told from {header.name}: --sensor {_kind(seen)}:SD"
            )
        settings[setting] = value
        how = "from differences of neighbouring readings" if noises else "as in the vehicle's file"
        parts.guessed.append(f"{setting} of {seen.name}: {value:g} ({how})")
    if seen.others:
        parts.guessed.append(f"{seen.name}: {seen.kind.kind}; {' or '.join(seen.others)} fits as well")
    _add(parts, seen.kind, settings)
    headings = [old for old, own in seen.columns.items() if own == f"{seen.name}_heading"]  # of a pose
    parts.guessed += [_from_x(Column.parse(old).name) for old in headings]
    parts.columns |= {old: f"y.{name}" for old, name in seen.columns.items()}
    parts.landmarks = max(parts.landmarks, seen.landmarks)


def _add(parts: Parts, kind: "type[Sensor]", settings: Mapping[str, Any]) -> "Sensor":
    """Put a sensor into the model, and list what nobody said of it."""
    from steady_ppl.runs.vehicle_parts import with_settings

    made = with_settings(kind, settings, parts.vehicle, parts.sensors)
    like = parts.vehicle.own(kind, settings.get("name", ""))
    for name in (one.name for one in fields(made) if one.name not in ("name", *settings)):
        value, own = getattr(made, name), getattr(like, name, None)
        if isinstance(own, str) and value != own:
            parts.guessed.append(f"{name} of {made.name}: {value or 'none'} ({own} is that of another sensor)")
        elif name == "left" and value == 0:
            parts.guessed.append(f"{made.name}: left = 0 m, it stands on the middle line")
        elif name == "from_north" and not value:
            parts.guessed.append(_from_x(made.name))
    parts.sensors.append(made)
    return made


def _from_x(name: str) -> str:
    return f"{name} counts from x anticlockwise; if from north: --sensor heading={name},from_north=true"


def _kind(seen: "Seen") -> str:
    return f"{seen.kind.kind.replace(' ', '-')}={seen.name}"


def _columns_for(setting: str, seen: "Seen") -> list[str]:
    """The columns whose noise a setting is: `bearing_sd` that of `…bearing_0`, `sd` that of the others."""
    of = setting.removesuffix("_sd")
    named = [old for old, own in seen.columns.items() if of in own.split("_")]
    if setting != "sd":
        return named
    others = {one.name.removesuffix("_sd") for one in fields(seen.kind) if one.name.endswith("_sd")}
    return [old for old, own in seen.columns.items() if not others & {*own.split("_")}]


def _own_sensors(parts: Parts, wanted: "Sequence[_Wanted]") -> None:
    """The sensors that are asked for; where none are, the vehicle's own."""
    if not wanted:
        parts.sensors = list(parts.vehicle.program.sensors)
        parts.guessed.append("the sensors: those of the vehicle's own file")
    for one in wanted:
        try:
            made = _add(parts, one.kind, one.settings)
        except TypeError:
            raise UsageError(f"--sensor {one.text}: its standard deviation is missing: {SENSOR_FORM}") from None
        if "sd" not in one.settings:
            parts.guessed.append(f"sd of {made.name}: {made.sd} (as in the vehicle's file)")


@dataclass(frozen=True)
class _Wanted:
    """A sensor as it is asked for."""

    text: str
    kind: "type[Sensor]"
    settings: dict[str, Any]

    @property
    def name(self) -> str:
        return str(self.settings.get("name", ""))


def _sensor(text: str, kinds: "Mapping[str, type[Sensor]]") -> _Wanted:
    """Parse `position=gps:0.3,offset=antenna`."""
    first, *rest = _split(text)
    about, _, sd = first.partition(":")
    kind, _, name = about.partition("=")
    found = kinds.get(kind.strip().lower().replace("_", "-").replace(" ", "-"))
    found = found or next((one for one in kinds.values() if one.__name__.lower() == kind.strip().lower()), None)
    if found is None:
        raise UsageError(f"--sensor {shown(text, 60)}: no kind of sensor is {shown(kind, 40)!r}; {_kinds(kinds)}")
    there = {one.name: one.default for one in fields(found)}
    settings: dict[str, Any] = {"name": name.strip()} if name else {}
    if sd:
        settings["sd"] = _value(sd)
    for part in rest:
        setting, equals, value = part.partition("=")
        if not equals or setting.strip() not in there:
            raise UsageError(
                f"--sensor {shown(text, 60)}: {shown(setting, 40)!r} is no setting; there are {', '.join(there)}"
            )
        read, is_flag = _value(value), isinstance(there[setting.strip()], bool)
        if isinstance(read, bool) != is_flag:
            what = "is true or false" if is_flag else "is not true or false"
            raise UsageError(f"--sensor {shown(text, 60)}: {setting.strip()} {what}, got {shown(value, 40)!r}")
        settings[setting.strip()] = read
    try:
        found(**({"sd": 1.0} | {one: 1.0 for one in there if one.endswith("_sd")} | settings))
    except SteadyError as error:
        raise UsageError(f"--sensor {shown(text, 60)}: {error}") from None
    return _Wanted(text, found, settings)


def _split(text: str) -> list[str]:
    """Parts between commas that stand in no parentheses."""
    parts, depth = [""], 0
    for char in text:
        depth += (char in "([") - (char in ")]")
        if char == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += char
    return parts


def _value(text: str) -> Any:
    """A number, numbers in parentheses, true or false, or else the name of a parameter."""
    word = text.strip()
    try:
        return ast.literal_eval({"true": "True", "false": "False"}.get(word, word))
    except (ValueError, SyntaxError):
        return word


def _kinds(kinds: "Mapping[str, type[Sensor]]") -> str:
    return f"there are {', '.join(kinds)}"


def _controls(texts: Sequence[str]) -> dict[str, str]:
    """The control that each column is."""
    given = dict[str, str]()
    for text in texts:
        column, equals, own = (part.strip() for part in text.partition("="))
        column = column.removeprefix("u.")
        if not (equals and column and own):
            raise UsageError(f"--control {shown(text, 60)}: expected COLUMN=CONTROL, as delta=steering")
        if column in given or own in given.values():
            twice = column if column in given else own
            raise UsageError(f"--control {shown(text, 60)}: {shown(twice, 40)} is named twice")
        given[column] = own
    return given


def _landmark(text: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
        if not (abs(x) < 1e9 and abs(y) < 1e9):
            raise ValueError
    except ValueError:
        raise UsageError(f"--landmark {shown(text, 40)}: expected two numbers, X,Y in m") from None
    return x, y


def _asked(question: str) -> str | None:
    """An answer at a terminal; None elsewhere, or where there is none."""
    if not sys.stdin.isatty():
        return None
    answer = typer.prompt(question, default="", show_default=False, err=True).strip()
    return answer or None


def _require_table_out(header: "Header", out: Path | None, renamed: Mapping[str, str], force: bool) -> None:
    from steady_ppl.data.table import require_table_file

    if out is not None:
        require_table_file(out)
        if out.exists() and out.samefile(header.path):
            raise UsageError(f"--table-out {out} is the table itself: choose another name")
        if out.exists() and not force:
            raise UsageError(f"{out} exists: choose another name, or --force to overwrite")
        return
    wrong = [] if header.label else ["there is no column trajectory"]
    if renamed:
        wrong.append(f"its columns have other names than a model's ({shown(', '.join(renamed), 100)})")
    if wrong:
        how = "name a table to write with the right ones, --table-out drives.csv"
        raise UsageError(f"{header.path}: {', and '.join(wrong)}: {how}")


def _read(parts: Parts, header: "Header") -> "st.Trajectories":
    """The table as the model reads it, checked; list what its units are taken to be."""
    from steady_ppl.runs.table_header import Column
    from steady_ppl.runs.vehicle_parts import columns_of

    drives = header.as_table(parts.columns | {one.raw: one.raw for one in header.columns if one.group == "x"})
    program = parts.vehicle.program
    header.require_seconds(program.step)
    called = [f"u.{name}" for name in parts.controls]
    units = dict(zip(called, program.control_units, strict=True))
    roles = dict(zip(called, (program.roles.get(own, own) for own in program.control_names), strict=True))
    for one in parts.sensors:
        units |= {f"y.{name}": unit for name, unit in columns_of(one, parts.landmarks).items()}
    taken: dict[str, list[str]] = {}
    for raw, name in parts.columns.items():
        if units[name] and not Column.parse(raw).unit:
            taken.setdefault(units[name], []).append(raw)
            largest = header.largest(raw) if roles.get(name) in ("steering", "rudder") else 0.0
            if largest == 1.0 or largest >= MIN_STICK:
                what = "degrees" if largest > MIN_DEGREES else "a share of full lock"
                parts.guessed.append(f"{raw} looks like {what}, not rad")
    for unit, raws in taken.items():
        is_taken = "is taken" if len(raws) == 1 else "are taken"
        parts.guessed.append(f"{shown(', '.join(raws), 80)} {is_taken} in {unit}")
    return drives


def _report(file: Path, parts: Parts, header: "Header | None", place: Path | None) -> None:
    """Say what was written, what is to be checked, and which columns are not used."""
    told = ", ".join(one.name if one.name == one.kind else f"{one.name} ({one.kind})" for one in parts.sensors)
    tell(f"{file}: {parts.vehicle.about[:1].lower()}{parts.vehicle.about[1:]}")
    own = zip(parts.controls, parts.vehicle.program.control_names, strict=True)
    tell(f"controls: {', '.join(name if name == role else f'{name} ({role})' for name, role in own)}")
    tell(f"sensors: {told}")
    if parts.guessed:
        tell("guessed, to be checked:")
        tell("\n".join(f"  {one}" for one in parts.guessed))
    if header is None:
        return
    unused = [one.raw for one in header.columns if one.raw not in parts.columns and one.group != "x"]
    if unused:
        tell(f"not used: {shown(', '.join(unused), 300)} (`--sensor`, `--control` name what they are)")
    if place is not None and place.name != header.name:
        tell(f"{place}: {counted(len(header.frame), 'row')}, written with the model's names and units")
